; MXCSR: flush to zero, and denormals are zero.
define internal i64 @flush() {
  %control = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %control)
  %old = load i32, ptr %control
  %new = or i32 %old, 32832
  store i32 %new, ptr %control
  call void @llvm.x86.sse.ldmxcsr(ptr %control)
  %before = zext i32 %old to i64
  ret i64 %before
}

define internal void @unflush(i64 %before) {
  %control = alloca i32
  %old = trunc i64 %before to i32
  store i32 %old, ptr %control
  call void @llvm.x86.sse.ldmxcsr(ptr %control)
  ret void
}

declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)

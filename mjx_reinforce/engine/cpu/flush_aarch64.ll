; FPCR: flush to zero.
define internal i64 @flush() {
  %before = call i64 @llvm.aarch64.get.fpcr()
  %new = or i64 %before, 16777216
  call void @llvm.aarch64.set.fpcr(i64 %new)
  ret i64 %before
}

define internal void @unflush(i64 %before) {
  call void @llvm.aarch64.set.fpcr(i64 %before)
  ret void
}

declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)

; Calls a handler that may still be compiled: @slot points to it once it is in memory.
@slot = global ptr null
@words = internal constant [108 x i8] c"the machine code of a step was not compiled, perhaps for lack of memory; --engine mujoco or vmap needs none\00"
declare i32 @usleep(i32)

define internal ptr @execute(ptr %frame) {
entry:
  br label %wait
wait:
  %ready = load atomic ptr, ptr @slot acquire, align 8
  %early = icmp eq ptr %ready, null
  br i1 %early, label %sleep, label %call
sleep:
  %slept = call i32 @usleep(i32 1000)
  br label %wait
call:
  %error = call ptr %ready(ptr %frame)
  ret ptr %error
}

; The handler where compiling has failed.
define ptr @failed(ptr %frame) {
  %api.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_api
  %api = load ptr, ptr %api.at
  %error = call ptr @error(ptr %api, ptr @words)
  ret ptr %error
}

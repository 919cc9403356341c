; Launches one kernel. launcher.py fills in what stands after a dollar sign.
; Once the kernel is in memory, @slot points to the addresses of cuLaunchKernel and of the kernel.
@slot = global ptr null
@words = internal constant [44 x i8] c"cuLaunchKernel returned %d for machine code\00"
declare i32 @usleep(i32)
declare i32 @snprintf(ptr, i64, ptr, ...)

define internal ptr @execute(ptr %frame) {
entry:
  %asking = alloca [4 x i64]
  %api.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_api
  %api = load ptr, ptr %api.at
  %ctx.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_ctx
  %ctx = load ptr, ptr %ctx.at
  store i64 32, ptr %asking
  %asking.extension = getelementptr i64, ptr %asking, i64 1
  store ptr null, ptr %asking.extension
  %asking.ctx = getelementptr i64, ptr %asking, i64 2
  store ptr %ctx, ptr %asking.ctx
  %asking.stream = getelementptr i64, ptr %asking, i64 3
  store ptr null, ptr %asking.stream
  %get.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_XLA_FFI_Stream_Get
  %get = load ptr, ptr %get.at
  %no.stream = call ptr %get(ptr %asking)
  %refused = icmp ne ptr %no.stream, null
  br i1 %refused, label %refuse, label %wait
refuse:
  ret ptr %no.stream
wait:
  %ready = load atomic ptr, ptr @slot acquire, align 8
  %early = icmp eq ptr %ready, null
  br i1 %early, label %sleep, label %launch
sleep:
  %slept = call i32 @usleep(i32 1000)
  br label %wait
launch:
  %num.args.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_args_size
  %num.args = load i64, ptr %num.args.at
  %args.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_args_args
  %args = load ptr, ptr %args.at
  %num.rets.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_rets_size
  %num.rets = load i64, ptr %num.rets.at
  %rets.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_rets_rets
  %rets = load ptr, ptr %rets.at
  %count = add i64 %num.args, %num.rets
  %data = alloca ptr, i64 %count
  call void @read_data(ptr %args, i64 %num.args, ptr %data)
  %data.rets = getelementptr ptr, ptr %data, i64 %num.args
  call void @read_data(ptr %rets, i64 %num.rets, ptr %data.rets)
  %parameters = alloca ptr, i64 %count
  br label %point
point:
  %i = phi i64 [0, %launch], [%i.next, %point]
  %data.i = getelementptr ptr, ptr %data, i64 %i
  %parameter.i = getelementptr ptr, ptr %parameters, i64 %i
  store ptr %data.i, ptr %parameter.i
  %i.next = add i64 %i, 1
  %last = icmp eq i64 %i.next, %count
  br i1 %last, label %call, label %point
call:
  %attributes.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_attrs_attrs
  %attributes = load ptr, ptr %attributes.at
  %blocks = call i32 @attribute(ptr %attributes, i64 0)
  %threads = call i32 @attribute(ptr %attributes, i64 1)
  %run = load ptr, ptr %ready
  %kernel.at = getelementptr ptr, ptr %ready, i64 1
  %kernel = load ptr, ptr %kernel.at
  %stream = load ptr, ptr %asking.stream
  %shared.at = getelementptr ptr, ptr %ready, i64 2
  %shared = load i32, ptr %shared.at
  %status = call i32 %run(ptr %kernel, i32 %blocks, i32 1, i32 1, i32 %threads, i32 1, i32 1, i32 %shared, ptr %stream, ptr %parameters, ptr null)
  %fine = icmp eq i32 %status, 0
  br i1 %fine, label %done, label %failed
done:
  ret ptr null
failed:
  %text = alloca [64 x i8]
  %printed = call i32 (ptr, i64, ptr, ...) @snprintf(ptr %text, i64 64, ptr @words, i32 %status)
  %error = call ptr @error(ptr %api, ptr %text)
  ret ptr %error
}

; The value of an XLA_FFI_Scalar of 32 bits; XLA sorts attributes by name.
define internal i32 @attribute(ptr %attributes, i64 %number) {
  %scalar.at = getelementptr ptr, ptr %attributes, i64 %number
  %scalar = load ptr, ptr %scalar.at
  %value.at = getelementptr i8, ptr %scalar, i64 $XLA_FFI_Scalar_value
  %value.to = load ptr, ptr %value.at
  %value = load i32, ptr %value.to
  ret i32 %value
}

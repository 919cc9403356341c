; The way from XLA to @work and back; handler.py fills in what stands after a dollar sign.

%Job = type { $job }
@element_bytes = internal constant [$num_results x i64] [$element_bytes]
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)

; Makes a job of the buffers' data [arguments + results] and the sizes of the results.
define ptr @open(ptr %buffers, ptr %sizes, i64 %seeds, i64 %episodes, i64 %horizon) {
entry:
  %job = call ptr @malloc(i64 $fixed_bytes)
  call void @llvm.memset.p0.i64(ptr %job, i8 0, i64 $job_bytes, i1 false)
  %data = getelementptr i8, ptr %job, i64 $job_bytes
  call void @llvm.memcpy.p0.p0.i64(ptr %data, ptr %buffers, i64 $data_bytes, i1 false)
  %bytes = getelementptr i8, ptr %data, i64 $data_bytes
  call void @llvm.memcpy.p0.p0.i64(ptr %bytes, ptr %sizes, i64 $sizes_bytes, i1 false)
  br label %size
size:
  %r = phi i64 [0, %entry], [%r.next, %size]
  %sum = phi i64 [0, %entry], [%sum.next, %size]
  %size.at = getelementptr i64, ptr %bytes, i64 %r
  %size.r = load i64, ptr %size.at
  %sum.next = add i64 %sum, %size.r
  %r.next = add i64 %r, 1
  %sized = icmp eq i64 %r.next, $num_results
  br i1 %sized, label %done, label %size
done:
  %total = mul i64 %seeds, %episodes
  %megabytes = lshr i64 %sum.next, 20
  %parts = add i64 %megabytes, 1
  %chunks = mul i64 %parts, $zeroed
  %refs.at = getelementptr %Job, ptr %job, $refs
  store i64 1, ptr %refs.at
  %total.at = getelementptr %Job, ptr %job, $total
  store i64 %total, ptr %total.at
  %episodes.at = getelementptr %Job, ptr %job, $episodes
  store i64 %episodes, ptr %episodes.at
  %horizon.at = getelementptr %Job, ptr %job, $horizon
  store i64 %horizon, ptr %horizon.at
  %data.at = getelementptr %Job, ptr %job, $data
  store ptr %data, ptr %data.at
  %bytes.at = getelementptr %Job, ptr %job, $bytes
  store ptr %bytes, ptr %bytes.at
  %chunks.at = getelementptr %Job, ptr %job, $chunks
  store i64 %chunks, ptr %chunks.at
  ret ptr %job
}

; Takes part in a job, with any number of threads: sets the results to zero, then works.
define void @share(ptr %job) {
entry:
  %chunk.at = getelementptr %Job, ptr %job, $chunk
  %chunks.at = getelementptr %Job, ptr %job, $chunks
  %chunks = load i64, ptr %chunks.at
  %filled.at = getelementptr %Job, ptr %job, $filled
  %data.at = getelementptr %Job, ptr %job, $data
  %data = load ptr, ptr %data.at
  %bytes.at = getelementptr %Job, ptr %job, $bytes
  %bytes = load ptr, ptr %bytes.at
  br label %fetch
fetch:
  %chunk = atomicrmw add ptr %chunk.at, i64 1 monotonic
  %chunk.end = add i64 %chunk, 1
  %some = icmp ult i64 %chunk, %chunks
  br i1 %some, label %result, label %wait
result:
  %r = phi i64 [0, %fetch], [%r.next, %result]
  %size.at = getelementptr i64, ptr %bytes, i64 %r
  %size = load i64, ptr %size.at
  %start.times = mul i64 %size, %chunk
  %start = udiv i64 %start.times, %chunks
  %end.times = mul i64 %size, %chunk.end
  %end = udiv i64 %end.times, %chunks
  %length = sub i64 %end, %start
  %buffer = add i64 %r, $num_args
  %from.at = getelementptr ptr, ptr %data, i64 %buffer
  %from = load ptr, ptr %from.at
  %to = getelementptr i8, ptr %from, i64 %start
  call void @llvm.memset.p0.i64(ptr %to, i8 0, i64 %length, i1 false)
  %r.next = add i64 %r, 1
  %last = icmp eq i64 %r.next, $num_results
  br i1 %last, label %zeroed, label %result
zeroed:
  %counted = atomicrmw add ptr %filled.at, i64 1 release
  br label %fetch
wait:
  %filled = load atomic i64, ptr %filled.at acquire, align 8
  %all = icmp uge i64 %filled, %chunks
  br i1 %all, label %play, label %yield
yield:
  %yielded = call i32 @sched_yield()
  br label %wait
play:
  call void @work(ptr %job)
  ret void
}

; What a thread of the pool runs, perhaps long after the job's end: then only the job's own memory
; is still there. The fences order this against @close: either `next` is seen to be at its end, or
; @close sees this thread running and waits.
define internal void @task(ptr %job) {
entry:
  %running.at = getelementptr %Job, ptr %job, $running
  %before = atomicrmw add ptr %running.at, i64 1 seq_cst
  fence seq_cst
  %next.at = getelementptr %Job, ptr %job, $next
  %next = load atomic i64, ptr %next.at monotonic, align 8
  %total.at = getelementptr %Job, ptr %job, $total
  %total = load i64, ptr %total.at
  %late = icmp uge i64 %next, %total
  br i1 %late, label %leave, label %take
take:
  call void @share(ptr %job)
  br label %leave
leave:
  %after = atomicrmw sub ptr %running.at, i64 1 release
  call void @release(ptr %job)
  ret void
}

define internal void @release(ptr %job) {
entry:
  %refs.at = getelementptr %Job, ptr %job, $refs
  %before = atomicrmw sub ptr %refs.at, i64 1 acq_rel
  %last = icmp eq i64 %before, 1
  br i1 %last, label %end, label %done
end:
  call void @free(ptr %job)
  br label %done
done:
  ret void
}

; Waits for the threads that work, and ends the job.
define void @close(ptr %job) {
entry:
  fence seq_cst
  %running.at = getelementptr %Job, ptr %job, $running
  br label %wait
wait:
  %running = load atomic i64, ptr %running.at acquire, align 8
  %idle = icmp eq i64 %running, 0
  br i1 %idle, label %done, label %yield
yield:
  %yielded = call i32 @sched_yield()
  br label %wait
done:
  call void @release(ptr %job)
  ret void
}

; An axis of an XLA_FFI_Buffer, counted from the end.
define internal i64 @dim_from_end(ptr %buffer, i64 %number) {
  %rank.at = getelementptr i8, ptr %buffer, i64 $XLA_FFI_Buffer_rank
  %rank = load i64, ptr %rank.at
  %dims.at = getelementptr i8, ptr %buffer, i64 $XLA_FFI_Buffer_dims
  %dims = load ptr, ptr %dims.at
  %axis = sub i64 %rank, %number
  %dim.at = getelementptr i64, ptr %dims, i64 %axis
  %dim = load i64, ptr %dim.at
  ret i64 %dim
}

; The number of elements of an XLA_FFI_Buffer.
define internal i64 @elements(ptr %buffer) {
entry:
  %rank.at = getelementptr i8, ptr %buffer, i64 $XLA_FFI_Buffer_rank
  %rank = load i64, ptr %rank.at
  %dims.at = getelementptr i8, ptr %buffer, i64 $XLA_FFI_Buffer_dims
  %dims = load ptr, ptr %dims.at
  br label %axis
axis:
  %i = phi i64 [0, %entry], [%i.next, %times]
  %product = phi i64 [1, %entry], [%product.next, %times]
  %more = icmp slt i64 %i, %rank
  br i1 %more, label %times, label %done
times:
  %dim.at = getelementptr i64, ptr %dims, i64 %i
  %dim = load i64, ptr %dim.at
  %product.next = mul i64 %product, %dim
  %i.next = add i64 %i, 1
  br label %axis
done:
  ret i64 %product
}

define internal ptr @execute(ptr %frame) {
entry:
  %buffers = alloca [$num_buffers x ptr]
  %sizes = alloca [$num_results x i64]
  %args.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_args_args
  %args = load ptr, ptr %args.at
  %rets.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_rets_rets
  %rets = load ptr, ptr %rets.at
  call void @read_data(ptr %args, i64 $num_args, ptr %buffers)
  %ret.buffers = getelementptr ptr, ptr %buffers, i64 $num_args
  call void @read_data(ptr %rets, i64 $num_results, ptr %ret.buffers)
  br label %size
size:
  %r = phi i64 [0, %entry], [%r.next, %size]
  %ret.at = getelementptr ptr, ptr %rets, i64 %r
  %ret = load ptr, ptr %ret.at
  %elements = call i64 @elements(ptr %ret)
  %each.at = getelementptr i64, ptr @element_bytes, i64 %r
  %each = load i64, ptr %each.at
  %bytes = mul i64 %elements, %each
  %size.to = getelementptr i64, ptr %sizes, i64 %r
  store i64 %bytes, ptr %size.to
  %r.next = add i64 %r, 1
  %sized = icmp eq i64 %r.next, $num_results
  br i1 %sized, label %shapes, label %size
shapes:
  %threads.at = getelementptr ptr, ptr %args, i64 $threads_arg
  %threads = load ptr, ptr %threads.at
  %seeds = call i64 @elements(ptr %threads)
  %items.at = getelementptr ptr, ptr %args, i64 $items_arg
  %items = load ptr, ptr %items.at
  %episodes = call i64 @dim_from_end(ptr %items, i64 2)
  %steps.at = getelementptr ptr, ptr %rets, i64 $steps_ret
  %steps = load ptr, ptr %steps.at
  %horizon = call i64 @dim_from_end(ptr %steps, i64 2)
  %job = call ptr @open(ptr %buffers, ptr %sizes, i64 %seeds, i64 %episodes, i64 %horizon)
  %total.at = getelementptr %Job, ptr %job, $total
  %total = load i64, ptr %total.at
  %several = icmp ugt i64 %total, $lanes
  br i1 %several, label %help, label %play
help:
  %limit.at = getelementptr ptr, ptr %buffers, i64 $threads_arg
  %limit.data = load ptr, ptr %limit.at
  %limit = load i32, ptr %limit.data
  call void @call_helpers(ptr %frame, ptr %job, i32 %limit)
  br label %play
play:
  call void @share(ptr %job)
  call void @close(ptr %job)
  ret ptr null
}

; Puts a job on XLA's pool, once for each thread that has work besides the caller.
define internal void @call_helpers(ptr %frame, ptr %job, i32 %limit) {
entry:
  %pool = alloca i64
  %asking = alloca [4 x i64]
  %handing = alloca [5 x i64]
  %api.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_api
  %api = load ptr, ptr %api.at
  %ctx.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_ctx
  %ctx = load ptr, ptr %ctx.at
  %api.size = load i64, ptr %api
  %count.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_XLA_FFI_ThreadPool_NumThreads
  %known = icmp ugt i64 %api.size, $XLA_FFI_Api_XLA_FFI_ThreadPool_NumThreads
  br i1 %known, label %count, label %done
count:
  %schedule.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_XLA_FFI_ThreadPool_Schedule
  %schedule = load ptr, ptr %schedule.at
  %count.threads = load ptr, ptr %count.at
  store i64 0, ptr %pool
  store i64 32, ptr %asking
  %asking.extension = getelementptr i64, ptr %asking, i64 1
  store ptr null, ptr %asking.extension
  %asking.ctx = getelementptr i64, ptr %asking, i64 2
  store ptr %ctx, ptr %asking.ctx
  %asking.pool = getelementptr i64, ptr %asking, i64 3
  store ptr %pool, ptr %asking.pool
  %no.pool = call ptr %count.threads(ptr %asking)
  %refused = call i1 @refused(ptr %api, ptr %no.pool)
  br i1 %refused, label %done, label %divide
divide:
  %threads = load i64, ptr %pool
  %limit.64 = sext i32 %limit to i64
  %limited = icmp sgt i32 %limit, 0
  %most.asked = select i1 %limited, i64 %limit.64, i64 %threads
  %pool.less = icmp slt i64 %threads, %most.asked
  %most = select i1 %pool.less, i64 %threads, i64 %most.asked
  %total.at = getelementptr %Job, ptr %job, $total
  %total = load i64, ptr %total.at
  %total.up = add i64 %total, $lanes_less_1
  %groups = udiv i64 %total.up, $lanes
  %groups.less = icmp slt i64 %groups, %most
  %wanted = select i1 %groups.less, i64 %groups, i64 %most
  store i64 40, ptr %handing
  %handing.extension = getelementptr i64, ptr %handing, i64 1
  store ptr null, ptr %handing.extension
  %handing.ctx = getelementptr i64, ptr %handing, i64 2
  store ptr %ctx, ptr %handing.ctx
  %handing.task = getelementptr i64, ptr %handing, i64 3
  store ptr @task, ptr %handing.task
  %handing.job = getelementptr i64, ptr %handing, i64 4
  store ptr %job, ptr %handing.job
  %refs.at = getelementptr %Job, ptr %job, $refs
  br label %thread
thread:
  %t = phi i64 [1, %divide], [%t.next, %hand]
  %t.next = add i64 %t, 1
  %more = icmp slt i64 %t, %wanted
  br i1 %more, label %hand, label %done
hand:
  %held = atomicrmw add ptr %refs.at, i64 1 monotonic
  %not.taken = call ptr %schedule(ptr %handing)
  %failed = call i1 @refused(ptr %api, ptr %not.taken)
  br i1 %failed, label %take.back, label %thread
take.back:
  call void @release(ptr %job)
  br label %done
done:
  ret void
}

; Whether an API call returned an error; the error is ours to destroy.
define internal i1 @refused(ptr %api, ptr %error) {
entry:
  %argument = alloca [3 x i64]
  %fine = icmp eq ptr %error, null
  br i1 %fine, label %no, label %yes
no:
  ret i1 false
yes:
  store i64 24, ptr %argument
  %extension = getelementptr i64, ptr %argument, i64 1
  store ptr null, ptr %extension
  %error.to = getelementptr i64, ptr %argument, i64 2
  store ptr %error, ptr %error.to
  %destroy.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_XLA_FFI_Error_Destroy
  %destroy = load ptr, ptr %destroy.at
  call void %destroy(ptr %argument)
  ret i1 true
}

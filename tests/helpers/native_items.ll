; Each item of a job says which it is; native_items.py fills in the numbers of the job's fields.
define void @work(ptr %job) {
entry:
  %next.at = getelementptr %Job, ptr %job, i32 0, i32 NEXT
  %total.at = getelementptr %Job, ptr %job, i32 0, i32 TOTAL
  %total = load i64, ptr %total.at
  %episodes.at = getelementptr %Job, ptr %job, i32 0, i32 EPISODES
  %episodes = load i64, ptr %episodes.at
  %horizon.at = getelementptr %Job, ptr %job, i32 0, i32 HORIZON
  %horizon = load i64, ptr %horizon.at
  %data.at = getelementptr %Job, ptr %job, i32 0, i32 DATA
  %data = load ptr, ptr %data.at
  %limits = load ptr, ptr %data
  %expected.at = getelementptr ptr, ptr %data, i64 3
  %expected.data = load ptr, ptr %expected.at
  %expected = load i32, ptr %expected.data
  %reward.at = getelementptr ptr, ptr %data, i64 6
  %reward = load ptr, ptr %reward.at
  %length.at = getelementptr ptr, ptr %data, i64 7
  %length = load ptr, ptr %length.at
  %simulated.at = getelementptr ptr, ptr %data, i64 9
  %simulated = load ptr, ptr %simulated.at
  %entered = atomicrmw add ptr %simulated, i32 1 monotonic
  br label %fetch
fetch:
  %k = atomicrmw add ptr %next.at, i64 1 monotonic
  %some = icmp ult i64 %k, %total
  br i1 %some, label %look, label %done
look:
  %limit.at = getelementptr i32, ptr %limits, i64 %k
  %flag = load i32, ptr %limit.at
  %skipped = icmp eq i32 %flag, 0
  br i1 %skipped, label %fetch, label %wait
wait:
  %tries = phi i64 [0, %look], [%tried, %yield]
  %threads = load atomic i32, ptr %simulated monotonic, align 4
  %all = icmp sge i32 %threads, %expected
  %patient = icmp ult i64 %tries, 20000
  %not.all = xor i1 %all, true
  %go.on = and i1 %not.all, %patient
  br i1 %go.on, label %yield, label %play
yield:
  %tried = add i64 %tries, 1
  %yielded = call i32 @sched_yield()
  br label %wait
play:
  %seed = udiv i64 %k, %episodes
  %episode = urem i64 %k, %episodes
  %one.up = add i64 %k, 1
  %named = trunc i64 %one.up to i32
  %length.to = getelementptr i32, ptr %length, i64 %k
  store i32 %named, ptr %length.to
  %value = sitofp i64 %one.up to float
  %rows.before = mul i64 %seed, %horizon
  %rows.to = add i64 %rows.before, %horizon
  %last.row = sub i64 %rows.to, 1
  %steps = mul i64 %last.row, %episodes
  %step = add i64 %steps, %episode
  %reward.to = getelementptr float, ptr %reward, i64 %step
  store float %value, ptr %reward.to
  br label %fetch
done:
  ret void
}

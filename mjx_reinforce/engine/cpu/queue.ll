; How a lane begins and ends an episode; kernel.py fills in what stands after a dollar sign.

; Copies numbers into a lane's column: the vectors of all lanes lie one after the other.
define internal void @copy4(ptr %to, ptr %from, i64 %count) {
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%following, %body]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %end
body:
  %source = getelementptr inbounds i32, ptr %from, i64 %i
  %x = load i32, ptr %source
  %k = mul i64 %i, $lanes
  %target = getelementptr inbounds i32, ptr %to, i64 %k
  store i32 %x, ptr %target
  %following = add i64 %i, 1
  br label %head
end:
  ret void
}

define internal void @copy8(ptr %to, ptr %from, i64 %count) {
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%following, %body]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %end
body:
  %source = getelementptr inbounds i64, ptr %from, i64 %i
  %x = load i64, ptr %source
  %k = mul i64 %i, $lanes
  %target = getelementptr inbounds i64, ptr %to, i64 %k
  store i64 %x, ptr %target
  %following = add i64 %i, 1
  br label %head
end:
  ret void
}

declare i32 @llvm.abs.i32(i32, i1)

; Gives a lane the next episode that is played, if there is one.
define internal void @begin(ptr %job, ptr %memory, i64 %lane) {
entry:
  %next = getelementptr inbounds %Job, ptr %job, $next
  %total.at = getelementptr inbounds %Job, ptr %job, $total
  %total = load i64, ptr %total.at
  %data.at = getelementptr inbounds %Job, ptr %job, $data
  %data = load ptr, ptr %data.at
  %limits.at = getelementptr inbounds ptr, ptr %data, i64 $limits_arg
  %limits = load ptr, ptr %limits.at
  ${alive_at}
  ${seed_at}
  %old = load i64, ptr %seed.at
  br label %fetch
fetch:
  %number = atomicrmw add ptr %next, i64 1 monotonic
  %some = icmp ult i64 %number, %total
  br i1 %some, label %look, label %none
look:
  %signed.at = getelementptr inbounds i32, ptr %limits, i64 %number
  %signed = load i32, ptr %signed.at
  %skipped = icmp eq i32 %signed, $not_played
  br i1 %skipped, label %fetch, label %fill
none:
  store i32 0, ptr %alive.at
  %never = icmp eq i64 %old, -1
  %any = icmp ne i64 %total, 0
  %unset = and i1 %never, %any
  br i1 %unset, label %fill, label %end
fill:
  ; A lane without an episode has the values of one, so that it computes nothing unheard of.
  %item = phi i64 [%number, %look], [0, %none]
  %kind = phi i32 [%signed, %look], [$not_played, %none]
  %runs = icmp ne i32 %kind, $not_played
  %alive = zext i1 %runs to i32
  store i32 %alive, ptr %alive.at
  %is.mode = icmp slt i32 %kind, 0
  %flag = zext i1 %is.mode to i32
  ${deterministic_at}
  store i32 %flag, ptr %mode.lane
  %limit = call i32 @llvm.abs.i32(i32 %kind, i1 false)
  ${limit_at}
  store i32 %limit, ptr %limit.at
  ${step_at}
  store i32 0, ptr %step.at
  %episodes.at = getelementptr inbounds %Job, ptr %job, $episodes
  %episodes = load i64, ptr %episodes.at
  %index = udiv i64 %item, %episodes
  %episode = urem i64 %item, %episodes
  ${episode_at}
  store i64 %episode, ptr %episode.at
  store i64 %index, ptr %seed.at
  %same = icmp eq i64 %old, %index
  br i1 %same, label %state, label %actor
actor:
$copy_actor
  br label %state
state:
$copy_state
  br label %end
end:
  ret void
}

; Writes down how the episode of a lane ended, and gives the lane the next one.
define internal void @finish(ptr %job, ptr %memory, i64 %lane) {
entry:
  ${seed_at}
  %index = load i64, ptr %seed.at
  ${episode_at}
  %number = load i64, ptr %episode.at
  %episodes.at = getelementptr inbounds %Job, ptr %job, $episodes
  %episodes = load i64, ptr %episodes.at
  %data.at = getelementptr inbounds %Job, ptr %job, $data
  %data = load ptr, ptr %data.at
  %before = mul i64 %index, %episodes
  %row = add i64 %before, %number
  ${step_at}
  %steps = load i32, ptr %step.at
  %lengths.at = getelementptr inbounds ptr, ptr %data, i64 $length_data
  %lengths = load ptr, ptr %lengths.at
  %length.at = getelementptr inbounds i32, ptr %lengths, i64 %row
  store i32 %steps, ptr %length.at
  ${broken_at}
  %broke = load i32, ptr %broken.at
  %flags.at = getelementptr inbounds ptr, ptr %data, i64 $broken_data
  %flags = load ptr, ptr %flags.at
  %flag.at = getelementptr inbounds i32, ptr %flags, i64 %row
  store i32 %broke, ptr %flag.at
  ${counted_at}
  %counted = load i64, ptr %counted.at
  %own = sext i32 %steps to i64
  %counted.next = add i64 %counted, %own
  store i64 %counted.next, ptr %counted.at
  call void @count(ptr %data, i64 %index, i32 %steps)
  call void @begin(ptr %job, ptr %memory, i64 %lane)
  ret void
}

; Counts what a lane without an episode simulated for its last seed, after so many steps of all.
define internal void @settle(ptr %job, ptr %memory, i64 %lane, i64 %iterations) {
entry:
  ${counted_at}
  %counted = load i64, ptr %counted.at
  %never = icmp eq i64 %counted, 0
  br i1 %never, label %end, label %add
add:
  %waited = sub i64 %iterations, %counted
  %steps = trunc i64 %waited to i32
  ${seed_at}
  %index = load i64, ptr %seed.at
  %data.at = getelementptr inbounds %Job, ptr %job, $data
  %data = load ptr, ptr %data.at
  call void @count(ptr %data, i64 %index, i32 %steps)
  br label %end
end:
  ret void
}

; Adds to the simulated steps of a seed.
define internal void @count(ptr %data, i64 %index, i32 %steps) {
  %simulated.at = getelementptr inbounds ptr, ptr %data, i64 $simulated_data
  %simulated = load ptr, ptr %simulated.at
  %own = getelementptr inbounds i32, ptr %simulated, i64 %index
  %before = atomicrmw add ptr %own, i32 %steps monotonic
  ret void
}

; How a lane begins and ends an episode; queue.py fills in what stands after a dollar sign.

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

; Gives a lane the next episode, if there is one.
define internal void @begin(ptr %job, ptr %memory, i64 %lane) {
entry:
  %next = getelementptr inbounds %Job, ptr %job, $next
  %number = atomicrmw add ptr %next, i64 1 monotonic
  %total.at = getelementptr inbounds %Job, ptr %job, $total
  %total = load i64, ptr %total.at
  %some = icmp ult i64 %number, %total
  %alive = zext i1 %some to i32
  ${alive_at}
  store i32 %alive, ptr %alive.at
  ${seed_at}
  %old = load i64, ptr %seed.at
  %never = icmp eq i64 %old, -1
  %any = icmp ne i64 %total, 0
  %unset = and i1 %never, %any
  %load = or i1 %some, %unset
  br i1 %load, label %fill, label %end
fill:
  ; A lane without an episode has the values of one, so that it computes nothing unheard of.
  %item = select i1 %some, i64 %number, i64 0
  %episodes.at = getelementptr inbounds %Job, ptr %job, $episodes
  %episodes = load i64, ptr %episodes.at
  %active.at = getelementptr inbounds %Job, ptr %job, $active
  %active = load ptr, ptr %active.at
  %data.at = getelementptr inbounds %Job, ptr %job, $data
  %data = load ptr, ptr %data.at
  %k = udiv i64 %item, %episodes
  %chosen = getelementptr inbounds i64, ptr %active, i64 %k
  %index = load i64, ptr %chosen
  %episode = urem i64 %item, %episodes
  %before = mul i64 %index, %episodes
  %row = add i64 %before, %episode
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
  %modes.at = getelementptr inbounds ptr, ptr %data, i64 $deterministic_arg
  %modes = load ptr, ptr %modes.at
  %mode.at = getelementptr inbounds i32, ptr %modes, i64 %index
  %mode = load i32, ptr %mode.at
  %limit = sext i32 %mode to i64
  %below = icmp slt i64 %episode, %limit
  %flag = zext i1 %below to i32
  ${deterministic_at}
  store i32 %flag, ptr %mode.lane
  ${step_at}
  store i32 0, ptr %step.at
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
  call void @begin(ptr %job, ptr %memory, i64 %lane)
  ret void
}

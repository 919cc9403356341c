// The teams of a block on a GPU. Its warps are in groups, and a group begins each step of the
// physics together, so that it fetches the step's code, which is larger than the caches near a
// scheduler, once. With one group all would wait for memory at the same time.
#pragma once
#ifdef __CUDACC__
constexpr int GROUPS = 2, WHOLE = 32 / W;
constexpr int FITTING = int((SHARED - sizeof(Fixed) - 16) / sizeof(State)) / WHOLE * WHOLE;
constexpr int TEAMS = FITTING < WARPS * WHOLE ? FITTING : WARPS * WHOLE;
static_assert(TEAMS > 0, "the state of a team does not fit into shared memory");

// Waits for all teams of the group. Returns whether one has the flag set.
DEV bool Team::meet(bool flag) const {
  if (!meets) return flag;
  const int group = threadIdx.x / 32 % GROUPS, warps = min(TEAMS / WHOLE, int(blockDim.x) / 32);
  int some;
  asm volatile(
      "{.reg .pred p, q; setp.ne.s32 p, %1, 0;"
      " barrier.red.or.pred q, %2, %3, p; selp.s32 %0, 1, 0, q;}"
      : "=r"(some)
      : "r"(int(flag)), "r"(1 + group), "r"(32 * ((warps - group + GROUPS - 1) / GROUPS))
      : "memory");
  return some;
}
#endif

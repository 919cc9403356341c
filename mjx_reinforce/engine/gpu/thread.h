// A thread of a GPU that plays an episode by itself, and where it meets the others of its block.
#pragma once
#ifdef __CUDACC__
typedef decltype(sizeof(0)) size_t;
#define KERNEL __global__ void __launch_bounds__(WARPS * 32, BLOCKS)
struct Player {
  static constexpr int lane = 0;
  // Waits for all threads of the block; returns whether one has the flag set. Those of a warp come
  // together first: where they came to a barrier one by one, an H200 waited forever.
  DEV bool meet(bool flag) const {
    int some;
    asm volatile(
        "{.reg .pred p, q; setp.ne.s32 p, %1, 0; bar.warp.sync 0xffffffff;"
        " bar.red.or.pred q, 0, p; selp.s32 %0, 1, 0, q;}"
        : "=r"(some)
        : "r"(int(flag)));
    return some;
  }
  DEV void gather() const { asm volatile("bar.warp.sync 0xffffffff; bar.sync 0;"); }
  DEV void sync() const {}
  DEV int next(int* counter) const { return atomicAdd(counter, 1); }
  DEV void add(int* sum, int x) const { atomicAdd(sum, x); }
  // The items of a function that is mapped.
  DEV int first() const { return blockIdx.x * blockDim.x + threadIdx.x; }
  DEV int stride() const { return gridDim.x * blockDim.x; }
};
#endif
#define OWN_PLACE const Player t;

// Neighbors that are loaded at once.
template <class T, int N> struct alignas(N * sizeof(T)) Group { T x[N]; };

// A count, which begins anew.
DEV int taken(int& count) {
  const int before = count;
  count = 0;
  return before;
}

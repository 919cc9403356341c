// A team of W lanes that plays one episode: on a GPU a part of a warp, on a CPU one lane (W = 1).
#pragma once
#ifdef __CUDACC__
#define DEV __device__ __forceinline__
#define CALL static __device__ __noinline__
#define UNROLL _Pragma("unroll")
#define LOOP _Pragma("unroll 1")
#define TABLE static __device__ const
typedef float real;
#else
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#define DEV inline
#define CALL static inline
#define UNROLL
#define LOOP
#define TABLE static const
#ifndef REAL
#define REAL double
#endif
typedef REAL real;
using std::atan2;
using std::fabs;
using std::memcpy;
using std::pow;
using std::sqrt;
#endif
#ifndef W
#define W 1
#endif
// Whether a compiler is to make vectors of the loops of the only lane; see vectors.h.
#ifndef VECTORS
#define VECTORS 0
#endif
static_assert(W == 1 || !VECTORS, "several lanes are no vectors");
// The items of n that are this lane's.
#define EACH(i, n) for (int i = lane; i < (n); i += W)

// Four numbers that are loaded and stored at once.
struct alignas(4 * sizeof(real)) Quad { real x[4]; };

// So many items, or no place at all.
template <class T, int COUNT> struct Some {
  T items[COUNT];
  DEV T& operator[](int i) { return items[i]; }
  DEV const T& operator[](int i) const { return items[i]; }
};
template <class T> struct Some<T, 0> {
  DEV T& operator[](int) const { return *reinterpret_cast<T*>(size_t(this)); }
};

constexpr bool SINGLE = sizeof(real) == 4;

#ifdef __CUDACC__
struct Team {
  unsigned mask;
  int lane;
  bool meets = true;  // whether other teams come to each meeting, too
  DEV Team() {
    const int place = threadIdx.x & 31;
    lane = place % W;
    mask = (W == 32 ? 0xffffffffu : (1u << (W & 31)) - 1) << (place - lane);
  }
  // The same team; what depends on the lane is computed anew, rather than kept on the stack.
  DEV Team anew() const {
    Team t = *this;
    asm volatile("" : "+r"(t.lane));
    t.lane &= W - 1;
    return t;
  }
  // The same team where others may not come: in a branch.
  DEV Team alone() const {
    Team t = *this;
    t.meets = false;
    return t;
  }
  DEV bool meet(bool flag = false) const;
  DEV void sync() const { __syncwarp(mask); }
  DEV bool any(bool flag) const { return __any_sync(mask, flag); }
  // One bit a lane.
  DEV unsigned ballot(bool flag) const {
    const unsigned all = __ballot_sync(mask, flag) >> ((threadIdx.x & 31) - lane);
    return W == 32 ? all : all & ((1u << (W & 31)) - 1);
  }
  // The lanes add in different orders: lane 0's sum is everybody's, so that no loop splits a team.
  DEV real sum(real x) const {
    UNROLL for (int o = W / 2; o; o /= 2) x += __shfl_xor_sync(mask, x, o, W);
    return __shfl_sync(mask, x, 0, W);
  }
  template <class T> DEV T from(T x, int other) const { return __shfl_sync(mask, x, other, W); }
};
DEV int count(unsigned bits) { return __popc(bits); }
DEV real root(real x) { return sqrtf(x); }
DEV real inverse_root(real x) { return rsqrtf(x); }
// In parts of pi, which needs no local memory; sincosf does, for its large angles.
DEV void sine_cosine(real x, real& s, real& c) { sincospif(x * real(0.3183098861837907), &s, &c); }
#else
struct Team {
  int lane = 0;
  Team anew() const { return *this; }
  Team alone() const { return *this; }
  bool meet(bool flag = false) const { return flag; }
  void sync() const {}
  bool any(bool flag) const { return flag; }
  unsigned ballot(bool flag) const { return flag; }
  real sum(real x) const { return x; }
  template <class T> T from(T x, int) const { return x; }
};
inline int count(unsigned bits) { return __builtin_popcount(bits); }
inline real root(real x) { return sqrt(x); }
inline real inverse_root(real x) { return 1 / sqrt(x); }
inline void sine_cosine(real x, real& s, real& c) { s = std::sin(x); c = std::cos(x); }
#endif

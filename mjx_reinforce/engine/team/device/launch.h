// Where a team is, and what it shares with others: on a GPU, or as the only one in a program for a
// CPU.
#pragma once
typedef unsigned Word;
typedef decltype(sizeof(0)) size_t;
static_assert(FAR * sizeof(Contact) <= sizeof(real) * (FAR_WORDS), "no room for far contacts");

#ifdef __CUDACC__
#define KERNEL __global__ void __launch_bounds__(WARPS * 32, 1)
__device__ const Fixed FIXED MODEL_INIT;
struct Shared { Fixed m; State s[TEAMS]; };
static_assert(sizeof(Shared) <= SHARED, "the teams do not fit into shared memory");
extern __shared__ __align__(16) char shared_bytes[];

struct Player : Team {
  DEV int next(int* counter) const {
    int k = 0;
    if (lane == 0) k = atomicAdd(counter, 1);
    return __shfl_sync(mask, k, 0, W);
  }
  DEV bool some(bool flag) const { return __any_sync(0xffffffffu, flag); }  // of the warp
  // Goes to so many meetings, for a warp that has nothing to play.
  DEV void attend(int meetings) const { LOOP for (int n = 0; n < meetings; n++) meet(); }
  DEV void add(int* sum, int x) const { atomicAdd(sum, x); }
  // The items of a function that is mapped.
  DEV int stride() const { return gridDim.x * min(TEAMS, int(blockDim.x) / W); }
  DEV int first() const { return threadIdx.x / W * gridDim.x + blockIdx.x; }
};
#define OWN_PLACE                                                                           \
  Shared& shared = *reinterpret_cast<Shared*>(shared_bytes);                                 \
  for (int i = threadIdx.x; i < int(sizeof(Fixed) / 4); i += blockDim.x)                     \
    reinterpret_cast<int*>(&shared.m)[i] = reinterpret_cast<const int*>(&FIXED)[i];          \
  __syncthreads();                                                                          \
  const int team = threadIdx.x / W;                                                         \
  if (team >= TEAMS) return;                                                                \
  State& s = shared.s[team];                                                                \
  const Player t;                                                                           \
  const int lane = t.lane;                                                                  \
  const Model& M = model_of(shared.m, s, lane);                                             \
  scratch += size_t(blockIdx.x * (blockDim.x / W) + team) * (THREAD_WORDS * W);               \
  s.far = reinterpret_cast<Contact*>(scratch);                                              \
  scratch += FAR_WORDS;
#else
#define KERNEL void
static const Fixed FIXED MODEL_INIT;
struct Player : Team {
  int next(int* counter) const { return __atomic_fetch_add(counter, 1, __ATOMIC_RELAXED); }
  bool some(bool flag) const { return flag; }
  void attend(int) const {}
  void add(int* sum, int x) const { *sum += x; }
  int stride() const { return 1; }
  int first() const { return 0; }
};
// Memory of one thread, until its block ends.
template <class T> struct Room {
  T* item;
  explicit Room(size_t count)
      : item(static_cast<T*>(aligned_alloc(64, (count * sizeof(T) + 63) / 64 * 64))) {}
  ~Room() { free(item); }
};
#define OWN_PLACE                        \
  const Room<State> state_room(1);       \
  const Room<Contact> far_room(FAR + 1); \
  State& s = *state_room.item;           \
  s.far = far_room.item;                 \
  const Player t;                        \
  const int lane = 0;           \
  const Model& M = model_of(FIXED, s, lane);
#endif

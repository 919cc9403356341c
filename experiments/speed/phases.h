// Cycles and events of the phases of a step of teams, which phases.py writes into the device code.
// At the end of a phase, the first of the lanes that are there adds the cycles since the last end
// in its warp: where a warp's lanes go separate ways, each way counts its own cycles. Counters are
// in memory, one set for each block, so that blocks do not wait for one another.
__device__ unsigned long long phase_cycles[PHASE_BLOCKS][PHASES], phase_events[PHASE_BLOCKS][EVENTS];
__shared__ unsigned phase_began[32];

static __device__ __forceinline__ unsigned phase_clock() {
  unsigned now;
  asm volatile("mov.u32 %0, %%clock;" : "=r"(now) : : "memory");
  return now;
}
static __device__ __forceinline__ void phase_end(int phase) {
  if (int(threadIdx.x & 31) != __ffs(__activemask()) - 1) return;
  volatile unsigned& began = phase_began[threadIdx.x / 32];
  const unsigned now = phase_clock();
  atomicAdd(phase_cycles[blockIdx.x % PHASE_BLOCKS] + phase, (unsigned long long)(now - began));
  began = phase_clock();
}
static __device__ __forceinline__ void phase_event(int event, int times) {
  atomicAdd(phase_events[blockIdx.x % PHASE_BLOCKS] + event, (unsigned long long)times);
}
static __device__ __forceinline__ void phase_begin() {
  phase_began[threadIdx.x / 32] = phase_clock();
}

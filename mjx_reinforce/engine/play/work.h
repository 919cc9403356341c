// What is around a kernel of one lane on a CPU: before it what C++ has on a GPU alone, behind it
// what a thread of a job does (handler.py); cxx.py fills in how that calls the kernel.
#include <cmath>

// The inverse of the error function, from M. Giles, Approximating the erfinv function (2012), as in
// XLA.
static inline float erfinvf(float x) {
  constexpr float CENTRAL[] = {2.81022636e-08f, 3.43273939e-07f,  -3.5233877e-06f,
                               -4.39150654e-06f, 2.1858087e-04f,  -1.25372503e-03f,
                               -4.17768164e-03f, 0.246640727f,    1.50140941f};
  constexpr float TAIL[] = {-2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f,
                            -3.67342844e-03f, 5.73950773e-03f, -7.6224613e-03f,
                            9.43887047e-03f,  1.00167406f,     2.83297682f};
  const float w = -log1pf(-x * x);
  const bool is_central = w < 5;
  const float y = is_central ? w - 2.5f : sqrtf(w) - 3, *factors = is_central ? CENTRAL : TAIL;
  float sum = factors[0];
  for (int k = 1; k < 9; k++) sum = factors[k] + sum * y;
  return fabsf(x) == 1 ? x * INFINITY : sum * x;
}
// The kernel.
// The data of an argument or a result.
struct Buffer {
  void* data;
  template <class T> operator T*() const { return static_cast<T*>(data); }
  Buffer behind(long long bytes) const { return {static_cast<char*>(data) + bytes}; }
};
// %Job of handler.ll.
struct Job {
  long long refs, running, next, total, episodes, horizon;
  const Buffer* buffers;
};
extern "C" __attribute__((visibility("hidden"))) void work_here(Job* job) {
  const Buffer* buffers = job->buffers;
  const Room<Word> room(THREAD_WORDS);
// calls
}

// What a thread of a job (handler.py) does with a kernel for one lane.
#include <cmath>

// The inverse of the error function as XLA has it, by Giles' polynomials.
static inline float erfinvf(float x) {
  const float w = -log1pf(-x * x);
  const bool is_small = w < 5;
  const float y = is_small ? w - 2.5f : sqrtf(w) - 3;
  const float small[] = {2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f,
                         2.1858087e-04f, -1.25372503e-03f, -4.17768164e-03f, 0.246640727f,
                         1.50140941f};
  const float large[] = {-2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f, -3.67342844e-03f,
                         5.73950773e-03f, -7.6224613e-03f, 9.43887047e-03f, 1.00167406f,
                         2.83297682f};
  const float* factors = is_small ? small : large;
  float sum = factors[0];
  for (int k = 1; k < 9; k++) sum = factors[k] + sum * y;
  return fabsf(x) == 1 ? x * INFINITY : sum * x;
}
struct Any {
  void* place;
  template <class T> operator T*() const { return static_cast<T*>(place); }
  Any from(long long bytes) const { return {static_cast<char*>(place) + bytes}; }
};
struct Job {
  long long refs, running, next, total, episodes, horizon;
  const Any* data;
};
#define CALLED extern "C" __attribute__((visibility("hidden"))) void

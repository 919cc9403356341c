// The operations of the scalar graph that are not plain C++, and the layers of a network.
#pragma once

template <class To, class From>
DEV To bits(From x) {
  static_assert(sizeof(To) == sizeof(From), "a bit pattern keeps its size");
  union { From from; To to; } both;
  both.from = x;
  return both.to;
}
template <class T> DEV T larger(T x, T y) { return x > y || x != x ? x : y; }
template <class T> DEV T smaller(T x, T y) { return x < y || x != x ? x : y; }
DEV float divide(float x, float y) { return x / y; }
DEV double divide(double x, double y) { return x / y; }
// By an integer zero as XLA: all bits set, and of the rest the dividend.
DEV int divide(int x, int y) { return y == 0 ? -1 : y == -1 ? int(0u - unsigned(x)) : x / y; }
DEV unsigned divide(unsigned x, unsigned y) { return y == 0 ? ~0u : x / y; }
DEV float rest(float x, float y) { return fmodf(x, y); }
DEV double rest(double x, double y) { return fmod(x, y); }
DEV int rest(int x, int y) { return y == 0 ? x : y == -1 ? 0 : x % y; }
DEV unsigned rest(unsigned x, unsigned y) { return y == 0 ? x : x % y; }
DEV float rsqrt_of(float x) { return 1 / sqrtf(x); }
DEV double rsqrt_of(double x) { return 1 / sqrt(x); }
DEV float logistic(float x) { return 1 / (1 + expf(-x)); }
DEV double logistic(double x) { return 1 / (1 + exp(-x)); }
template <class T> DEV T sign_of(T x) { return x > 0 ? T(1) : x < 0 ? T(-1) : x; }
DEV bool is_finite(float x) { return fabsf(x) <= 3.40282347e38f; }
DEV bool is_finite(double x) { return fabs(x) <= 1.7976931348623157e308; }
typedef unsigned long long Long;
// By as many bits as there are, or more, nothing is left but copies of the sign.
DEV unsigned left(unsigned x, unsigned by) { return by < 32 ? x << by : 0; }
DEV int left(int x, int by) { return int(left(unsigned(x), unsigned(by))); }
DEV Long left(Long x, Long by) { return by < 64 ? x << by : 0; }
DEV unsigned right(unsigned x, unsigned by) { return by < 32 ? x >> by : 0; }
DEV int right(int x, int by) { return int(right(unsigned(x), unsigned(by))); }
DEV Long right(Long x, Long by) { return by < 64 ? x >> by : 0; }
DEV int right_signed(int x, int by) { return x >> (unsigned(by) < 32 ? by : 31); }
DEV float tanh_of(float x) { return tanhf(x); }
DEV double tanh_of(double x) { return tanh(x); }

// out[u] = bias[u] + x . kernel[:, u], a unit a lane; the sum is in two chains, in order.
template <bool TANH, class T, class P>
DEV void layer(const Team& t, const T* x, const P* kernel, const P* bias, int inputs, int units,
               T* out) {
  for (int u = t.lane; u < units; u += W) {
    T even = bias[u], odd = 0;
    int i = 0;
    for (; i + 1 < inputs; i += 2) {
      even += x[i] * kernel[i * units + u];
      odd += x[i + 1] * kernel[(i + 1) * units + u];
    }
    if (i < inputs) even += x[i] * kernel[i * units + u];
    out[u] = TANH ? tanh_of(even + odd) : even + odd;
  }
}

// A team of W lanes on a CPU: each has its own stack and runs until the next sync, where the next
// lane goes on. The order is another one each time, so that a race or a missing sync shows as an
// error, and lanes that do not come to the same sync end the program.
#include <cstdlib>
#include <ucontext.h>

struct Turns {
  ucontext_t lane[W], main;
  char stack[W][1 << 19], given[W][8];
  bool over[W];
  int current;
  unsigned seed = 1;
  void (*act)();

  static void enter();
  void wait() { swapcontext(&lane[current], &main); }
  int below(int n) {
    seed = seed * 1664525u + 1013904223u;
    return int((seed >> 8) % unsigned(n));
  }
  void run(void (*what)()) {
    act = what;
    for (int k = 0; k < W; k++) {
      getcontext(&lane[k]);
      lane[k].uc_stack.ss_sp = stack[k];
      lane[k].uc_stack.ss_size = sizeof stack[k];
      makecontext(&lane[k], enter, 0);
      over[k] = false;
    }
    for (int ended = 0; ended < W;) {
      int order[W];
      for (int k = 0; k < W; k++) {
        const int other = below(k + 1);
        order[k] = order[other];
        order[other] = k;
      }
      ended = 0;
      for (int k : order) {
        current = k;
        if (!over[k]) swapcontext(&main, &lane[k]);
        ended += over[k];
      }
      if (ended % W) abort();
    }
  }
};
static Turns turns;
void Turns::enter() {
  turns.act();
  turns.over[turns.current] = true;
  turns.wait();
}

struct Team {
  int lane = turns.current;
  Team anew() const { return *this; }
  bool meet(bool flag = false) const { return flag; }
  void sync() const { turns.wait(); }
  template <class T> T from(T x, int other) const {
    memcpy(turns.given[lane], &x, sizeof x);
    sync();
    memcpy(&x, turns.given[other], sizeof x);
    sync();
    return x;
  }
  real sum(real x) const {
    real all = 0;
    for (int k = 0; k < W; k++) all += from(x, k);
    return all;
  }
  unsigned ballot(bool flag) const {
    unsigned all = 0;
    for (int k = 0; k < W; k++) all |= unsigned(from(flag, k)) << k;
    return all;
  }
  bool any(bool flag) const { return ballot(flag); }
};

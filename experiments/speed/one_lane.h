// Plays env steps of many episodes, one after the other, in the memory that it is given.
static const Fixed FIXED MODEL_INIT;
struct Memory {
  State s;
  Contact far[FAR + 1];
};

extern "C" int memory_size() { return sizeof(Memory); }

// qpos [episodes, NQ] and qvel [episodes, NV] become those of the end; the warm start begins at
// zero. ctrl is [episodes, env_steps, NU], and each env step has `skip` physics steps.
extern "C" void play_episodes(void* memory, int episodes, int env_steps, int skip, double* qpos,
                              double* qvel, const double* ctrl) {
  State& s = static_cast<Memory*>(memory)->s;
  s.far = static_cast<Memory*>(memory)->far;
  const Team t;
  const Model& M = model_of(FIXED, s, t.lane);
  for (int e = 0; e < episodes; e++, qpos += NQ, qvel += NV) {
    for (int i = 0; i < NQ; i++) s.qpos[i] = real(qpos[i]);
    for (int i = 0; i < NV; i++) s.qvel[i] = real(qvel[i]);
    for (int i = 0; i < NV; i++) s.qacc_warmstart[i] = 0;
    for (int n = 0; n < env_steps; n++, ctrl += NU) {
      for (int i = 0; i < NU; i++) s.ctrl[i] = real(ctrl[i]);
      physics(t, M, s, skip);
    }
    for (int i = 0; i < NQ; i++) qpos[i] = double(s.qpos[i]);
    for (int i = 0; i < NV; i++) qvel[i] = double(s.qvel[i]);
  }
}

// Plays physics steps of float64 and writes down what they report.
static const Fixed FIXED MODEL_INIT;
static State s;
static Contact far[FAR + 1];
static int steps;
static bool sound;
static const double* drawn_numbers;
static void play() {
  const Team t;
  const int lane = t.lane;
  const Model& M = model_of(FIXED, s, lane);
  t.sync();
  draw(M, s, drawn_numbers, lane);
  t.sync();
  const bool is_sound = physics(t, M, s, steps);
  if (lane == 0) sound = is_sound;
}

extern "C" int play_steps(double* qpos, double* qvel, double* qacc, const double* ctrl,
                          const double* drawn, int skip, double* out) {
  drawn_numbers = drawn;
  s.far = far;
  steps = skip;
  for (int i = 0; i < NQ; i++) s.qpos[i] = qpos[i];
  for (int i = 0; i < NV; i++) s.qvel[i] = qvel[i];
  for (int i = 0; i < NV; i++) s.qacc_warmstart[i] = qacc[i];
  for (int i = 0; i < NU; i++) s.ctrl[i] = ctrl[i];
  RUN;
  for (int i = 0; i < NQ; i++) qpos[i] = s.qpos[i];
  for (int i = 0; i < NV; i++) qvel[i] = s.qvel[i];
  for (int i = 0; i < NV; i++) qacc[i] = s.qacc_warmstart[i];
  for (int i = 0; i < 3 * NB; i++) *out++ = s.xpos[i];
  for (int i = 0; i < 3 * NB; i++) *out++ = s.xipos[i];
  for (int i = 0; i < 10 * NB; i++) *out++ = s.cinert[i];
  for (int i = 0; i < 6 * NB; i++) *out++ = s.cvel[i];
  for (int i = 0; i < 6 * NB; i++) *out++ = s.cfrc_ext[i];
  for (int i = 0; i < NV; i++) *out++ = s.qfrc_actuator[i];
  for (int i = 0; i < NQ; i++) *out++ = s.pass_qpos[i];
  for (int i = 0; i < NV; i++) *out++ = s.pass_qvel[i];
  for (int i = 0; i < NV; i++) *out++ = s.pass_qacc[i];
  for (int i = 0; i < NTOUCH; i++) *out++ = s.touch[i];
  return sound;
}

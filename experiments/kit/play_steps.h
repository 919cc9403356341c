// Plays physics steps of float64 and writes down what they report.
static const Model MODEL MODEL_INIT;
static State s;
static Contact far[FAR + 1];
static int steps;
static bool sound;
static void play() { sound = physics(Team(), MODEL, s, steps); }

extern "C" int play_steps(double* qpos, double* qvel, double* qacc, const double* ctrl, int skip,
                          double* out) {
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

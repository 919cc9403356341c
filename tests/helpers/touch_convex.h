// The contacts that convex.h finds of a model's first item, after the physics' text and scalar.h's.
static const Fixed FIXED MODEL_INIT;
static State s;

// Writes distance, place and frame of each; returns how many.
extern "C" int touch(const double* qpos, double* out) {
  const Team t;
  const Model& M = model_of(FIXED, s, t.lane);
  for (int i = 0; i < NQ; i++) s.qpos[i] = qpos[i];
  place_fixed(t, M, s);
  place_links(t, M, s);
  place_geoms(t, M, s);
  Touch touches[MOST_TOUCHES];
  const int contacts = touch_convex(M, s, 0, M.kind_margin[M.item_kind[0]], touches);
  for (int n = 0; n < contacts; n++) {
    real frame[9];
    make_frame(frame, touches[n]);
    *out++ = touches[n].distance;
    for (int k = 0; k < 3; k++) *out++ = touches[n].at[k];
    for (int k = 0; k < 9; k++) *out++ = frame[k];
  }
  return contacts;
}

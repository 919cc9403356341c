// A step of MuJoCo (mj_step), and what a task reads after it.
#pragma once

// How many accelerations a step needs.
constexpr int STAGES = RK4 ? 4 : 1;

// The acceleration, in s.qacc_warmstart (mj_forward). Returns the Newton steps.
DEV int forward(const Team& team, const Model& M, State& s) {
  team.meet();
  const Team t = team.anew();
  place_links(t, M, s);
  place_dofs(t, M, s);
  place_inertias(t, M, s);
  place_geoms(t, M, s);
  if (NCABLE) place_cables(t, M, s);
  if (PASSIVE) passive(t, M, s);
  actuate(t, M, s);
  t.sync();
  motions(t, M, s);
  if (NE) general_rows(t, M, s);
  forces_and_inertia(t, M, s);
  collide(t, M, s);
  const int steps = STOPS_EARLY ? newton_as_c(t, M, s) : newton(t, M, s), lane = t.lane;
  if (NFREE) turn_free_bodies(t, M, s);  // before reports lie where M is
  if (reports(PASS_QPOS)) EACH(i, NQ) s.pass_qpos[i] = s.qpos[i];
  if (reports(PASS_QVEL)) EACH(i, NV) s.pass_qvel[i] = s.qvel[i];
  if (reports(PASS_QACC)) EACH(i, NV) s.pass_qacc[i] = s.qacc_warmstart[i];
  return steps;
}

// Moves positions, from start on, by a velocity for a time (mj_integratePos).
DEV void advance(const Team& t, const Model& M, State& s, const real* start, const real* velocity,
                 real time) {
  const int lane = t.lane;
  EACH(l, NL) {
    const int kind = M.link_kind[l], at = M.link_qpos[l], dof = M.link_dof[l];
    const real *q = start + at, *v = velocity + dof;
    real* out = s.qpos + at;
    if (!NTURN || kind > BALL) {
      out[0] = q[0] + time * v[0];
      continue;
    }
    if (kind == FREE) {
      for (int k = 0; k < 3; k++) out[k] = q[k] + time * v[k];
      q += 3; v += 3; out += 3;
    }
    const real speed = root(dot(v, v)), scale = speed > real(1e-15) ? 1 / speed : real(0);
    real sine, turn[4], moved[4];
    sine_cosine(time * speed / 2, sine, turn[0]);
    for (int k = 0; k < 3; k++) turn[1 + k] = sine * scale * v[k];
    quat_times(moved, q, turn);
    to_unit(moved);
    for (int k = 0; k < 4; k++) out[k] = moved[k];
  }
}

// How fast the rotation vector that has led to a stage grows (Munthe-Kaas): Bortz's equation.
DEV void rotation_rate(real* rate, const real* rotation, const real* velocity) {
  real r[3] = {rotation[0], rotation[1], rotation[2]}, square = dot(r, r), across[3], twice[3];
  const real pi = real(3.14159265358979323846);
  if (square > pi * pi) {
    const real angle = root(square), excess = 2 * pi * floor(angle / (2 * pi) + real(.5));
    for (int k = 0; k < 3; k++) r[k] *= 1 - excess / angle;
    square = dot(r, r);
  }
  const real half = root(square) / 2;
  real sine, cosine;
  sine_cosine(half, sine, cosine);
  const real high = real(1) / 30240 + square * (real(1) / 1209600);
  const real series = real(1) / 12 + square * (real(1) / 720 + square * high);
  const real share = square < real(.01) ? series : (1 - half * cosine / sine) / square;
  cross(across, r, velocity);
  cross(twice, r, across);
  for (int k = 0; k < 3; k++) rate[k] = velocity[k] + across[k] / 2 + share * twice[k];
}

// mj_RungeKutta of order 4; the rates are those of qpos, rotation vectors of the start included.
DEV void runge_kutta(const Team& t, const Model& M, State& s, bool last) {
  const int lane = t.lane;
  real* rates = &s.direction[0].x[0];
  EACH(i, NQ) s.start_qpos[i] = s.qpos[i];
  EACH(i, NV) {
    s.start_qvel[i] = s.qvel[i];
    s.sum_qvel[i] = s.sum_qacc[i] = 0;
  }
  EACH(n, 3 * NTURN) s.turning[n] = 0;
  t.sync();
  LOOP for (int stage = 0; stage < STAGES; stage++) {
    forward(t, M, s);
    if (last && stage == 3) report(t, M, s);
    const real h = M.timestep, at = stage == 0 ? real(0) : stage == 3 ? h : h / 2;
    const real weight = stage == 0 || stage == 3 ? real(1) / 6 : real(1) / 3;
    const real next = stage == 2 ? h : h / 2;
    t.sync();
    EACH(n, NTURN) {
      const int dof = M.turn_dof[n];
      real rotation[3];
      for (int k = 0; k < 3; k++) rotation[k] = at * s.turning[3 * n + k];
      rotation_rate(s.turning + 3 * n, rotation, s.qvel + dof);
      for (int k = 0; k < 3; k++) rates[dof + k] = s.turning[3 * n + k];
    }
    EACH(i, NV) if (!M.dof_turns[i]) rates[i] = s.qvel[i];
    t.sync();
    EACH(i, NV) {
      s.sum_qvel[i] += weight * rates[i];
      s.sum_qacc[i] += weight * s.qacc_warmstart[i];
      s.qvel[i] = s.start_qvel[i] + (stage < 3 ? next * s.qacc_warmstart[i] : h * s.sum_qacc[i]);
    }
    t.sync();
    advance(t, M, s, s.start_qpos, stage < 3 ? rates : s.sum_qvel, stage < 3 ? next : h);
    t.sync();
  }
}
// Whether damping changes the acceleration, also of a search that stops early (mj_EulerSkip).
DEV bool is_damped(const Model& M) {
  bool some = !MAY_SKIP;
  for (int i = 0; i < NV && MAY_SKIP; i++) some |= M.dof_damping[i] > 0;
  return IMPLICIT && some;
}
// mj_EulerSkip and mj_implicitSkip of implicitfast: newton has added what damps implicitly.
DEV void euler(const Team& t, const Model& M, State& s, bool last) {
  const int lane = t.lane;
  forward(t, M, s);
  const real* more = &s.direction[0].x[0];
  const bool damps = is_damped(M);
  EACH(i, NV) s.qvel[i] += M.timestep * (s.qacc_warmstart[i] + (damps ? more[i] : real(0)));
  t.sync();
  if (last) report(t, M, s);
  advance(t, M, s, s.qpos, s.qvel, M.timestep);
  t.sync();
}

// Plays `skip` steps under s.ctrl. Returns whether all numbers stayed sound (mj_checkPos,
// mj_checkVel, mj_checkAcc).
DEV bool physics(const Team& t, const Model& M, State& s, int skip) {
  const int lane = t.lane;
  place_fixed(t, M, s);
  bool sound = true;
  LOOP for (int n = 0; n < skip; n++) {
    if (RK4) {
      runge_kutta(t, M, s, n == skip - 1);
    } else {
      euler(t, M, s, n == skip - 1);
    }
    bool wrong = false;
    EACH(i, NQ) wrong |= !(fabs(s.qpos[i]) <= real(1e10));
    EACH(i, NV) wrong |= !(fabs(s.qvel[i]) <= real(1e10));
    EACH(i, NV) wrong |= !(fabs(s.qacc_warmstart[i]) <= real(1e10));
    sound &= !t.any(wrong);
  }
  if (lane == 0) s.time[0] += real(skip) * M.timestep;
  t.sync();
  return sound;
}

// What a task reads of the state that s.qpos and s.qvel are at, before any step: MuJoCo's
// mj_forward, which leaves cfrc_ext zero where no sensor needs it.
DEV void start(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  place_fixed(t, M, s);
  forward(t, M, s);
  report(t, M, s);
  if (reports(CFRC_EXT) && !SENSES_FORCES) EACH(n, 6 * NB) s.cfrc_ext[n] = 0;
  EACH(i, NV) s.qacc_warmstart[i] = 0;
  t.sync();
}

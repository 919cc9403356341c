// Rows of equality constraints: points of two bodies that are one (connect), bodies that do not
// turn against each other either (weld: the last of these), and joints that move together (MuJoCo's
// mj_instantiateEquality).
#pragma once

// The quaternion of a weld: how the first of two frames is turned in the second; either sign.
struct Weld {
  Pose first, second;
  real q[4];
  // What the quaternion's axis gains by a relative angular velocity, in the world's axes.
  DEV void gain(real* out, const real* velocity) const {
    real in_second[3], across[3];
    second.turn_back(in_second, velocity);
    cross(across, in_second, q + 1);
    for (int k = 0; k < 3; k++) out[k] = (q[0] * in_second[k] + across[k]) / 2;
  }
  // The torque of what pushes the axis.
  DEV void torque(real* out, const real* force) const {
    real sum[3];
    cross(sum, q + 1, force);
    for (int k = 0; k < 3; k++) sum[k] = (sum[k] + q[0] * force[k]) / 2;
    second.turn(out, sum);
  }
};
DEV Weld weld_of(const Model& M, const State& s, int n) {
  const int connect = NCONNECT - NWELD + n;
  Pose end[2];
  real turn[3][3];  // of the first frame in the second
  for (int side = 0; side < 2; side++)
    for (int j = 0; j < 3; j++) {
      const real* own = M.weld_turn + 18 * n + 9 * side;
      const real axis[3] = {own[j], own[3 + j], own[6 + j]};
      real seen[3];
      s.pose[M.connect_link[2 * connect + side]].turn(seen, axis);
      for (int k = 0; k < 3; k++) end[side].row[k].x[j] = seen[k];
    }
  for (int j = 0; j < 3; j++) {
    const real axis[3] = {end[0].row[0].x[j], end[0].row[1].x[j], end[0].row[2].x[j]};
    real seen[3];
    end[1].turn_back(seen, axis);
    for (int k = 0; k < 3; k++) turn[k][j] = seen[k];
  }
  // By its largest entry, so that nothing is lost where another one is near zero.
  const real* d[3] = {turn[0], turn[1], turn[2]};
  const real trace = d[0][0] + d[1][1] + d[2][2];
  int most = 0;
  for (int k = 0; k < 3; k++)
    if (d[k][k] > (most ? d[most - 1][most - 1] : trace)) most = k + 1;
  Weld weld = {end[0], end[1], {}};
  real* q = weld.q;
  const int i = most ? most - 1 : 0, j = (i + 1) % 3, k = (i + 2) % 3;
  if (most == 0) {
    q[0] = 1 + trace;
    for (int m = 0; m < 3; m++)
      q[1 + m] = d[(m + 2) % 3][(m + 1) % 3] - d[(m + 1) % 3][(m + 2) % 3];
  } else {
    q[0] = d[k][j] - d[j][k];
    q[1 + i] = 1 + 2 * d[i][i] - trace;
    q[1 + j] = d[i][j] + d[j][i];
    q[1 + k] = d[i][k] + d[k][i];
  }
  to_unit(q);
  return weld;
}

// Rows by which the frames of a weld do not turn against each other.
DEV void weld_rows(const Team& t, const Model& M, State& s, int n, const Weld& weld,
                   real strength) {
  const int lane = t.lane, e = 3 * (NCONNECT + n), connect = NCONNECT - NWELD + n;
  const int link[2] = {M.connect_link[2 * connect], M.connect_link[2 * connect + 1]};
  const Softness& soft = M.soft[M.connect_soft[connect]];
  const real scale = M.weld_scale[n];
  EACH(i, SIDE) {
    const bool first = i < NV && M.link_dofs[link[0]] >> i & 1;
    const bool second = i < NV && M.link_dofs[link[1]] >> i & 1;
    real moves[3] = {}, by[3];
    for (int k = 0; k < 3 && first != second; k++)
      moves[k] = first ? s.cdof[i][0].x[k] : -s.cdof[i][0].x[k];
    weld.gain(by, moves);
    for (int k = 0; k < 3; k++) s.general[e + k][i / 4].x[i % 4] = scale * by[k];
  }
  if (lane > 0) return;
  real moves[3] = {}, speed[2][3] = {}, apart[3], seen[2][3], by[3];
  real gain[3], in_second[3], both[3], across[3];
  for (int side = 0; side < 2; side++) {
    const int l = link[side];
    if (l >= NL) continue;
    const real* a = &s.subtree[l][2].x[0] + 2;  // the acceleration that qvel brings
    for (int k = 0; k < 3; k++) {
      speed[side][k] = s.velocity[l][k];
      moves[k] += (side ? -1 : 1) * (a[k] + s.motion[l][k] + soft.damping * speed[side][k]);
    }
  }
  weld.gain(by, moves);
  // How the rows change as the frames turn (mj_Jdotv).
  for (int k = 0; k < 3; k++) apart[k] = speed[0][k] - speed[1][k];
  weld.gain(gain, apart);
  weld.second.turn_back(in_second, apart);
  weld.first.turn_back(seen[0], speed[0]);
  weld.second.turn_back(seen[1], speed[1]);
  for (int k = 0; k < 3; k++) both[k] = seen[0][k] + seen[1][k];
  cross(across, gain, both);
  for (int k = 0; k < 3; k++)
    by[k] += across[k] / 2 - dot(in_second, weld.q + 1) * (seen[0][k] - seen[1][k]) / 4;
  for (int k = 0; k < 3; k++) {
    s.general_constraint_mass[e + k] = constraint_mass(strength, M.weld_weight[n]);
    s.general_residual[e + k] = scale * (by[k] + soft.stiffness * strength * weld.q[1 + k]);
  }
}

DEV void connect_rows(const Team& t, const Model& M, State& s, int n) {
  const int lane = t.lane;
  const int link[2] = {M.connect_link[2 * n], M.connect_link[2 * n + 1]};
  const Softness& soft = M.soft[M.connect_soft[n]];
  real arm[2][3], apart[3];
  for (int side = 0; side < 2; side++) {
    s.pose[link[side]].place(arm[side], M.connect_at + 6 * n + 3 * side);
    for (int k = 0; k < 3; k++) arm[side][k] -= s.pose[0].origin(k);
  }
  for (int k = 0; k < 3; k++) apart[k] = arm[0][k] - arm[1][k];
  EACH(i, SIDE) {
    real sum[3] = {};
    for (int side = 0; side < 2 && i < NV; side++) {
      if (!(M.link_dofs[link[side]] >> i & 1)) continue;
      real moves[6], point[3];
      for (int k = 0; k < 6; k++) moves[k] = s.cdof[i][k / 4].x[k % 4];
      cross(point, moves, arm[side]);
      for (int k = 0; k < 3; k++) sum[k] += (side ? -1 : 1) * (point[k] + moves[3 + k]);
    }
    for (int k = 0; k < 3; k++) s.general[3 * n + k][i / 4].x[i % 4] = sum[k];
  }
  real square = dot(apart, apart);
  if (NWELD && n >= NCONNECT - NWELD) {
    const int w = n - (NCONNECT - NWELD);
    const Weld weld = weld_of(M, s, w);
    square += M.weld_scale[w] * M.weld_scale[w] * dot(weld.q + 1, weld.q + 1);
    weld_rows(t, M, s, w, weld, impedance(soft, root(square)));
  }
  EACH(k, 3) {
    real residual = 0;
    for (int side = 0; side < 2; side++) {
      const int l = link[side];
      if (l >= NL) continue;
      const real *v = s.velocity[l], *x = s.motion[l];
      const real* a = &s.subtree[l][2].x[0] + 2;  // the acceleration that qvel brings
      real speed[3], turned[3], by_qvel[3], by_x[3];
      cross(speed, v, arm[side]);
      for (int j = 0; j < 3; j++) speed[j] += v[3 + j];
      cross(turned, v, speed);
      cross(by_qvel, a, arm[side]);
      cross(by_x, x, arm[side]);
      const real point = by_qvel[k] + a[3 + k] + turned[k] + by_x[k] + x[3 + k];
      residual += (side ? -1 : 1) * (point + soft.damping * speed[k]);
    }
    const real strength = impedance(soft, root(square));
    s.general_constraint_mass[3 * n + k] = constraint_mass(strength, M.connect_weight[n]);
    s.general_residual[3 * n + k] = residual + soft.stiffness * strength * apart[k];
  }
}

DEV void joint_rows(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  constexpr int BEFORE = 3 * (NCONNECT + NWELD);
  EACH(n, NE - NLIMITED - NLOSS - BEFORE) {
    const int e = BEFORE + n, first = M.joined_dof[2 * n], second = M.joined_dof[2 * n + 1];
    const real* p = M.joined_poly + 5 * n;
    const Softness& soft = M.soft[M.joined_soft[n]];
    for (int q = 0; q < QUADS; q++) s.general[e][q] = {0, 0, 0, 0};
    real off = s.qpos[M.dof_qpos[first]] - M.dof_zero[first] - p[0];
    real moves = s.qacc_warmstart[first] + soft.damping * s.qvel[first];
    s.general[e][first / 4].x[first % 4] = 1;
    if (second >= 0) {
      const real q = s.qpos[M.dof_qpos[second]] - M.dof_zero[second];
      const real slope = p[1] + q * (2 * p[2] + q * (3 * p[3] + q * 4 * p[4]));
      off -= q * (p[1] + q * (p[2] + q * (p[3] + q * p[4])));
      moves -= slope * (s.qacc_warmstart[second] + soft.damping * s.qvel[second]);
      s.general[e][second / 4].x[second % 4] = -slope;
    }
    const real strength = impedance(soft, off);
    s.general_constraint_mass[e] = constraint_mass(strength, M.joined_weight[n]);
    s.general_residual[e] = moves + soft.stiffness * strength * off;
  }
}

DEV void general_rows(const Team& t, const Model& M, State& s) {
  for (int n = 0; n < NCONNECT; n++) connect_rows(t, M, s, n);
  joint_rows(t, M, s);
  bound_rows(t, M, s);
  t.sync();
}

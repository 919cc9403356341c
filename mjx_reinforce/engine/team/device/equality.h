// Rows of equality constraints: points of two bodies that are one (connect), and joints that move
// together (MuJoCo's mj_instantiateEquality).
#pragma once

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
    const real strength = impedance(soft, root(dot(apart, apart)));
    s.general_constraint_mass[3 * n + k] = constraint_mass(strength, M.connect_weight[n]);
    s.general_residual[3 * n + k] = residual + soft.stiffness * strength * apart[k];
  }
}

DEV void joint_rows(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(n, NE - NLIMITED - NLOSS - 3 * NCONNECT) {
    const int e = 3 * NCONNECT + n, first = M.joined_dof[2 * n], second = M.joined_dof[2 * n + 1];
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

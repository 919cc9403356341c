// The fields that a task may read after a step: positions, and spatial quantities about the center
// of mass of a body's tree, as MuJoCo has them.
#pragma once

// Adds a force [3] and a torque [3] at a place to cfrc_ext of a body, about the point of reference.
DEV void add_external(State& s, int b, real sign, const real* force, const real* torque,
                      const real* at) {
  real moment[3];
  cross(moment, at, force);
  for (int k = 0; k < 3; k++) {
    s.cfrc_ext[6 * b + k] += sign * (moment[k] + torque[k]);
    s.cfrc_ext[6 * b + 3 + k] += sign * force[k];
  }
}

// cfrc_ext of contacts, connects, welds and spatial tendons (MuJoCo's mj_rnePostConstraint). A
// lane has a body.
DEV void external_forces(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(n, 6 * NB) s.cfrc_ext[n] = 0;
  if (!NOSLIP) each_contact(t, s, [&](Contact& c) { push(M, c); });
  t.sync();
  // All lanes go through all contacts, and each adds those of its bodies: in one order, so that
  // sums are the same for any number of lanes, and without atomic additions.
  all_contacts(t, s, [&](const Contact& c) {
    if (c.force[0] == 0) return;
    const int first = M.geom_body[M.item[c.item].first()];
    const int second = M.geom_body[M.item[c.item].second()];
    EACH(b, NB) {
      if (b == 0 || (b != first && b != second)) continue;
      real force[3] = {}, torque[3] = {};
      for (int k = 0; k < CD; k++)
        for (int j = 0; j < 3; j++)
          (k < 3 ? force : torque)[j] += c.force[k] * c.frame[3 * (k % 3) + j];
      add_external(s, b, b == second ? 1 : -1, force, torque, c.at);
    }
  });
  for (int n = 0; n < NCONNECT; n++) {
    const auto push_of = [&](int e) {
      return -s.general_constraint_mass[e] * s.general_residual[e];
    };
    const int weld = n - (NCONNECT - NWELD);
    real force[3], torque[3] = {};
    for (int k = 0; k < 3; k++) force[k] = push_of(3 * n + k);
    if (NWELD && weld >= 0) {
      real turn[3];
      for (int k = 0; k < 3; k++) turn[k] = push_of(3 * (NCONNECT + weld) + k);
      weld_of(M, s, weld).torque(torque, turn);
      for (int k = 0; k < 3; k++) torque[k] *= M.weld_scale[weld];
    }
    for (int side = 0; side < 2; side++) {
      const int b = M.connect_body[2 * n + side];
      real at[3];
      s.pose[M.connect_link[2 * n + side]].place(at, M.connect_at + 6 * n + 3 * side);
      for (int k = 0; k < 3; k++) at[k] -= s.pose[0].origin(k);
      if (b > 0 && b % W == lane) add_external(s, b, side ? -1 : 1, force, torque, at);
    }
  }
  for (int n = 0; n < NCABLE && SEGMENTS; n++) {
    const real pull = whole_force(M, s, n), none[3] = {};
    for (int p = M.cable_part[n]; p < M.cable_part[n + 1]; p++) {
      if (M.part_kind[p] != SEGMENT) continue;
      real ends[2][3], force[3];
      segment(M, s, p, ends, force);
      for (int k = 0; k < 3; k++) force[k] *= pull;
      for (int side = 0; side < 2; side++) {
        const int b = M.part_body[2 * p + side];
        if (b > 0 && b % W == lane) add_external(s, b, side ? -1 : 1, force, none, ends[side]);
      }
    }
  }
}

// The center of mass of the tree of a body (MuJoCo's subtree_com of the root), or of the root where
// nothing has mass.
DEV void center_of_tree(const Model& M, const State& s, int body, real* com) {
  real total = 0;
  for (int k = 0; k < 3; k++) com[k] = 0;
  LOOP for (int b = 1; b < NB; b++) {
    if (M.body_root[b] != M.body_root[body]) continue;
    total += M.body_mass[b];
    for (int k = 0; k < 3; k++) com[k] += M.body_mass[b] * s.xipos[3 * b + k];
  }
  const real* root = s.xipos + 3 * M.body_root[body];
  for (int k = 0; k < 3; k++) com[k] = total > 0 ? com[k] / total : root[k];
}

// Positions and spatial quantities of bodies (mj_comPos, mj_comVel).
DEV void report(const Team& t, const Model& M, State& s) {
  constexpr bool SPATIAL = reports(CINERT | CVEL | CFRC_EXT);
  const int lane = t.lane;
  EACH(b, NB) {
    const Pose& p = s.pose[M.body_link[b]];
    if (reports(XPOS)) p.place(s.xpos + 3 * b, M.body_at + 3 * b);
    if (SPATIAL || reports(XIPOS)) p.place(s.xipos + 3 * b, M.body_com + 3 * b);
  }
  t.sync();
  if (reports(CFRC_EXT)) external_forces(t, M, s);
  if constexpr (reports(TOUCH) && NTOUCH > 0) feel(t, M, s);
  if (SPATIAL) EACH(b, NB) {
    const int link = M.body_link[b];
    real com[3], arm[3], shift[3];
    center_of_tree(M, s, b, com);
    if (reports(CINERT)) {
      real inertia[6];
      for (int k = 0; k < 3; k++) arm[k] = s.xipos[3 * b + k] - com[k];
      turn_symmetric(inertia, s.pose[link], M.body_inertia + 6 * b);
      spatial_inertia(s.cinert + 10 * b, inertia, M.body_mass[b], arm);
    }
    for (int k = 0; k < 3; k++) arm[k] = com[k] - s.pose[0].origin(k);
    if (reports(CVEL)) {
      const real* velocity = s.velocity[link];
      cross(shift, velocity, arm);
      for (int k = 0; k < 3; k++) {
        s.cvel[6 * b + k] = velocity[k];
        s.cvel[6 * b + 3 + k] = velocity[3 + k] + shift[k];
      }
    }
    if (reports(CFRC_EXT)) {
      cross(shift, arm, s.cfrc_ext + 6 * b + 3);
      for (int k = 0; k < 3; k++) s.cfrc_ext[6 * b + k] -= shift[k];
    }
  }
  t.sync();
}

// Where everything is (MuJoCo's mj_kinematics and mj_comPos). A link is what one joint moves: a
// body of several joints is a chain of links, a body without a joint belongs to the link, the world
// or the mocap body that carries it.
#pragma once

enum { FREE, BALL, SLIDE, HINGE };              // joints
enum { TURNS, SHIFTS, SHIFTS_IN_THE_WORLD };    // degrees of freedom

// The pose of a link in its parent's frame.
DEV Pose pose_in_parent(const Model& M, const State& s, int l) {
  const int kind = M.link_kind[l];
  const real* q = s.qpos + M.link_qpos[l];
  const real *first = M.link_quat + 4 * l, *second = M.link_turned + 4 * l;
  real turn[4], at[3];
  for (int k = 0; k < 4; k++) turn[k] = first[k];
  for (int k = 0; k < 3; k++) at[k] = M.link_at[3 * l + k];
  if (NTURN && kind <= BALL) {
    const real* quat = kind == FREE ? q + 3 : q;
    real unit[4];
    for (int k = 0; k < 4; k++) unit[k] = quat[k];
    to_unit(unit);
    if (kind == FREE) {
      for (int k = 0; k < 3; k++) at[k] = q[k];
      for (int k = 0; k < 4; k++) turn[k] = unit[k];
    } else {
      quat_times(turn, turn, unit);
    }
  } else {
    const real moved = q[0] - M.link_zero[l];
    if (kind == HINGE) {
      real sine, cosine;
      sine_cosine(moved / 2, sine, cosine);
      for (int k = 0; k < 4; k++) turn[k] = cosine * turn[k] + sine * second[k];
    } else {
      for (int k = 0; k < 3; k++) at[k] += moved * second[k];
    }
  }
  return pose_of(turn, at);
}

// The world and mocap bodies, which do not move during an episode.
DEV void place_fixed(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(k, 12) s.pose[NL].row[k / 4].x[k % 4] = k % 5 == 0;
  EACH(k, 6) s.velocity[NL][k] = s.motion[NL][k] = 0;
  EACH(m, NMOCAP) {
    const int link = NL + 1 + m;
    real quat[4];
    for (int k = 0; k < 4; k++) quat[k] = M.mocap_quat[4 * m + k];
    to_unit(quat);
    s.pose[link] = pose_of(quat, M.mocap_pos + 3 * m);
    for (int k = 0; k < 6; k++) s.velocity[link][k] = s.motion[link][k] = 0;
  }
  t.sync();
}

// Poses in the world: each round doubles the number of ancestors that a pose has been joined with.
// A lane joins a row of a pose; M.jump says of which link and with which.
DEV void place_links(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(l, NL) s.pose[l] = pose_in_parent(M, s, l);
  const Quad* flat = s.pose[0].row;
  UNROLL for (int round = 0; round < ROUNDS; round++) {
    constexpr int MOST = (3 * NL + W - 1) / W;
    Quad joined[MOST];
    const int first = jump_start(round), jumps = jump_start(round + 1) - first;
    t.sync();
    UNROLL for (int n = 0; n < MOST; n++) {
      const int e = lane + n * W;
      if (n * W < jumps && e < jumps) {
        const Pair jump = M.jump[first + e];
        const Quad far = flat[jump.high()];
        const Pose& pose = s.pose[jump.low() / 3];
        for (int k = 0; k < 4; k++)
          joined[n].x[k] = far.x[0] * pose.row[0].x[k] + far.x[1] * pose.row[1].x[k] +
                           far.x[2] * pose.row[2].x[k] + (k == 3 ? far.x[3] : real(0));
      }
    }
    t.sync();
    UNROLL for (int n = 0; n < MOST; n++) {
      const int e = lane + n * W;
      if (n * W < jumps && e < jumps) s.pose[0].row[M.jump[first + e].low()] = joined[n];
    }
  }
  t.sync();
}

// How degrees of freedom move what they carry (MuJoCo's cdof), about the point of reference: the
// origin of link 0.
DEV void place_dofs(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(i, NV) {
    const Pose& p = s.pose[M.dof_link[i]];
    const real* local_axis = M.dof_axis + 3 * i;
    real axis[3], arm[3], moves[8] = {};
    p.turn(axis, local_axis);
    for (int k = 0; k < 3; k++) arm[k] = s.pose[0].origin(k) - p.origin(k);
    const int kind = M.dof_kind[i];
    if (kind == TURNS) {
      for (int k = 0; k < 3; k++) moves[k] = axis[k];
      cross(moves + 3, axis, arm);
    } else {
      for (int k = 0; k < 3; k++) moves[3 + k] = kind == SHIFTS ? axis[k] : local_axis[k];
    }
    s.cdof[i][0] = {moves[0], moves[1], moves[2], moves[3]};
    s.cdof[i][1] = {moves[4], moves[5], 0, 0};
  }
}
// The spatial inertias of links, about the point of reference, where M's sums begin.
DEV void place_inertias(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(l, NL) {
    const Pose& p = s.pose[l];
    real inertia[6], at[3], all[12];
    turn_symmetric(inertia, p, M.link_inertia + 6 * l);
    p.place(at, M.link_com + 3 * l);
    for (int k = 0; k < 3; k++) at[k] -= s.pose[0].origin(k);
    spatial_inertia(all, inertia, M.link_mass[l], at);
    for (int q = 0; q < 2; q++)
      s.subtree[l][q] = {all[4 * q], all[4 * q + 1], all[4 * q + 2], all[4 * q + 3]};
    s.subtree[l][2].x[0] = all[8];
    s.subtree[l][2].x[1] = all[9];
  }
}
// The centers and axes of geoms that may meet.
DEV void place_geoms(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(g, NG) {
    const Pose& p = s.pose[M.geom_link[g]];
    real at[3], axis[3];
    p.place(at, M.geom_at + 3 * g);
    p.turn(axis, M.geom_axis + 3 * g);
    s.geom_place[g] = {at[0], at[1], at[2], M.geom_reach[g]};
    s.geom_axis[g] = {axis[0], axis[1], axis[2], 0};
  }
}
// The pose of a geom whose turn about its axis matters.
DEV Pose geom_pose(const Model& M, const State& s, int g) {
  const Pose& p = s.pose[M.geom_link[g]];
  const real* turn = M.geom_turn + 9 * g;
  Pose geom;
  for (int k = 0; k < 3; k++) {
    for (int j = 0; j < 3; j++)
      geom.row[k].x[j] = p.row[k].x[0] * turn[j] + p.row[k].x[1] * turn[3 + j] +
                        p.row[k].x[2] * turn[6 + j];
    geom.row[k].x[3] = s.geom_place[g].x[k];
  }
  return geom;
}

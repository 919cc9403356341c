// Passive forces beyond the springs and dampers of joints (MuJoCo's mj_passive).
#pragma once

// What gravity compensation pushes a degree of freedom with (mj_gravcomp).
DEV real compensation(const Model& M, const State& s, int i) {
  const real* moves = s.cdof[i][0].x;
  real sum = 0;
  LOOP for (int n = 0; n < NHELD; n++) {
    const int link = M.held_link[n];
    if (!(M.link_dofs[link] >> i & 1)) continue;
    const Held& held = M.held[n];
    const Pose& p = s.pose[link];
    real moment[3], torque[3];
    p.turn(moment, held.moment);
    for (int k = 0; k < 3; k++) moment[k] += held.mass * (p.origin(k) - s.pose[0].origin(k));
    cross(torque, moment, M.gravity);
    sum -= dot(moves, torque) + held.mass * dot(moves + 3, M.gravity);
  }
  return sum;
}

// Leaves minus the forces in s.imbalance.
DEV void passive(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(i, NV) {
    real force = 0;
    if (NHELD && !M.dof_acts_held[i]) force += compensation(M, s, i);
    for (int n = 0; n < NCABLE && TENSE; n++) {
      const Cable& cable = s.cables[n];
      force += cable.moment[i / 4].x[i % 4] * tension(M.tendon[n], cable.length, cable.speed);
    }
    s.imbalance[i] = -force;
  }
}

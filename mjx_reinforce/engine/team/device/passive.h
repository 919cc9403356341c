// Passive forces beyond the springs and dampers of joints (MuJoCo's mj_passive).
#pragma once

// What gravity compensation pushes a degree of freedom with (mj_gravcomp).
DEV real compensation(const Model& M, const State& s, int i) {
  const real* moves = s.cdof[i][0].x;
  real sum = 0;
  LOOP for (int n = 0; n < NCOMPENSATED; n++) {
    const int link = M.compensated_link[n];
    if (!(M.link_dofs[link] >> i & 1)) continue;
    const Compensation& weight = M.compensated[n];
    const Pose& p = s.pose[link];
    real moment[3], torque[3];
    p.turn(moment, weight.moment);
    for (int k = 0; k < 3; k++) moment[k] += weight.mass * (p.origin(k) - s.pose[0].origin(k));
    cross(torque, moment, M.gravity);
    sum -= dot(moves, torque) + weight.mass * dot(moves + 3, M.gravity);
  }
  return sum;
}

// What the higher powers of springs and dampers of joints push with, and springs of free and ball
// joints altogether (of mj_springdamper).
DEV real sprung(const Model& M, const State& s, int i) {
  const Law& law = M.dof_law[i];
  const int link = M.dof_link[i], kind = M.link_kind[link], k = i - M.link_dof[link];
  const real *q = s.qpos + M.link_qpos[link], *rest = M.rest + M.link_qpos[link];
  const real damped = -s.qvel[i] * polynomial(law.damping, fabs(s.qvel[i]));
  if (kind > BALL) return damped - (*q - *rest) * polynomial(law.stiffness, *q - *rest);
  real off[3];
  if (kind == FREE && k < 3) {
    for (int j = 0; j < 3; j++) off[j] = q[j] - rest[j];
  } else {
    if (kind == FREE) q += 3, rest += 3;
    const real back[4] = {rest[0], -rest[1], -rest[2], -rest[3]};
    real turned[4];
    quat_times(turned, back, q);
    rotation_vector(off, turned);
  }
  return damped - off[k % 3] * polynomial(law.stiffness, root(dot(off, off)));
}

// Subtracts from a link's force, about the point of reference, what a medium pushes its bodies with
// (mj_inertiaBoxFluidModel).
DEV void subtract_medium(const Model& M, const State& s, int link, real* force) {
  const real* v = s.velocity[link];
  LOOP for (int b = M.link_fluid[link]; b < M.link_fluid[link + 1]; b++) {
    const FluidBody& body = M.fluid_body[b];
    real at[3], speed[3], moment[3], push[3] = {}, torque[3] = {};
    place_of(s, link, body.at, at);
    cross(speed, v, at);
    for (int k = 0; k < 3; k++) speed[k] += v[3 + k] - M.wind[k];
    for (int k = 0; k < 3; k++) {
      real axis[3];
      s.pose[link].turn(axis, body.axes + 3 * k);
      const real turns = dot(v, axis), moves = dot(speed, axis);
      const real resists = turns * (body.viscous_torque + body.drag_torque[k] * fabs(turns));
      const real holds = moves * (body.viscous_force + body.drag_force[k] * fabs(moves));
      for (int j = 0; j < 3; j++) torque[j] += resists * axis[j], push[j] += holds * axis[j];
    }
    cross(moment, at, push);
    for (int k = 0; k < 3; k++) {
      force[k] += moment[k] + torque[k];
      force[3 + k] += push[k];
    }
  }
}

// Leaves minus the forces in s.imbalance.
DEV void passive(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(i, NV) {
    real force = JOINT_LAWS ? sprung(M, s, i) : real(0);
    if (NCOMPENSATED && !M.dof_actuator_compensation[i]) force += compensation(M, s, i);
    for (int n = 0; n < NCABLE && TENDON_FORCES; n++) {
      const Cable& cable = s.cables[n];
      force += cable.moment[i / 4].x[i % 4] * tension(M.tendon[n], cable.length, cable.speed);
    }
    s.imbalance[i] = -force;
  }
}

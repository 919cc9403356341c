// Rows of single degrees of freedom: limits of joints and friction loss (MuJoCo's
// mj_instantiateLimit and mj_instantiateFriction).
#pragma once

// Rows of single degrees of freedom, of one lane's: limits and friction loss.
struct Bounds {
  // Of each limit that pushes its Jacobian, which is a sign, D, and the reference; no other lane
  // reads them, so that they stay in registers.
  static constexpr int ROOM = LIMITS ? LIMITS : 1;
  real limit_sign[ROOM], limit_constraint_mass[ROOM], limit_reference[ROOM];
  real loss, loss_constraint_mass, loss_reference;

  DEV void make(const Model& M, const State& s, int i) {
    for (int n = 0; n < LIMITS; n++)
      limit_sign[n] = limit_constraint_mass[n] = limit_reference[n] = 0;
    const real v = s.qvel[i];
    if (LIMITS && M.dof_limited[i]) {
      const real q = s.qpos[M.dof_qpos[i]];
      const Limit& limit = M.dof_limit[i];
      const Softness& soft = M.soft[M.dof_limit_soft[i]];
      UNROLL for (int side = 0; side < 2; side++) {
        const real sign = side ? real(-1) : real(1);
        const real distance = sign * (q - limit.range[side]) - limit.margin;
        if (distance < 0) {
          const int n = LIMITS > 1 ? side : 0;  // with room for one, only one of them pushes
          const real strength = impedance(soft, distance);
          limit_sign[n] = sign;
          limit_constraint_mass[n] = constraint_mass(strength, limit.weight);
          limit_reference[n] = -soft.damping * sign * v - soft.stiffness * strength * distance;
        }
      }
    }
    if (LOSSES) {
      const Softness& soft = M.soft[M.dof_loss_soft[i]];
      loss = M.dof_loss[i].most;
      const real strength = impedance(soft, 0);
      loss_constraint_mass = loss > 0 ? constraint_mass(strength, M.dof_loss[i].weight) : real(0);
      loss_reference = -soft.damping * v;
    }
  }
  // Whether there is a row, whether it pushes or not.
  DEV bool some() const {
    bool has_row = LOSSES && loss_constraint_mass > 0;
    for (int n = 0; n < LIMITS; n++) has_row |= limit_constraint_mass[n] > 0;
    return has_row;
  }
  // Adds the gradient at an acceleration, and the stiffness.
  DEV void push(real qacc, real& gradient, real& stiffness) const {
    for (int n = 0; n < LIMITS; n++) {
      const real residual = limit_sign[n] * qacc - limit_reference[n];
      if (limit_constraint_mass[n] > 0 && residual < 0) {
        gradient += limit_sign[n] * limit_constraint_mass[n] * residual;
        stiffness += limit_constraint_mass[n];
      }
    }
    if (LOSSES && loss_constraint_mass > 0) {
      const real residual = qacc - loss_reference, force = loss_constraint_mass * residual;
      if (fabs(force) < loss) stiffness += loss_constraint_mass;
      gradient += clip(force, -loss, loss);
    }
  }
  // Adds what the rows cost along a step (see early_stop.h).
  template <class Sum> DEV void work(real qacc, real direction, Sum& sum) const {
    for (int n = 0; n < LIMITS; n++)
      if (limit_constraint_mass[n] > 0)
        sum.add_one_sided(limit_constraint_mass[n], limit_sign[n] * qacc - limit_reference[n],
                          limit_sign[n] * direction);
    if (LOSSES && loss_constraint_mass > 0)
      sum.add_bounded(loss_constraint_mass, loss, qacc - loss_reference, direction);
  }
  DEV void bend(real qacc, real direction, real length, Bend& sum) const {
    for (int n = 0; n < LIMITS; n++)
      if (limit_constraint_mass[n] > 0)
        sum.add(limit_constraint_mass[n], limit_sign[n] * qacc - limit_reference[n],
                limit_sign[n] * direction, length);
    if (LOSSES && loss_constraint_mass > 0)
      sum.add_bounded(loss_constraint_mass, loss, qacc - loss_reference, direction, length);
  }
};

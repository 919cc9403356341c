// Rows of single degrees of freedom: limits of joints and friction loss (MuJoCo's
// mj_instantiateLimit and mj_instantiateFriction).
#pragma once

// Rows of single degrees of freedom, of one lane's: limits and friction loss.
struct Bounds {
  static constexpr int ROOM = LIMITS ? LIMITS : 1;
  real limit_sign[ROOM], limit_mass[ROOM], limit_aim[ROOM];
  real loss, loss_mass, loss_aim;

  DEV void make(const Model& M, const State& s, int i) {
    for (int n = 0; n < LIMITS; n++) limit_sign[n] = limit_mass[n] = limit_aim[n] = 0;
    const real v = s.qvel[i];
    if (LIMITS && M.dof_limited[i]) {
      const real q = s.qpos[M.dof_qpos[i]];
      const Limit& limit = M.dof_limit[i];
      const Softness& soft = M.soft[M.dof_limit_soft[i]];
      UNROLL for (int side = 0; side < 2; side++) {
        const real sign = side ? real(-1) : real(1);
        const real distance = sign * (q - limit.range[side]) - limit.margin;
        if (distance < 0) {
          const int n = LIMITS > 1 ? side : 0;
          const real strength = impedance(soft, distance);
          limit_sign[n] = sign;
          limit_mass[n] = row_mass(strength, limit.weight);
          limit_aim[n] = -soft.damping * sign * v - soft.stiffness * strength * distance;
        }
      }
    }
    if (LOSSES) {
      const Softness& soft = M.soft[M.dof_loss_soft[i]];
      loss = M.dof_loss[i].most;
      loss_mass = loss > 0 ? row_mass(impedance(soft, 0), M.dof_loss[i].weight) : real(0);
      loss_aim = -soft.damping * v;
    }
  }
  // Adds the gradient at acceleration x, and the stiffness.
  DEV void push(real x, real& gradient, real& stiffness) const {
    for (int n = 0; n < LIMITS; n++) {
      const real gap = limit_sign[n] * x - limit_aim[n];
      if (limit_mass[n] > 0 && gap < 0) {
        gradient += limit_sign[n] * limit_mass[n] * gap;
        stiffness += limit_mass[n];
      }
    }
    if (LOSSES && loss_mass > 0) {
      const real gap = x - loss_aim, force = loss_mass * gap;
      if (fabs(force) < loss) stiffness += loss_mass;
      gradient += clip(force, -loss, loss);
    }
  }
  // The stiffness alone.
  DEV real stiffness(real x) const {
    real gradient = 0, sum = 0;
    push(x, gradient, sum);
    return sum;
  }
  DEV void bend(real x, real step, real length, Bend& sum) const {
    for (int n = 0; n < LIMITS; n++)
      if (limit_mass[n] > 0)
        sum.add(limit_mass[n], limit_sign[n] * x - limit_aim[n], limit_sign[n] * step, length);
    if (LOSSES && loss_mass > 0) sum.add_bounded(loss_mass, loss, x - loss_aim, step, length);
  }
};

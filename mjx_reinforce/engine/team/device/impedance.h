// How stiff constraint rows are, and what the rows add to the cost along a step.
#pragma once

// The impedance at a distance from where a row begins (MuJoCo's getimpedance).
DEV real impedance(const Softness& soft, real distance) {
  const real x = fabs(distance) / soft.width, middle = soft.middle, power = soft.power;
  if (x >= 1) return soft.least + soft.rise;
  real y = x;
  if (!ANY_POWER || power == 2)
    y = x <= middle ? x * x / middle : 1 - (1 - x) * (1 - x) / (1 - middle);
  else if (power != 1)
    y = x <= middle ? pow(x, power) / pow(middle, power - 1)
                    : 1 - pow(1 - x, power) / pow(1 - middle, power - 1);
  return soft.least + y * soft.rise;
}
// D of a row whose inverse mass is about `weight` (mj_makeImpedance).
DEV real constraint_mass(real strength, real weight) {
  const real r = (1 - strength) / strength * weight;
  return 1 / (r > real(1e-15) ? r : real(1e-15));
}

// What rows add to the derivative of the cost along a step, beyond the quadratic at its start, and
// whether there is anything.
struct Bend {
  real slope, curvature;
  bool some;
  // A row whose force is linear where it pushes: its residual at the start, and how that changes.
  DEV void add(real constraint_mass, real residual, real change, real length) {
    const real after = residual + length * change;
    // Only a row that pushes at one end alone departs from the quadratic at the start.
    if ((residual < 0) != (after < 0)) {
      const real by = after < 0 ? constraint_mass * change : -constraint_mass * change;
      slope += by * after;
      curvature += by * change;
      some = true;
    }
  }
  // A row of friction loss, whose force is bounded.
  DEV void add_bounded(real constraint_mass, real bound, real residual, real change, real length) {
    const real after = residual + length * change, reach = bound / constraint_mass;
    // -1 and 1 where the force is at its bound, 0 where it is linear between.
    const int zone = residual <= -reach ? -1 : residual >= reach;
    const int then = after <= -reach ? -1 : after >= reach;
    if (zone != then) {
      const real is = then ? then * bound : constraint_mass * after;
      const real was = zone ? zone * bound : constraint_mass * after;
      slope += (is - was) * change;
      const real mass = then ? real(0) : constraint_mass;
      const real mass_before = zone ? real(0) : constraint_mass;
      curvature += (mass - mass_before) * change * change;
      some = true;
    }
  }
};

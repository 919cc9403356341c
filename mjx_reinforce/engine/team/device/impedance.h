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
DEV real row_mass(real strength, real weight) {
  const real r = (1 - strength) / strength * weight;
  return 1 / (r > real(1e-15) ? r : real(1e-15));
}

// What rows add to the derivative of the cost along a step, beyond the quadratic at its start, and
// whether there is anything.
struct Bend {
  real slope, curvature;
  bool some;
  // A row whose force is linear where it pushes: gap at the start, how it changes, where it is now.
  DEV void add(real mass, real gap, real change, real length) {
    const real now = gap + length * change;
    if ((gap < 0) != (now < 0)) {
      const real by = now < 0 ? mass * change : -mass * change;
      slope += by * now;
      curvature += by * change;
      some = true;
    }
  }
  // A row of friction loss, whose force is bounded.
  DEV void add_bounded(real mass, real bound, real gap, real change, real length) {
    const real now = gap + length * change, reach = bound / mass;
    const int zone = gap <= -reach ? -1 : gap >= reach, then = now <= -reach ? -1 : now >= reach;
    if (zone != then) {
      const real is = then ? then * bound : mass * now, was = zone ? zone * bound : mass * now;
      slope += (is - was) * change;
      curvature += ((then ? real(0) : mass) - (zone ? real(0) : mass)) * change * change;
      some = true;
    }
  }
};

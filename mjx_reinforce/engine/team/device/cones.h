// Elliptic friction cones (MuJoCo's mj_constraintUpdate and PrimalEval). In the scaled residual, mu
// times the normal's and friction times each tangent's, the cone is circular: N is its first entry,
// T the length of the others.
#pragma once

enum Zone { OUTSIDE, SLIDES, STICKS };  // C's top, middle and bottom zone

// The cost of a contact and its derivatives along a step.
struct ConeCost {
  Zone zone;
  real cost, slope, curvature;
};

DEV Zone zone_of(real mu, real normal, real tangent) {
  if (tangent > 0 ? normal >= mu * tangent : normal >= 0) return OUTSIDE;
  return tangent > 0 && mu * normal + tangent > 0 ? SLIDES : STICKS;
}

// The cost at a length along the step.
DEV ConeCost cone_cost(const Model& M, const Contact& c, real length) {
  const int kind = M.item_kind[c.item], dim = M.kind_dim[kind];
  const real mu = mu_of(M, c, kind), stiffness = c.constraint_mass / (mu * mu);
  const real change = mu * c.change[0], normal = mu * c.residual[0] + length * change;
  real square = 0, half_slope = 0, half_curvature = 0;
  UNROLL for (int k = 1; k < CD; k++) {
    if (k >= dim) break;
    const real friction = friction_of(M, c, kind).along[k - 1];
    const real by = friction * c.change[k], at = friction * c.residual[k] + length * by;
    square += at * at;
    half_slope += at * by;
    half_curvature += by * by;
  }
  const real tangent = root(square);
  ConeCost sum = {zone_of(mu, normal, tangent), 0, 0, 0};
  if (sum.zone == STICKS) {
    sum.cost = stiffness * (normal * normal + square) / 2;
    sum.slope = stiffness * (normal * change + half_slope);
    sum.curvature = stiffness * (change * change + half_curvature);
  } else if (sum.zone == SLIDES) {
    const real gap = normal - mu * tangent, scale = stiffness / (1 + mu * mu);
    const real tangent_slope = half_slope / tangent;
    const real tangent_curvature = (half_curvature - tangent_slope * tangent_slope) / tangent;
    const real gap_slope = change - mu * tangent_slope;
    sum.cost = scale * gap * gap / 2;
    sum.slope = scale * gap * gap_slope;
    sum.curvature = scale * (gap_slope * gap_slope - mu * gap * tangent_curvature);
  }
  return sum;
}
// What the contact adds to the derivative beyond the quadratic at the start. A cone that slides has
// no quadratic cost: there is always something.
DEV void bend_cone(const Model& M, const Contact& c, real length, Bend& sum) {
  const ConeCost start = cone_cost(M, c, 0), end = cone_cost(M, c, length);
  if (start.zone == end.zone && start.zone != SLIDES) return;
  sum.slope += end.slope - start.slope - length * start.curvature;
  sum.curvature += end.curvature - start.curvature;
  sum.some = true;
}

// Finds the force and the stiffness of a contact. The stiffness of the tangents is a diagonal and,
// where the contact slides, c.stiffness[COUPLING] times the square of the stiffness of normal and
// tangents.
DEV void push_cone(const Model& M, Contact& c) {
  const int kind = M.item_kind[c.item], dim = M.kind_dim[kind];
  const real mu = mu_of(M, c, kind), normal = mu * c.residual[0];
  real scaled[CD], square = 0;
  UNROLL for (int k = 1; k < CD; k++) {
    const bool has_row = k < dim;
    scaled[k] = has_row ? friction_of(M, c, kind).along[k - 1] * c.residual[k] : real(0);
    square += scaled[k] * scaled[k];
  }
  const real tangent = root(square);
  const Zone zone = zone_of(mu, normal, tangent);
  const real stiffness = c.constraint_mass / (mu * mu);
  const real scale = stiffness / (1 + mu * mu), gap = normal - mu * tangent;
  c.stiffness[COUPLING] = 0;
  if (zone == STICKS) {
    c.force[0] = -c.constraint_mass * c.residual[0];
    c.stiffness[0] = c.constraint_mass;
  } else if (zone == SLIDES) {
    c.force[0] = -scale * gap * mu;
    c.stiffness[0] = scale * mu * mu;
    c.stiffness[COUPLING] = normal / (tangent * scale * mu * mu * mu);
  }
  UNROLL for (int k = 1; k < CD; k++) {
    if (zone == OUTSIDE || k >= dim) break;
    const real friction = friction_of(M, c, kind).along[k - 1];
    if (zone == STICKS) {
      c.force[k] = -stiffness * friction * scaled[k];
      c.stiffness[CD - 1 + k] = stiffness * friction * friction;
    } else {
      const real share = friction * scaled[k] / tangent;
      c.force[k] = scale * gap * mu * share;
      c.stiffness[k] = -c.stiffness[0] * share;
      c.stiffness[CD - 1 + k] = scale * mu * (mu - normal / tangent) * friction * friction;
    }
  }
}

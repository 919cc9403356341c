// Contacts of spheres, capsules and planes.
#pragma once

// Geoms in MuJoCo's order; round are spheres and capsules.
enum { PLANE, ROUND, ELLIPSOID, CYLINDER, BOX, MESH };
// Whether the model has two such geoms that may meet; the flatter one comes first in that order.
DEV constexpr bool may_meet(int flat, int other) {
  return KIND_PAIRS >> (other * (other + 1) / 2 + flat) & 1;
}

struct Touch {
  real distance, at[3], normal[3], tangent[3];
};

// Axes are parallel below this product of the squares of lengths and of the sine (m^4).
constexpr real PARALLEL = real(SINGLE ? 1e-12 : 1e-15);

// Where the axes of two round geoms are closest, from their centers (m), as mjraw_CapsuleCapsule
// has it.
DEV void closest(const Quad& p, const Quad& a, real half_a, const Quad& q, const Quad& b,
                 real half_b, real& on_a, real& on_b) {
  real d[3];
  for (int k = 0; k < 3; k++) d[k] = p.x[k] - q.x[k];
  const real both = dot(a.x, b.x), x = dot(a.x, d), y = dot(b.x, d), square = 1 - both * both;
  if (square * half_a * half_a * half_b * half_b < PARALLEL) {
    // Parallel (or a sphere): the middle of where they are side by side.
    const real end = clip(both * half_b - x, -half_a, half_a);
    on_a = (end + clip(-both * half_b - x, -half_a, half_a)) / 2;
    on_b = clip(both * on_a + y, -half_b, half_b);
    return;
  }
  on_a = clip((both * y - x) / square, -half_a, half_a);
  const real free = both * on_a + y;
  on_b = clip(free, -half_b, half_b);
  if (on_b != free) on_a = clip(both * on_b - x, -half_a, half_a);
}
// Two spheres about points p and q (mjraw_SphereSphere).
DEV void touch_spheres(Touch& c, const real* p, real radius_p, const real* q, real radius_q) {
  for (int k = 0; k < 3; k++) c.normal[k] = q[k] - p[k];
  const real length = root(dot(c.normal, c.normal));
  for (int k = 0; k < 3; k++)
    c.normal[k] = length < real(1e-15) ? real(k == 0) : c.normal[k] / length;
  c.distance = length - radius_p - radius_q;
  for (int k = 0; k < 3; k++) c.at[k] = p[k] + c.normal[k] * (radius_p + c.distance / 2);
}
// A point, or a sphere about it, above a plane (mjraw_PlaneSphere).
DEV void touch_plane(Touch& c, const Quad& plane, const Quad& up, const real* p, real radius) {
  real d[3];
  for (int k = 0; k < 3; k++) {
    d[k] = p[k] - plane.x[k];
    c.normal[k] = up.x[k];
  }
  c.distance = dot(d, c.normal) - radius;
  for (int k = 0; k < 3; k++) c.at[k] = p[k] - c.normal[k] * (c.distance / 2 + radius);
}
// Two spheres, two capsules, or one of each (mjraw_CapsuleCapsule, mjraw_SphereCapsule).
DEV void touch_rounds(const Model& M, const State& s, int a, int b, Touch& c) {
  real on_a, on_b, p[3], q[3];
  const Quad pa = s.geom_place[a], za = s.geom_axis[a], pb = s.geom_place[b], zb = s.geom_axis[b];
  closest(pa, za, M.geom_half[a], pb, zb, M.geom_half[b], on_a, on_b);
  for (int k = 0; k < 3; k++) {
    p[k] = pa.x[k] + on_a * za.x[k];
    q[k] = pb.x[k] + on_b * zb.x[k];
  }
  touch_spheres(c, p, M.geom_radius[a], q, M.geom_radius[b]);
}

// The axes of a contact as mju_makeFrame has them.
DEV void make_frame(real* frame, const Touch& c) {
  real along[3] = {c.tangent[0], c.tangent[1], c.tangent[2]};
  if (dot(along, along) < real(.25)) {
    const bool y = fabs(c.normal[1]) < real(.5);
    along[0] = 0; along[1] = y; along[2] = !y;
  }
  const real across = dot(c.normal, along);
  for (int k = 0; k < 3; k++) along[k] -= across * c.normal[k];
  const real square = dot(along, along);
  const bool upright = square < real(1e-30);  // a capsule that stands on a plane
  const real scale = inverse_root(upright ? real(1) : square);
  if (upright) along[0] = 1;
  for (int k = 0; k < 3; k++) {
    frame[k] = c.normal[k];
    frame[3 + k] = scale * along[k];
  }
  cross(frame + 6, frame, frame + 3);
}

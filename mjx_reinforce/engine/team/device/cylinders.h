// Contacts of cylinders and ellipsoids.
#pragma once

// Below this square of its sine, the angle between an axis and a plane's normal is rounding.
constexpr real UPRIGHT = real(SINGLE ? 1e-12 : 1e-30);

// A cylinder above a plane (mjc_PlaneCylinder). The parts are the lowest point of the lower disk,
// that of the upper disk, and two points that make a triangle with the first.
DEV void touch_cylinder_on_plane(const Model& M, const State& s, int a, int b, int part, Touch& c) {
  const Quad center = s.geom_place[b], axis = s.geom_axis[b], up = s.geom_axis[a];
  const real radius = M.geom_radius[b], slope = dot(axis.x, up.x);
  real down[3], side[3], p[3];
  for (int k = 0; k < 3; k++) down[k] = slope * axis.x[k] - up.x[k];
  const real square = dot(down, down), scale = radius * inverse_root(square);
  const Pose pose = geom_pose(M, s, b);
  for (int k = 0; k < 3; k++)
    down[k] = square > UPRIGHT ? scale * down[k] : radius * pose.row[k].x[0];
  cross(side, down, axis.x);
  const real along = (slope > 0) == (part == 1) ? M.geom_half[b] : -M.geom_half[b];
  const real by_down = part < 2 ? real(1) : real(-.5), sine = real(.8660254037844386);
  const real by_side = part < 2 ? real(0) : part == 2 ? sine : -sine;
  for (int k = 0; k < 3; k++)
    p[k] = center.x[k] + along * axis.x[k] + by_down * down[k] + by_side * side[k];
  touch_plane(c, s.geom_place[a], up, p, 0);
}

// An ellipsoid above a plane, by its lowest point (mjc_PlaneConvex).
DEV void touch_ellipsoid_on_plane(const Model& M, const State& s, int a, int b, Touch& c) {
  const Pose pose = geom_pose(M, s, b);
  const real* size = M.geom_size + 3 * b;
  real lowest[3], p[3];
  pose.turn_back(lowest, s.geom_axis[a].x);
  for (int k = 0; k < 3; k++) lowest[k] *= size[k];
  const real scale = -inverse_root(dot(lowest, lowest));
  for (int k = 0; k < 3; k++) lowest[k] *= scale * size[k];
  pose.place(p, lowest);
  touch_plane(c, s.geom_place[a], s.geom_axis[a], p, 0);
}

// A sphere and a cylinder: its side, an end, or the edge between (mjc_SphereCylinder).
DEV void touch_sphere_and_cylinder(const Model& M, const State& s, int a, int b, Touch& c) {
  const Quad p = s.geom_place[a], q = s.geom_place[b], axis = s.geom_axis[b];
  const real radius = M.geom_radius[b], half = M.geom_half[b];
  real d[3], out[3], on[3];
  for (int k = 0; k < 3; k++) d[k] = p.x[k] - q.x[k];
  const real along = dot(d, axis.x), end = along > 0 ? half : -half;
  for (int k = 0; k < 3; k++) out[k] = d[k] - along * axis.x[k];
  const real away = root(dot(out, out));
  bool by_side = fabs(along) < half, by_end = away < radius;
  // A center inside the cylinder leaves it the shorter way.
  if (by_side && by_end) (half - fabs(along) < radius - away ? by_side : by_end) = false;
  if (by_side || !by_end) {
    const real share = by_side ? real(0) : radius / away, at = by_side ? along : end;
    for (int k = 0; k < 3; k++) on[k] = q.x[k] + at * axis.x[k] + share * out[k];
    touch_spheres(c, p.x, M.geom_radius[a], on, by_side ? radius : real(0));
  } else {
    Quad cap, up;
    for (int k = 0; k < 3; k++) {
      cap.x[k] = q.x[k] + end * axis.x[k];
      up.x[k] = along > 0 ? axis.x[k] : -axis.x[k];
    }
    touch_plane(c, cap, up, p.x, M.geom_radius[a]);
    for (int k = 0; k < 3; k++) c.normal[k] = -c.normal[k];
  }
}

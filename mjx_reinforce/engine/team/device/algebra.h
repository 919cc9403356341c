// Vectors, quaternions, rotations, and spatial vectors: the angular part first.
#pragma once

DEV void cross(real* r, const real* a, const real* b) {
  const real x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2];
  r[2] = a[0] * b[1] - a[1] * b[0];
  r[0] = x;
  r[1] = y;
}
DEV real dot(const real* a, const real* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
DEV real dot6(const real* a, const real* b) { return dot(a, b) + dot(a + 3, b + 3); }
DEV real clip(real x, real low, real high) { return x < low ? low : x > high ? high : x; }

// mju_mulQuat and mju_normalize4.
DEV void quat_times(real* r, const real* a, const real* b) {
  const real w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  const real x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  const real y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  const real z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
  r[0] = w; r[1] = x; r[2] = y; r[3] = z;
}
DEV void to_unit(real* q) {
  const real scale = inverse_root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; k++) q[k] *= scale;
}

// A pose is three rows: a row of the rotation, then a coordinate of the origin.
struct Pose {
  Quad row[3];
  DEV real origin(int k) const { return row[k].x[3]; }
  DEV void turn(real* r, const real* a) const {
    for (int k = 0; k < 3; k++) r[k] = dot(row[k].x, a);
  }
  DEV void turn_back(real* r, const real* a) const {
    for (int k = 0; k < 3; k++) r[k] = row[0].x[k] * a[0] + row[1].x[k] * a[1] + row[2].x[k] * a[2];
  }
  DEV void place(real* r, const real* a) const {
    for (int k = 0; k < 3; k++) r[k] = dot(row[k].x, a) + row[k].x[3];
  }
};
// mju_quat2Mat, with an origin.
DEV Pose pose_of(const real* q, const real* at) {
  const real w = q[0], x = q[1], y = q[2], z = q[3];
  Pose p;
  p.row[0] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), at[0]};
  p.row[1] = {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), at[1]};
  p.row[2] = {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), at[2]};
  return p;
}

// A symmetric matrix (xx, yy, zz, xy, xz, yz) seen from outside a frame: R A R'.
DEV void turn_symmetric(real* r, const Pose& p, const real* a) {
  real t[3][3];
  for (int k = 0; k < 3; k++) {
    const real* m = p.row[k].x;
    t[k][0] = m[0] * a[0] + m[1] * a[3] + m[2] * a[4];
    t[k][1] = m[0] * a[3] + m[1] * a[1] + m[2] * a[5];
    t[k][2] = m[0] * a[4] + m[1] * a[5] + m[2] * a[2];
  }
  for (int k = 0; k < 3; k++) r[k] = dot(t[k], p.row[k].x);
  r[3] = dot(t[0], p.row[1].x);
  r[4] = dot(t[0], p.row[2].x);
  r[5] = dot(t[1], p.row[2].x);
}
// The spatial inertia [10] about a point, of a body with its center at d from there, and its own
// inertia [6] about the center (mju_inertCom): xx, yy, zz, xy, xz, yz, mass * d, mass.
DEV void spatial_inertia(real* r, const real* own, real mass, const real* d) {
  const real square = dot(d, d);
  for (int k = 0; k < 3; k++) {
    r[k] = own[k] + mass * (square - d[k] * d[k]);
    r[6 + k] = mass * d[k];
  }
  r[3] = own[3] - mass * d[0] * d[1];
  r[4] = own[4] - mass * d[0] * d[2];
  r[5] = own[5] - mass * d[1] * d[2];
  r[9] = mass;
}
// mju_mulInertVec.
DEV void inertia_times(real* r, const real* i, const real* v) {
  r[0] = i[0] * v[0] + i[3] * v[1] + i[4] * v[2] - i[8] * v[4] + i[7] * v[5];
  r[1] = i[3] * v[0] + i[1] * v[1] + i[5] * v[2] + i[8] * v[3] - i[6] * v[5];
  r[2] = i[4] * v[0] + i[5] * v[1] + i[2] * v[2] - i[7] * v[3] + i[6] * v[4];
  r[3] = i[8] * v[1] - i[7] * v[2] + i[9] * v[3];
  r[4] = i[6] * v[2] - i[8] * v[0] + i[9] * v[4];
  r[5] = i[7] * v[0] - i[6] * v[1] + i[9] * v[5];
}
// mju_crossMotion and mju_crossForce.
DEV void cross_motion(real* r, const real* v, const real* m) {
  real a[3];
  cross(a, v + 3, m);
  cross(r + 3, v, m + 3);
  cross(r, v, m);
  for (int k = 0; k < 3; k++) r[3 + k] += a[k];
}
DEV void cross_force(real* r, const real* v, const real* f) {
  real a[3];
  cross(a, v + 3, f + 3);
  cross(r, v, f);
  cross(r + 3, v, f + 3);
  for (int k = 0; k < 3; k++) r[k] += a[k];
}

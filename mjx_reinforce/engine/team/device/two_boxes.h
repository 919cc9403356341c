// Contacts of two boxes (mjc_BoxBox of MuJoCo 3.12 and later): first the direction in which they
// are furthest apart, of the normals of faces and of the products of two edges, then the contacts
// of a face with what of the other box's face is above it, or of two edges.
#pragma once

// What is rounding: of a gap, by the sum of sizes; of the square of the sine of two edges; of the
// square of a distance of corners, by that of sizes.
constexpr real GAP_ROUNDING = real(SINGLE ? 1e-6 : 1e-13);
constexpr real SINE_ROUNDING = real(SINGLE ? 1e-7 : 1e-16);
constexpr real SAME_CORNER = real(SINGLE ? 1e-10 : 1e-14);
// A quadrangle that is cut by four lines has 8 corners; more are rounding.
constexpr int MOST_CORNERS = 12;

// Two boxes, each as it sees the other one.
struct TwoBoxes {
  Pose pose[2];
  const real* size[2];
  real center[2][3];   // of the other box
  real turn[2][3][3];  // of the other box: column j is its axis j

  DEV TwoBoxes(const Model& M, const State& s, int a, int b) {
    pose[0] = geom_pose(M, s, a);
    pose[1] = geom_pose(M, s, b);
    size[0] = M.geom_size + 3 * a;
    size[1] = M.geom_size + 3 * b;
    for (int side = 0; side < 2; side++) {
      const Pose &p = pose[side], &q = pose[1 - side];
      real away[3];
      for (int k = 0; k < 3; k++) away[k] = q.origin(k) - p.origin(k);
      p.turn_back(center[side], away);
      for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
          turn[side][i][j] = p.row[0].x[i] * q.row[0].x[j] + p.row[1].x[i] * q.row[1].x[j] +
                             p.row[2].x[i] * q.row[2].x[j];
    }
  }
};
// The direction that was found: the number of a face, and that of a pair of edges or -1.
struct Apart {
  int face, edges;
  real axis[3], other_axis[3];  // of the edges, as each box sees it
};

// Returns whether the boxes are nearer than `most` in all directions.
DEV bool direction_apart(const TwoBoxes& two, real most, Apart& apart) {
  real by_face = real(-1e30), by_edges;
  LOOP for (int n = 0; n < 6; n++) {
    const int side = n / 3, i = n % 3;
    real gap = fabs(two.center[side][i]) - two.size[side][i];
    for (int j = 0; j < 3; j++) gap -= fabs(two.turn[side][i][j]) * two.size[1 - side][j];
    if (gap > most) return false;
    if (gap > by_face) by_face = gap, apart.face = n;
  }
  by_edges = by_face;
  apart.edges = -1;
  LOOP for (int n = 0; n < 9; n++) {
    const int i = n / 3, j = n % 3;
    real along[3] = {real(i == 0), real(i == 1), real(i == 2)}, axis[3], other_axis[3];
    const real other_along[3] = {two.turn[0][0][j], two.turn[0][1][j], two.turn[0][2][j]};
    cross(axis, along, other_along);
    const real square = dot(axis, axis);
    if (square < SINE_ROUNDING) continue;
    const real scale = inverse_root(square);
    for (int k = 0; k < 3; k++) axis[k] *= scale;
    for (int k = 0; k < 3; k++) other_axis[k] = dot(two.turn[1][k], axis);
    real gap = fabs(dot(axis, two.center[0]));
    for (int k = 0; k < 3; k++)
      gap -= two.size[0][k] * fabs(axis[k]) + two.size[1][k] * fabs(other_axis[k]);
    if (gap > most) return false;
    // Where a face is as good, it is better: it has more contacts.
    if (gap - real(1e-6) * fabs(gap) > by_edges && gap > by_face) {
      by_edges = gap;
      apart.edges = n;
      for (int k = 0; k < 3; k++) apart.axis[k] = axis[k], apart.other_axis[k] = other_axis[k];
    }
  }
  if (apart.edges < 0) return true;
  const real* axis = apart.face < 3 ? apart.axis : apart.other_axis;
  if (fabs(axis[apart.face % 3]) > real(.99) &&
      by_edges < by_face + real(.05) * fabs(by_face) + real(1e-15))
    apart.edges = -1;
  return true;
}

// Where two edges are closest. C also tries the edges across the boxes where a component of the
// direction is zero; then it is a face's, and the face was taken.
DEV void touch_edges(const TwoBoxes& two, const Apart& apart, Touch& c) {
  const int i = apart.edges / 3, j = apart.edges % 3;
  const real *size = two.size[0], *other_size = two.size[1];
  const real sign = dot(apart.axis, two.center[0]) < 0 ? real(-1) : real(1);
  const real along[3] = {two.turn[0][0][j], two.turn[0][1][j], two.turn[0][2][j]};
  real axis[3], corner[3], p[3], q[3], d[3];
  for (int k = 0; k < 3; k++) {
    axis[k] = sign * apart.axis[k];
    p[k] = k == i ? real(0) : axis[k] >= 0 ? size[k] : -size[k];
    corner[k] = k == j ? real(0) : sign * apart.other_axis[k] >= 0 ? -other_size[k] : other_size[k];
  }
  for (int k = 0; k < 3; k++) {
    q[k] = dot(two.turn[0][k], corner) + two.center[0][k];
    d[k] = q[k] - p[k];
  }
  const real both = along[i], by_p = d[i], by_q = dot(along, d);
  const real on_p = clip((by_p - both * by_q) / (1 - both * both), -size[i], size[i]);
  const real on_q = clip(both * on_p - by_q, -other_size[j], other_size[j]);
  p[i] += clip(by_p + both * on_q, -size[i], size[i]);
  for (int k = 0; k < 3; k++) {
    q[k] += on_q * along[k];
    d[k] = q[k] - p[k];
    p[k] = (p[k] + q[k]) / 2;
  }
  c.distance = dot(d, axis);
  two.pose[0].place(c.at, p);
  two.pose[0].turn(c.normal, axis);
}

// Cuts off what of a polygon is beyond a line. A corner is two places in the plane, and the height
// above it. Returns the number of corners.
DEV int cut(const real (*from)[3], real (*to)[3], int corners, int k, real sign, real most) {
  int left = 0;
  LOOP for (int n = 0; n < corners; n++) {
    const real *p = from[n], *q = from[n + 1 == corners ? 0 : n + 1];
    const real beyond = sign * p[k] - most, next = sign * q[k] - most;
    if (beyond <= 0 && left < MOST_CORNERS) {
      for (int r = 0; r < 3; r++) to[left][r] = p[r];
      left++;
    }
    if (beyond * next < 0 && left < MOST_CORNERS) {
      const real share = beyond / (beyond - next);
      for (int r = 0; r < 3; r++) to[left][r] = p[r] + share * (q[r] - p[r]);
      left++;
    }
  }
  return left;
}

// The part-th of the corners of the other box's face that are above a face and near enough.
DEV void touch_faces(const TwoBoxes& two, int face, int part, real margin, Touch& c) {
  const int side = face / 3, z = face % 3, x = (z + 1) % 3, y = (z + 2) % 3;
  const real(*turn)[3] = two.turn[side], *size = two.size[side], *other_size = two.size[1 - side];
  const real sign = two.center[side][z] >= 0 ? real(1) : real(-1);
  int w = 0;
  for (int k = 1; k < 3; k++)
    if (fabs(turn[z][k]) > fabs(turn[z][w])) w = k;
  const int u = (w + 1) % 3, v = (w + 2) % 3;
  const real below = sign * turn[z][w] > 0 ? real(-1) : real(1);
  real corners[2][MOST_CORNERS][3];
  for (int r = 0; r < 3; r++) {
    const int d = r == 0 ? x : r == 1 ? y : z;
    const real middle = two.center[side][d] + below * other_size[w] * turn[d][w];
    const real by_u = other_size[u] * turn[d][u], by_v = other_size[v] * turn[d][v];
    for (int n = 0; n < 4; n++) {
      const real at = middle + (n == 0 || n == 3 ? by_u : -by_u) + (n < 2 ? by_v : -by_v);
      corners[0][n][r] = r < 2 ? at : sign * at - size[z];
    }
  }
  int left = 4, kept = 0;
  LOOP for (int n = 0; n < 4; n++)
    left = cut(corners[n & 1], corners[~n & 1], left, n / 2, n & 1 ? real(-1) : real(1),
               size[n < 2 ? x : y]);
  LOOP for (int n = 0; n < left; n++) {
    const real* p = corners[0][n];
    bool keeps = p[2] <= margin;
    LOOP for (int m = 0; m < kept; m++) {
      const real dx = corners[0][m][0] - p[0], dy = corners[0][m][1] - p[1];
      keeps &= dx * dx + dy * dy >= SAME_CORNER * (size[x] * size[x] + size[y] * size[y]);
    }
    if (!keeps) continue;
    for (int r = 0; r < 3; r++) corners[0][kept][r] = p[r];
    kept++;
  }
  if (part >= kept) return;
  const real* corner = corners[0][part];
  real at[3];
  at[x] = corner[0];
  at[y] = corner[1];
  at[z] = sign * (size[z] + corner[2] / 2);
  c.distance = corner[2];
  two.pose[side].place(c.at, at);
  for (int k = 0; k < 3; k++) c.normal[k] = (side ? -sign : sign) * two.pose[side].row[k].x[z];
}

// A part is a corner of the polygon in which faces meet; all parts find the same polygon, each on a
// lane of its own.
DEV void touch_boxes(const Model& M, const State& s, int a, int b, int part, real margin,
                     Touch& c) {
  const TwoBoxes two(M, s, a, b);
  real sizes = 0;
  for (int k = 0; k < 3; k++) sizes += two.size[0][k] + two.size[1][k];
  Apart apart;
  c.distance = real(1e9);
  if (!direction_apart(two, margin + GAP_ROUNDING * sizes, apart)) return;
  if (apart.edges < 0) {
    touch_faces(two, apart.face, part, margin, c);
  } else if (part == 0) {
    touch_edges(two, apart, c);
  }
}

// How far two convex solids are apart (MuJoCo's engine_collision_gjk.c): the simplex of their
// difference that is closest to the origin, after Montanari, Petrinic and Barbieri (ACM
// Transactions on Graphics 36, 2017).
#pragma once

// What is rounding of a gap's square, by the square.
constexpr real SAME_GAP = real(SINGLE ? 1e-6 : 0);

struct Simplex {
  Corner corner[4];
  int size;
  real gap[3];      // from the origin to the closest point, which is on_first less on_second
  real on_first[3];
  bool is_apart;    // whether the solids do not overlap
};

DEV real volume(const real* a, const real* b, const real* c) {
  real normal[3];
  cross(normal, b, c);
  return dot(a, normal);
}
// Twice the areas in a triangle's plane of what the origin makes with its sides, times the last
// result, which is that of the triangle, squared.
DEV real areas(const real* a, const real* b, const real* c, real* normal, real* part) {
  real ab[3], ac[3];
  for (int k = 0; k < 3; k++) ab[k] = b[k] - a[k], ac[k] = c[k] - a[k];
  cross(normal, ab, ac);
  const real square = dot(normal, normal), off = dot(normal, a) / square;
  real from[3][3];
  for (int k = 0; k < 3; k++) {
    from[0][k] = a[k] - off * normal[k];
    from[1][k] = b[k] - off * normal[k];
    from[2][k] = c[k] - off * normal[k];
  }
  for (int n = 0; n < 3; n++) part[n] = volume(normal, from[(n + 1) % 3], from[(n + 2) % 3]);
  return square;
}

// The weights of a line's ends in its point closest to the origin; the last alone where that is an
// end: the simplices around have the other one.
DEV void nearest(const real* const (&p)[2], real* weight) {
  real d[3];
  for (int k = 0; k < 3; k++) d[k] = p[1][k] - p[0][k];
  const real first = dot(p[1], d) / dot(d, d);
  const bool is_within = first > 0 && first < 1;
  weight[0] = is_within ? first : real(0);
  weight[1] = is_within ? 1 - first : real(1);
}
DEV void nearest(const real* const (&p)[3], real* weight);
// The same of a triangle or a tetrahedron. Each part is its share of the whole; where some are
// not of its sign, the closest point is on a side across from one of these corners.
template <int N>
DEV bool nearest_side(const real* const (&p)[N], const real* part, real whole, real* weight) {
  bool is_within = true;
  for (int n = 0; n < N; n++) is_within &= part[n] * whole > 0;
  for (int n = 0; n < N; n++) weight[n] = is_within ? part[n] / whole : real(0);
  if (is_within) return true;
  real least = real(1e30);
  LOOP for (int n = 0; n < N; n++) {
    if (part[n] * whole > 0) continue;
    const real* side[N - 1];
    real share[N - 1], at[3] = {};
    for (int m = 0; m < N - 1; m++) side[m] = p[m + (m >= n)];
    nearest(side, share);
    for (int m = 0; m < N - 1; m++)
      for (int k = 0; k < 3; k++) at[k] += share[m] * side[m][k];
    const real square = dot(at, at);
    if (!(square < least)) continue;
    least = square;
    for (int m = 0; m < N; m++) weight[m] = m == n ? real(0) : share[m - (m > n)];
  }
  return false;
}
DEV void nearest(const real* const (&p)[3], real* weight) {
  real normal[3], part[3];
  const real whole = areas(p[0], p[1], p[2], normal, part);
  if (whole != 0) {
    nearest_side(p, part, whole, weight);
    return;
  }
  const real* line[2] = {p[0], p[1]};
  nearest(line, weight);
  weight[2] = 0;
}
DEV void nearest(const real* const (&p)[4], real* weight) {
  const real part[4] = {-volume(p[1], p[2], p[3]), volume(p[0], p[2], p[3]),
                        -volume(p[0], p[1], p[3]), volume(p[0], p[1], p[2])};
  nearest_side(p, part, part[0] + part[1] + part[2] + part[3], weight);
}
// Keeps of a simplex what its closest point needs, with its weights.
DEV void reduce(Simplex& s, real* weight) {
  const real* p[4];
  for (int n = 0; n < 4; n++) p[n] = s.corner[n].at;
  for (int n = 0; n < 4; n++) weight[n] = real(n == 0);
  if (s.size == 2) {
    const real* line[2] = {p[0], p[1]};
    nearest(line, weight);
  } else if (s.size == 3) {
    const real* triangle[3] = {p[0], p[1], p[2]};
    nearest(triangle, weight);
  } else if (s.size == 4) {
    nearest(p, weight);
  }
  s.size = 0;
  for (int k = 0; k < 3; k++) s.gap[k] = 0;
  for (int n = 0; n < 4; n++) {
    if (weight[n] == 0) continue;
    for (int k = 0; k < 3; k++) s.gap[k] += weight[n] * s.corner[n].at[k];
    s.corner[s.size] = s.corner[n];
    weight[s.size++] = weight[n];
  }
}

// Returns the distance of two solids, and the simplex that shows it; where they are further apart
// than `most`, only that.
DEV real approach(const Model& M, TwoSolids& two, real most, Simplex& s) {
  // Between flat faces the search ends by itself.
  const real enough = two.have_corners ? real(0) : CONVEX_TOLERANCE * CONVEX_TOLERANCE / 2;
  const real touching = two.have_corners ? LEAST : CONVEX_TOLERANCE;
  for (int k = 0; k < 3; k++)
    s.gap[k] = two.side[0].pose.origin(k) - two.side[1].pose.origin(k);
  s.size = 0;
  s.is_apart = false;
  real length = root(dot(s.gap, s.gap)), before = 0, weight[4], direction[3];
  LOOP for (int steps = 0; steps < CONVEX_STEPS; steps++) {
    if (length < touching || fabs(before - length) < LEAST) break;
    Corner& c = s.corner[s.size];
    for (int k = 0; k < 3; k++) direction[k] = -s.gap[k] / length;
    find_corner(M, two, direction, c);
    const real along = dot(s.gap, c.at);
    real rest[3];
    for (int k = 0; k < 3; k++) rest[k] = s.gap[k] - c.at[k];
    if (dot(s.gap, rest) < enough + SAME_GAP * length * length) break;
    if (along > 0 && along >= most * length) {
      s.is_apart = true;
      s.size = 0;
      return real(1e30);
    }
    s.size++;
    reduce(s, weight);
    before = steps > 0 ? length : real(0);  // the centers are no corner
    length = root(dot(s.gap, s.gap));
    if (s.size == 4) break;
  }
  for (int k = 0; k < 3; k++) {
    s.on_first[k] = 0;
    for (int n = 0; n < s.size; n++) s.on_first[k] += weight[n] * s.corner[n].on[k];
  }
  if (length > 0) {
    Corner last;
    for (int k = 0; k < 3; k++) direction[k] = -s.gap[k] / length;
    find_corner(M, two, direction, last);
    s.is_apart = dot(s.gap, last.at) > 0;
  }
  return s.size == 4 && !s.is_apart ? real(0) : length;
}

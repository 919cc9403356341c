// How deep two convex solids are in one another (MuJoCo's engine_collision_gjk.c): a polytope in
// their difference grows, by a corner a step, where its surface is closest to the origin.
#pragma once

constexpr int MOST_CORNERS_OF_ONE = CONVEX_STEPS + 5;
constexpr int MOST_FACES = 2 * MOST_CORNERS_OF_ONE;  // by Euler, four fewer
// The origin is on a face, by the square of its distance (C's numbers for both precisions).
constexpr real ON_FACE = real(SINGLE ? 1e-10 : 1e-30);
constexpr real ON_TETRAHEDRON = real(SINGLE ? 1e-17 : 1e-30);
// Between flat faces the search ends by itself; what is left is rounding.
constexpr real SAME_DEPTH = real(SINGLE ? 1e-7 : 1e-15);
constexpr real DEPTH_ROUNDING = real(SINGLE ? 1e-6 : 1e-10);

// A triangle: its corners, the faces across its sides, and the point of its plane closest to the
// origin. Of the faces that may be the closest, `place` is the number among these; others have
// KEPT or, where they are no longer of the polytope, GONE.
struct Face {
  unsigned char corner[3], next[3];
  short place;
  real nearest[3], square;
};
enum { KEPT = -1, GONE = -2 };

struct Polytope {
  Corner corner[MOST_CORNERS_OF_ONE];
  Face face[MOST_FACES];
  unsigned char candidate[MOST_FACES], spare[MOST_FACES];  // faces that may be closest; unused ones
  short rim[MOST_FACES + 4];                               // sides of faces: 4 * face + side
  real center[3];
  int corners, candidates, spares, rims;
};

// Makes a face; returns the square of its plane's distance from the origin, 0 without a plane.
DEV real make_face(Polytope& p, int number, int a, int b, int c, int ab, int bc, int ca) {
  Face& face = p.face[number];
  const unsigned char corners[3] = {(unsigned char)a, (unsigned char)b, (unsigned char)c};
  const unsigned char next[3] = {(unsigned char)ab, (unsigned char)bc, (unsigned char)ca};
  for (int k = 0; k < 3; k++) face.corner[k] = corners[k], face.next[k] = next[k];
  face.place = KEPT;
  const real *first = p.corner[a].at, *second = p.corner[b].at, *third = p.corner[c].at;
  real side[3], other[3], normal[3], outward = 0;
  for (int k = 0; k < 3; k++) {
    side[k] = first[k] - second[k];
    other[k] = second[k] - third[k];
  }
  cross(normal, side, other);
  const real square = dot(normal, normal);
  face.square = 0;
  if (square == 0) return 0;
  const real scale = dot(normal, second) / square;
  for (int k = 0; k < 3; k++) {
    face.nearest[k] = scale * normal[k];
    outward += face.nearest[k] * (first[k] - p.center[k]);
  }
  if (outward < 0)
    for (int k = 0; k < 3; k++) face.nearest[k] = -face.nearest[k];
  return face.square = dot(face.nearest, face.nearest);
}
DEV void add_candidate(Polytope& p, int face) {
  p.face[face].place = short(p.candidates);
  p.candidate[p.candidates++] = (unsigned char)face;
}
DEV void remove_face(Polytope& p, int number) {
  Face& face = p.face[number];
  if (face.place >= 0) {
    const int last = p.candidate[--p.candidates];
    p.candidate[face.place] = (unsigned char)last;
    p.face[last].place = face.place;
  }
  face.place = GONE;
  p.spare[p.spares++] = (unsigned char)number;
}

// Makes the faces of a tetrahedron of corners 0 to 3, or of the two of apexes 0 and 1 upon a
// triangle of 2 to 4. Returns a face that the origin is on, or -1.
DEV int make_solid(Polytope& p, bool is_tetrahedron) {
  static const unsigned char tetrahedron[4][6] = {
      {0, 1, 2, 1, 3, 2}, {0, 3, 1, 2, 3, 0}, {0, 2, 3, 0, 3, 1}, {3, 2, 1, 2, 0, 1}};
  static const unsigned char hexahedron[6][6] = {{0, 2, 3, 1, 3, 2}, {0, 4, 2, 2, 4, 0},
                                                 {0, 3, 4, 0, 5, 1}, {1, 3, 2, 5, 0, 4},
                                                 {1, 2, 4, 3, 1, 5}, {1, 4, 3, 4, 2, 3}};
  const int faces = is_tetrahedron ? 4 : 6;
  p.candidates = p.spares = 0;
  LOOP for (int n = 0; n < faces; n++) {
    const unsigned char* f = is_tetrahedron ? tetrahedron[n] : hexahedron[n];
    const real square = make_face(p, n, f[0], f[1], f[2], f[3], f[4], f[5]);
    if (square < (is_tetrahedron ? ON_TETRAHEDRON : ON_FACE)) return n;
    add_candidate(p, n);
  }
  for (int n = MOST_FACES - 1; n >= faces; n--) p.spare[p.spares++] = (unsigned char)n;
  return -1;
}
// Adds the corner in a direction of any length.
DEV void add_corner(const Model& M, TwoSolids& two, Polytope& p, const real* direction) {
  const real square = dot(direction, direction);
  const real scale = square > LEAST * LEAST ? inverse_root(square) : real(0);
  real unit[3];
  for (int k = 0; k < 3; k++) unit[k] = scale > 0 ? scale * direction[k] : real(k == 0);
  find_corner(M, two, unit, p.corner[p.corners++]);
}
DEV void set_center(Polytope& p, int first, int count) {
  for (int k = 0; k < 3; k++) {
    p.center[k] = 0;
    for (int n = 0; n < count; n++) p.center[k] += p.corner[first + n].at[k];
    p.center[k] /= count;
  }
}
// Whether the origin and a corner are on one side of a triangle.
DEV bool is_beside(const Polytope& p, int a, int b, int c, int corner) {
  const real* at = p.corner[a].at;
  real side[3], other[3], across[3], normal[3];
  for (int k = 0; k < 3; k++) {
    side[k] = p.corner[b].at[k] - at[k];
    other[k] = p.corner[c].at[k] - at[k];
    across[k] = p.corner[corner].at[k] - at[k];
  }
  cross(normal, side, other);
  return dot(normal, across) * -dot(normal, at) > 0;
}
// Whether a corner is in the triangle of corners 2 to 4.
DEV bool is_in_triangle(const Polytope& p, int corner) {
  const real *a = p.corner[2].at, *b = p.corner[3].at, *c = p.corner[4].at;
  const real* at = p.corner[corner].at;
  real from[3][3], normal[3], part[3], square = 0;
  for (int k = 0; k < 3; k++)
    from[0][k] = a[k] - at[k], from[1][k] = b[k] - at[k], from[2][k] = c[k] - at[k];
  const real whole = areas(from[0], from[1], from[2], normal, part);
  if (part[0] < 0 || part[1] < 0 || part[2] < 0) return false;
  for (int k = 0; k < 3; k++) {
    const real off = (part[0] * from[0][k] + part[1] * from[1][k] + part[2] * from[2][k]) / whole;
    square += off * off;
  }
  return square < LEAST * LEAST;
}

// Makes a polytope around a simplex that has the origin; returns whether there is one (polytope2,
// polytope3, polytope4).
DEV bool make_polytope(const Model& M, TwoSolids& two, const Simplex& s, Polytope& p) {
  p.corners = 0;
  if (s.size == 4) {
    for (int n = 0; n < 4; n++) p.corner[n] = s.corner[n];
    p.corners = 4;
    set_center(p, 0, 4);
    const int on = make_solid(p, true);
    if (on < 0)
      return is_beside(p, 0, 1, 2, 3) && is_beside(p, 1, 2, 3, 0) && is_beside(p, 2, 3, 0, 1) &&
             is_beside(p, 3, 0, 1, 2);
    const Face& face = p.face[on];
    for (int n = 0; n < 3; n++) p.corner[n + 2] = s.corner[face.corner[n]];
  } else if (s.size == 2) {
    real d[3], across[3], turned[3];
    int least = 0;
    for (int k = 0; k < 3; k++) {
      d[k] = s.corner[1].at[k] - s.corner[0].at[k];
      if (fabs(d[k]) < fabs(d[least])) least = k;
    }
    const real axis[3] = {real(least == 0), real(least == 1), real(least == 2)};
    cross(across, axis, d);
    cross(turned, d, across);
    const real sine = real(.8660254037844386) * inverse_root(dot(d, d));
    for (int n = 0; n < 2; n++) p.corner[n] = s.corner[n];
    p.corners = 2;
    LOOP for (int n = 0; n < 3; n++) {
      real direction[3];
      for (int k = 0; k < 3; k++)
        direction[k] = n == 0 ? across[k] : (n == 1 ? sine : -sine) * turned[k] - across[k] / 2;
      add_corner(M, two, p, direction);
    }
    set_center(p, 0, 2);
    const int on = make_solid(p, false);
    if (on < 0) {  // the line has to pass through the triangle
      real from[3][3], part[3];
      for (int n = 0; n < 3; n++)
        for (int k = 0; k < 3; k++) from[n][k] = p.corner[2 + n].at[k] - p.corner[0].at[k];
      for (int n = 0; n < 3; n++) part[n] = volume(from[n], from[(n + 1) % 3], d);
      return (part[0] >= 0 && part[1] >= 0 && part[2] >= 0) ||
             (part[0] <= 0 && part[1] <= 0 && part[2] <= 0);
    }
    const Face face = p.face[on];
    const Corner corner[3] = {p.corner[face.corner[0]], p.corner[face.corner[1]],
                              p.corner[face.corner[2]]};
    for (int n = 0; n < 3; n++) p.corner[n + 2] = corner[n];
  } else {
    for (int n = 0; n < 3; n++) p.corner[n + 2] = s.corner[n];
  }
  real side[3], other[3], normal[3];
  for (int k = 0; k < 3; k++) {
    side[k] = p.corner[3].at[k] - p.corner[2].at[k];
    other[k] = p.corner[4].at[k] - p.corner[2].at[k];
  }
  cross(normal, side, other);
  if (!(dot(normal, normal) >= LEAST * LEAST)) return false;
  set_center(p, 2, 3);
  LOOP for (int apex = 0; apex < 2; apex++) {
    p.corners = apex;
    add_corner(M, two, p, normal);
    if (is_in_triangle(p, apex)) return false;
    for (int k = 0; k < 3; k++) normal[k] = -normal[k];
  }
  p.corners = 5;
  return make_solid(p, false) < 0;
}

// Takes away the faces that a corner is in front of, from one on, and lists the sides around these
// in their order (horizon).
DEV void remove_seen(Polytope& p, int first, const real* corner) {
  short waiting[MOST_FACES + 4];
  int waits = 0;
  p.rims = 0;
  remove_face(p, first);
  for (int side = 2; side >= 0; side--) waiting[waits++] = short(4 * first + side);
  LOOP while (waits > 0) {
    const int from = waiting[--waits];
    const Face& face = p.face[from / 4];
    const int number = face.next[from % 4], start = face.corner[(from % 4 + 1) % 3];
    Face& next = p.face[number];
    if (next.place == GONE) continue;
    const int side = next.corner[0] == start ? 0 : next.corner[1] == start ? 1 : 2;
    if (dot(next.nearest, corner) - next.square > LEAST) {
      remove_face(p, number);
      waiting[waits++] = short(4 * number + (side + 2) % 3);
      waiting[waits++] = short(4 * number + (side + 1) % 3);
    } else {
      p.rim[p.rims++] = short(4 * number + side);
    }
  }
}

// Grows a polytope. Returns whether the solids overlap, and the face at their depth (epa).
DEV bool grow(const Model& M, TwoSolids& two, Polytope& p, Face& deepest) {
  const real enough = two.have_corners ? SAME_DEPTH : CONVEX_TOLERANCE;
  real upper = real(1e15);
  LOOP for (int step = 0; step < CONVEX_STEPS; step++) {
    real square = real(1e30);
    int closest = 0;
    LOOP for (int n = 0; n < p.candidates; n++) {
      const int face = p.candidate[n];
      if (p.face[face].square < square) closest = face, square = p.face[face].square;
    }
    if (square > upper * upper) return true;
    deepest = p.face[closest];
    if (square <= 0) return false;
    const real lower = root(square);
    const int number = p.corners;
    add_corner(M, two, p, deepest.nearest);
    const Corner& corner = p.corner[number];
    const real bound = dot(deepest.nearest, corner.at) / lower;
    if (bound < upper) upper = bound;
    if (bound - lower < enough) return step > 0 || bound >= lower - DEPTH_ROUNDING;
    if (two.have_corners)
      LOOP for (int n = 0; n < number; n++)
        if (p.corner[n].vertex[0] == corner.vertex[0] && p.corner[n].vertex[1] == corner.vertex[1])
          return true;
    remove_seen(p, closest, corner.at);
    if (p.rims < 3) return false;
    if (p.rims > p.spares) return true;
    const int top = p.spares - 1;
    LOOP for (int n = 0; n < p.rims; n++) {
      const int old = p.rim[n] / 4, side = p.rim[n] % 4, face = p.spare[top - n];
      const int last = p.spare[top - (n == 0 ? p.rims - 1 : n - 1)];
      const int next = p.spare[top - (n + 1 == p.rims ? 0 : n + 1)];
      Face& beyond = p.face[old];
      beyond.next[side] = (unsigned char)face;
      const int a = beyond.corner[(side + 1) % 3], b = beyond.corner[side];
      const real far = make_face(p, face, number, a, b, last, old, next);
      if (far == 0) return false;
      if (far >= square && far <= upper * upper) add_candidate(p, face);
    }
    p.spares -= p.rims;
    if (p.candidates == 0) return true;
  }
  return true;
}

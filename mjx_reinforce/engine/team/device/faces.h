// Where two convex solids touch with faces or straight edges, several contacts (mjc_multicontact of
// MuJoCo 4.0): of the face of one of them, and of what of the other one's face or edge is above it.
#pragma once

// Faces are parallel, and an edge is along a face, within this cosine and sine.
constexpr real FACE_COSINE = real(.996), EDGE_SINE = real(.0888);
// What is rounding of an area, by the area: of a cylinder's end many are the largest.
constexpr real SAME_AREA = real(SINGLE ? 1e-5 : 1e-12);
constexpr int ROUND_SIDES = 16;  // of the polygon that is a cylinder's end

// What the deepest triangle has of one of the solids: its vertices, of which `count` differ, and
// the place of the first one.
struct Feature { int vertex[3], count; real at[3]; };

DEV bool has_faces(int kind) { return kind == CYLINDER || kind == BOX || kind == MESH; }
DEV bool may_have_more(const Model& M, const TwoSolids& two) {
  const int a = two.side[0].geom, b = two.side[1].geom;
  const bool first = has_faces(M.geom_kind[a]), second = has_faces(M.geom_kind[b]);
  return CONVEX_CONTACTS > 1 && ((first && (second || M.geom_half[b] > 0)) ||
                                 (second && M.geom_half[a] > 0));
}

DEV Feature feature_of(const Corner* const* corner, int side) {
  Feature f;
  for (int n = 0; n < 3; n++) f.vertex[n] = corner[n]->vertex[side];
  for (int k = 0; k < 3; k++) f.at[k] = corner[0]->on[k] - (side ? corner[0]->at[k] : real(0));
  if (f.vertex[0] == f.vertex[1]) {
    f.vertex[1] = f.vertex[2];
    f.count = f.vertex[0] == f.vertex[1] ? 1 : 2;
  } else {
    f.count = f.vertex[2] == f.vertex[0] || f.vertex[2] == f.vertex[1] ? 2 : 3;
  }
  return f;
}

// A vertex of a box or a mesh.
DEV void place_vertex(const Model& M, const Solid& solid, int vertex, real* at) {
  const bool is_mesh = is_convex(MESH) && M.geom_kind[solid.geom] == MESH;
  if (is_mesh) return mesh_vertex(at, solid.pose, vertex);
  real p[3];
  for (int k = 0; k < 3; k++) {
    const real half = M.geom_size[3 * solid.geom + k];
    p[k] = vertex >> k & 1 ? half : -half;
  }
  solid.pose.place(at, p);
}
// The normal of a face: of a box's axis face / 2, of a cylinder's end, or of a mesh.
DEV void face_normal(const Model& M, const Solid& solid, int face, real* normal) {
  const int kind = M.geom_kind[solid.geom];
  if (is_convex(MESH) && kind == MESH) return solid.pose.turn(normal, hull_face[face].normal);
  for (int k = 0; k < 3; k++) {
    const real axis = solid.pose.row[k].x[kind == BOX ? face / 2 : 2];
    normal[k] = face & 1 ? -axis : axis;
  }
}
DEV bool is_of_face(int face, int vertex) {
  int n = hull_vertex[vertex].faces;
  while (hull_faces_of[n] >= 0 && hull_faces_of[n] != face) n++;
  return hull_faces_of[n] == face;
}
// The faces that have all vertices of a feature; returns how many.
DEV int list_faces(const Model& M, const Solid& solid, const Feature& f, real sign,
                   const real* normal, int* faces) {
  const int kind = M.geom_kind[solid.geom], first = f.vertex[0];
  int count = 0;
  if (is_convex(CYLINDER) && kind == CYLINDER) {
    if (f.count == 1) faces[count++] = first;
  } else if (is_convex(BOX) && kind == BOX) {
    for (int k = 0; k < 3; k++) {
      int differ = 0;
      for (int n = 1; n < f.count; n++) differ |= (f.vertex[n] ^ first) >> k & 1;
      if (!differ) faces[count++] = 2 * k + !(first >> k & 1);
    }
    if (count) return count;
    real d[3];
    solid.pose.turn_back(d, normal);
    for (int n = 5; n >= 0; n--)
      if (sign * (n & 1 ? -d[n / 2] : d[n / 2]) > FACE_COSINE) faces[0] = n, count = 1;
  } else if (is_convex(MESH) && kind == MESH) {
    LOOP for (int n = hull_vertex[first].faces; hull_faces_of[n] >= 0; n++) {
      bool has_all = true;
      for (int m = 1; m < f.count; m++) has_all &= is_of_face(hull_faces_of[n], f.vertex[m]);
      if (has_all) faces[count++] = hull_faces_of[n];
    }
  }
  return count;
}
// The number-th edge that a feature may be on; returns whether there is one.
DEV bool find_edge(const Model& M, const Solid& solid, const Feature& f, int number, real* start,
                   real* end) {
  const int kind = M.geom_kind[solid.geom], first = f.vertex[0];
  const real half = M.geom_half[solid.geom];
  if (kind == ROUND || kind == CYLINDER) {
    if (number > 0) return false;
    real away[3], p[3];
    for (int k = 0; k < 3; k++) away[k] = f.at[k] - solid.pose.origin(k);
    solid.pose.turn_back(p, away);
    if (kind == CYLINDER) {  // the feature may be outside, by the margin
      const real square = p[0] * p[0] + p[1] * p[1];
      const real scale =
          square < LEAST * LEAST ? real(0) : M.geom_radius[solid.geom] * inverse_root(square);
      p[0] *= scale;
      p[1] *= scale;
    }
    p[2] = kind == CYLINDER && first == 0 ? half : -half;
    solid.pose.place(start, p);
    p[2] = -p[2];
    solid.pose.place(end, p);
    return true;
  }
  int other = f.vertex[1];
  if (f.count > 1) {
    if (number > 0) return false;
  } else if (kind == BOX) {
    if (number > 2) return false;
    other = first ^ 1 << number;
  } else {
    const int face = hull_faces_of[hull_vertex[first].faces + number];
    if (face < 0) return false;
    const int *corner = hull_corner + hull_face[face].corners, count = hull_face[face].count;
    int n = 0;
    while (corner[n] != first) n++;
    other = corner[n ? n - 1 : count - 1];
  }
  place_vertex(M, solid, first, start);
  place_vertex(M, solid, other, end);
  return true;
}
// The corners of a face, in their order; returns how many.
DEV int face_polygon(const Model& M, const Solid& solid, int face, real (*polygon)[3]) {
  static const unsigned char box[6][4] = {{7, 3, 1, 5}, {2, 6, 4, 0}, {2, 3, 7, 6},
                                          {4, 5, 1, 0}, {6, 7, 5, 4}, {3, 2, 0, 1}};
  const int kind = M.geom_kind[solid.geom];
  const int sides = kind == CYLINDER ? ROUND_SIDES : kind == BOX ? 4 : hull_face[face].count;
  LOOP for (int n = 0; n < sides; n++) {
    if (is_convex(CYLINDER) && kind == CYLINDER) {
      const real radius = M.geom_radius[solid.geom], half = M.geom_half[solid.geom];
      real sine, cosine;
      sine_cosine(n * real(.39269908169872414), sine, cosine);
      const real p[3] = {radius * cosine, radius * (face ? sine : -sine), face ? -half : half};
      solid.pose.place(polygon[n], p);
    } else {
      const int last = sides - 1 - n;
      const int vertex = kind == BOX ? box[face][n] : hull_corner[hull_face[face].corners + last];
      place_vertex(M, solid, vertex, polygon[n]);
    }
  }
  return sides;
}

// Cuts off what of a polygon is beyond a side of a face, whose plane is up; returns the number of
// corners.
DEV int cut_off(const real (*from)[3], real (*to)[3], int corners, const real* start,
                const real* end, const real* up) {
  real side[3], out[3];
  for (int k = 0; k < 3; k++) side[k] = end[k] - start[k];
  cross(out, side, up);
  const real scale = inverse_root(dot(out, out)), most = dot(out, start);
  int left = 0;
  LOOP for (int n = 0; n < corners && left < 2 * CONVEX_SIDES - 1; n++) {
    const real *p = from[n], *q = from[n + 1 == corners ? 0 : n + 1];
    real to_p[3], to_q[3], along[3];
    for (int k = 0; k < 3; k++) {
      to_p[k] = p[k] - start[k];
      to_q[k] = q[k] - start[k];
      along[k] = q[k] - p[k];
    }
    const bool keeps_p = scale * dot(to_p, out) > -LEAST, keeps_q = scale * dot(to_q, out) > -LEAST;
    if (keeps_p != keeps_q) {
      const real share = (most - dot(out, p)) / dot(out, along);
      for (int k = 0; k < 3; k++) to[left][k] = p[k] + clip(share, 0, 1) * along[k];
      left++;
    }
    if (keeps_q) {
      for (int k = 0; k < 3; k++) to[left][k] = q[k];
      left++;
    }
  }
  return left;
}

// Moves the corners n[4] of a polygon to where their area is largest (polygonQuad).
DEV void widen(const real (*polygon)[3], int corners, int* n) {
  const auto next = [&](int corner) { return corner + 1 == corners ? 0 : corner + 1; };
  const auto area = [&](const int* c) {
    real along[3], across[3], normal[3];
    for (int k = 0; k < 3; k++) {
      along[k] = polygon[c[0]][k] - polygon[c[2]][k];
      across[k] = polygon[c[1]][k] - polygon[c[3]][k];
    }
    cross(normal, along, across);
    return root(dot(normal, normal));
  };
  int at[4] = {0, 1, 2, 3};
  for (int k = 0; k < 4; k++) n[k] = at[k];
  real most = area(at);
  const auto steps = [&](int i) {
    const int before = at[i];
    at[i] = next(before);
    const real x = area(at);
    if (!(x > most * (1 + SAME_AREA))) {  // also where it is no number
      at[i] = before;
      return false;
    }
    most = x;
    for (int k = 0; k < 4; k++) n[k] = at[k];
    return true;
  };
  LOOP for (; at[0] < corners; at[0]++) {
    while (steps(3)) {
      while (steps(2)) {}
      while (steps(1)) {}
    }
    for (int k = 1; k < 4 && at[k] == at[k - 1]; k++) at[k] = next(at[k]);
  }
}

// Finds the contacts of two solids beside the one that is known, and writes all of them; returns
// how many. corner: of the deepest triangle.
DEV int touch_more(const Model& M, const TwoSolids& two, const Corner* const* corner,
                   Touch* touch) {
  const Touch c = touch[0];
  Feature feature[2];
  int faces[2][CONVEX_DEGREE], counts[2], face[2] = {-1, -1}, edge = -1;
  for (int side = 0; side < 2; side++) {
    feature[side] = feature_of(corner, side);
    const Solid& solid = two.side[side];
    const real sign = side ? real(-1) : real(1);
    const bool is_round = M.geom_kind[solid.geom] == ROUND;
    for (int k = 0; k < 3 && is_round; k++)
      feature[side].at[k] = c.at[k] - sign * c.distance / 2 * c.normal[k];
    counts[side] = list_faces(M, solid, feature[side], sign, c.normal, faces[side]);
  }
  real least = -FACE_COSINE, start[3], end[3];
  LOOP for (int i = 0; i < counts[0]; i++) {
    real first[3], second[3];
    face_normal(M, two.side[0], faces[0][i], first);
    if (dot(first, c.normal) <= EDGE_SINE) continue;
    LOOP for (int j = 0; j < counts[1]; j++) {
      face_normal(M, two.side[1], faces[1][j], second);
      const real both = dot(first, second);
      if (dot(second, c.normal) >= -EDGE_SINE || both >= least) continue;
      least = both;
      face[0] = faces[0][i];
      face[1] = faces[1][j];
    }
  }
  if (face[0] < 0) {  // an edge along a face
    const bool is_first = feature[0].count < 3 && counts[1] &&
                          (feature[0].count <= feature[1].count || !counts[0]);
    bool is_along = false;
    LOOP for (edge = is_first ? 0 : 1; edge < 2; edge++) {
      const int other = 1 - edge;
      if (feature[edge].count == 3) continue;
      for (int i = 0; i < counts[other] && !is_along; i++) {
        real normal[3];
        face_normal(M, two.side[other], faces[other][i], normal);
        if ((other ? 1 : -1) * c.distance * dot(normal, c.normal) <= LEAST) continue;
        for (int j = 0; !is_along && find_edge(M, two.side[edge], feature[edge], j, start, end);
             j++) {
          real d[3];
          for (int k = 0; k < 3; k++) d[k] = end[k] - start[k];
          is_along = fabs(dot(d, normal)) < EDGE_SINE * root(dot(d, d));
          face[other] = faces[other][i];
        }
      }
      if (is_along) break;
    }
    if (!is_along) return 1;
  }

  const int base = edge == 0 ? 1 : 0;
  real normal[3], along[3], sides[CONVEX_SIDES][3], polygon[2][2 * CONVEX_SIDES][3];
  face_normal(M, two.side[base], face[base], normal);
  const int num_sides = face_polygon(M, two.side[base], face[base], sides);
  int left = 2;
  if (edge < 0) {
    face_normal(M, two.side[1], face[1], along);
    left = face_polygon(M, two.side[1], face[1], polygon[0]);
  }
  for (int k = 0; k < 3 && edge >= 0; k++) {
    along[k] = -normal[k];
    polygon[0][0][k] = start[k];
    polygon[0][1][k] = end[k];
  }
  LOOP for (int n = 0; n < num_sides; n++)
    left = cut_off(polygon[n & 1], polygon[~n & 1], left, sides[n],
                   sides[n + 1 == num_sides ? 0 : n + 1], normal);
  real(*points)[3] = polygon[num_sides & 1], around[2];
  for (int side = 0; side < 2; side++)
    around[side] = M.geom_kind[two.side[side].geom] == ROUND ? real(0) : two.side[side].swelling;
  int kept = 0;
  LOOP for (int n = 0; n < left; n++) {
    real above[3];
    for (int k = 0; k < 3; k++) above[k] = points[n][k] - sides[0][k];
    if (dot(above, normal) > around[0] + around[1]) continue;
    for (int k = 0; k < 3; k++) points[kept][k] = points[n][k];
    kept++;
  }
  if (kept == 0) return 1;
  int chosen[4] = {0, 1, 2, 3};
  if (edge >= 0 && kept > 2) {  // the two that are furthest apart
    real most = 0;
    LOOP for (int n = 0; n < kept * kept; n++) {
      const int i = n / kept, j = n % kept;
      real d[3];
      for (int k = 0; k < 3; k++) d[k] = points[j][k] - points[i][k];
      const real square = dot(d, d);
      if (j > i && square > most) most = square, chosen[0] = i, chosen[1] = j;
    }
    kept = 2;
  } else if (kept > 4) {
    widen(points, kept, chosen);
    kept = 4;
  }
  const real both = dot(normal, along);
  LOOP for (int n = 0; n < kept; n++) {
    const real* p = points[chosen[n]];
    real above[3];
    for (int k = 0; k < 3; k++) above[k] = p[k] - sides[0][k];
    const real height = dot(above, normal), distance = -height * both;
    for (int k = 0; k < 3; k++) {
      touch[n].normal[k] = edge < 0 ? -along[k] : edge == 0 ? -normal[k] : normal[k];
      touch[n].at[k] = p[k] - height * normal[k] - distance / 2 * along[k] +
                       (around[0] - around[1]) / 2 * touch[n].normal[k];
    }
    touch[n].distance = distance - around[0] - around[1];
  }
  return kept;
}

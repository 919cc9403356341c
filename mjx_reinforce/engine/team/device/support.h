// Convex geoms, as what their surfaces have farthest in a direction.
#pragma once

// What lengths below this are, is rounding (MuJoCo's mjMINVAL, m).
constexpr real LEAST = real(1e-15);

// A geom of a pair, seen from the center of the pair's first geom. Its surface is `swelling` away
// from the shape: half the margin, and the radius of a sphere or a capsule, which are a point or a
// line.
struct Solid {
  Pose pose;
  real swelling;
  int geom, vertex;  // vertex: the last one of a mesh, or -1
};
struct TwoSolids {
  Solid side[2];
  bool have_corners;  // both surfaces are flat faces
};
// A point of the first solid less one of the second, and the former; the numbers of the vertices.
struct Corner { real at[3], on[3]; int vertex[2]; };

// Whether geoms of a kind meet others as convex ones do.
DEV constexpr bool is_convex(int kind) { return CONVEX_KINDS >> kind & 1; }

// What is farthest in a direction of length 1, of a geom whose frame sees it as d (mjc_boxSupport,
// mjc_cylinderSupport and others). Returns its number: of a box's corner, by its signs, of a
// cylinder's end, or of a mesh's vertex.
DEV int farthest(const Model& M, Solid& solid, const real* d, real* p) {
  const int kind = M.geom_kind[solid.geom];
  const real* size = M.geom_size + 3 * solid.geom;
  const real end = d[2] >= 0 ? M.geom_half[solid.geom] : -M.geom_half[solid.geom];
  int corner = kind == CYLINDER && d[2] < 0;
  if (is_convex(BOX) && kind == BOX) {
    for (int k = 0; k < 3; k++) {
      p[k] = d[k] >= 0 ? size[k] : -size[k];
      corner |= int(d[k] >= 0) << k;
    }
  } else if (is_convex(ELLIPSOID) && kind == ELLIPSOID) {
    for (int k = 0; k < 3; k++) p[k] = d[k] * size[k];
    const real scale = inverse_root(dot(p, p));
    for (int k = 0; k < 3; k++) p[k] *= scale * size[k];
  } else if (is_convex(MESH) && kind == MESH) {
    corner = solid.vertex = farthest_vertex(hulls[M.geom_hull[solid.geom]], d, solid.vertex);
    for (int k = 0; k < 3; k++) p[k] = hull_vertex[corner].at[k];
  } else {
    const real square = d[0] * d[0] + d[1] * d[1];
    const bool is_round = kind == ROUND || square < LEAST * LEAST;
    const real scale = is_round ? real(0) : M.geom_radius[solid.geom] * inverse_root(square);
    p[0] = scale * d[0];
    p[1] = scale * d[1];
    p[2] = end;
  }
  return corner;
}

// The corner of the difference of two solids in a direction of length 1.
CALL void find_corner(const Model& M, TwoSolids& two, const real* direction, Corner& c) {
  LOOP for (int side = 0; side < 2; side++) {
    Solid& solid = two.side[side];
    const real sign = side ? real(-1) : real(1);
    real away[3], d[3], p[3], at[3];
    for (int k = 0; k < 3; k++) away[k] = sign * direction[k];
    solid.pose.turn_back(d, away);
    c.vertex[side] = farthest(M, solid, d, p);
    solid.pose.place(at, p);
    for (int k = 0; k < 3; k++) {
      at[k] += solid.swelling * away[k];
      c.at[k] = side ? c.on[k] - at[k] : at[k];
      if (side == 0) c.on[k] = at[k];
    }
  }
}

// Contacts of two convex geoms (mjc_Convex of MuJoCo 4.0).
#pragma once

// Of one item. A box and a box have at most 8, which C finds in as many parts.
constexpr int MOST_TOUCHES = WHOLE_PAIRS ? 8 : CONVEX_CONTACTS > 1 ? CONVEX_CONTACTS : 1;

// Whether two geoms meet as convex ones; of others, C has closed forms.
DEV bool meet_as_convex(const Model& M, Item item) {
  const int a = item.first(), below = M.geom_kind[a], above = M.geom_kind[item.second()];
  if (!is_convex(below) || !is_convex(above)) return false;
  if (below == ROUND)
    return above == ELLIPSOID || above == MESH || (above == CYLINDER && M.geom_half[a] > 0);
  return below != BOX || above == MESH;
}

// How two solids touch (mjc_ccd); returns the number of contacts.
DEV int touch_solids(const Model& M, TwoSolids& two, Touch* touch) {
  Touch& c = touch[0];
  const bool has_more = MORE_CONTACTS && may_have_more(M, two);
  bool are_flat = true;
  for (int side = 0; side < 2; side++) are_flat &= M.geom_kind[two.side[side].geom] >= BOX;
  const real around[2] = {two.side[0].swelling, two.side[1].swelling};
  const real reach = around[0] + around[1];
  Simplex s;
  // First the shapes alone: where they do not overlap, this is all.
  LOOP for (bool is_swollen = reach == 0;; is_swollen = true) {
    for (int side = 0; side < 2; side++)
      two.side[side].swelling = is_swollen ? around[side] : real(0);
    two.have_corners = are_flat && (!is_swollen || reach == 0);
    const real distance = approach(M, two, is_swollen ? real(0) : reach, s);
    if (distance > CONVEX_TOLERANCE) {
      if (is_swollen || distance >= reach) return 0;
      for (int k = 0; k < 3; k++) {
        c.normal[k] = -s.gap[k] / distance;
        c.at[k] = s.on_first[k] - s.gap[k] / 2 + (around[0] - around[1]) / 2 * c.normal[k];
      }
      c.distance = distance - reach;
      for (int side = 0; side < 2; side++) two.side[side].swelling = around[side];
      const Corner *first = s.corner, *second = first + (s.size > 1);
      const Corner* corner[3] = {first, second, s.size > 2 ? first + 2 : first};
      return has_more ? touch_more(M, two, corner, touch) : 1;
    }
    if (is_swollen) break;
  }
  Polytope p;
  Face face;
  if (s.size < 2 || s.is_apart || !make_polytope(M, two, s, p) || !grow(M, two, p, face))
    return 0;
  const Corner &u = p.corner[face.corner[0]], &v = p.corner[face.corner[1]];
  const Corner& w = p.corner[face.corner[2]];
  real normal[3], part[3];
  const real whole = areas(u.at, v.at, w.at, normal, part), depth = root(face.square);
  for (int k = 0; k < 3; k++) {
    const real on_first = (part[0] * u.on[k] + part[1] * v.on[k] + part[2] * w.on[k]) / whole;
    c.normal[k] = face.nearest[k] / depth;
    c.at[k] = on_first - face.nearest[k] / 2;
  }
  c.distance = -depth;
  const Corner* corner[3] = {&u, &v, &w};
  return has_more ? touch_more(M, two, corner, touch) : 1;
}

// The contacts of an item's geoms; returns how many.
CALL int touch_convex(const Model& M, const State& s, int item, real margin, Touch* touch) {
  const int geoms[2] = {M.item[item].first(), M.item[item].second()};
  const real reach = margin + M.kind_gap[M.item_kind[item]];
  const Quad center = s.geom_place[geoms[0]];
  TwoSolids two;
  for (int side = 0; side < 2; side++) {
    Solid& solid = two.side[side];
    const int geom = geoms[side];
    solid.pose = geom_pose(M, s, geom);
    for (int k = 0; k < 3; k++) solid.pose.row[k].x[3] -= center.x[k];
    solid.swelling = reach / 2 + (M.geom_kind[geom] == ROUND ? M.geom_radius[geom] : real(0));
    solid.geom = geom;
    solid.vertex = -1;
  }
  const int contacts = touch_solids(M, two, touch);
  int kept = 0;
  LOOP for (int n = 0; n < contacts; n++) {
    Touch c = touch[n];
    c.distance += reach;
    for (int k = 0; k < 3; k++) {
      c.at[k] += center.x[k];
      c.tangent[k] = 0;
    }
    if (c.distance < margin) touch[kept++] = c;
  }
  return kept;
}

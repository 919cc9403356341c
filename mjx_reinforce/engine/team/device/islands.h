// Islands of a search that stops early: kinematic trees that rows join, which C solves one after
// the other (MuJoCo's mj_island). Masks are of degrees of freedom.
#pragma once

// Whether a model's trees are solved apart; NTREES is 1 of one that has one island.
constexpr bool ISLANDS = NTREES > 1;
constexpr Mask EVERYTHING = ~Mask(0);

// Whether a lane's rows join trees of the first mask with those of the second.
DEV bool joins(const Team& t, const Model& M, State& s, const Search& search, Mask first,
               Mask second) {
  const int lane = t.lane;
  bool some = false;
  each_contact(t, s, [&](Contact& c) {
    const Item item = M.item[c.item];
    const Mask trees = M.link_tree[M.geom_link[item.first()]] |
                       M.link_tree[M.geom_link[item.second()]];
    some |= (trees & first) && (trees & second);
  });
  EACH(e, NE) {
    Mask moved = 0;
    for (int i = 0; i < NV; i++) moved |= Mask(s.general[e][i / 4].x[i % 4] != 0) << i;
    some |= s.general_constraint_mass[e] > 0 && (moved & first) && (moved & second);
  }
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    some |= search.bounds[r].some() && (first & second) >> (t.lane + r * W) & 1;
  return some;
}

// The trees without rows.
DEV Mask loose_trees(const Team& t, const Model& M, State& s, const Search& search) {
  Mask loose = 0;
  for (int k = 0; k < NTREES; k++) {
    const Mask tree = M.tree_dofs[k];
    if (!t.any(joins(t, M, s, search, tree, tree))) loose |= tree;
  }
  return loose;
}
// Of the trees that are left, the island of the first one.
DEV Mask next_island(const Team& t, const Model& M, State& s, const Search& search, Mask left) {
  Mask island = 0;
  for (int k = 0; k < NTREES && !island; k++) island = M.tree_dofs[k] & left;
  bool grows = true;
  while (grows) {
    grows = false;
    for (int k = 0; k < NTREES; k++) {
      const Mask tree = M.tree_dofs[k];
      if ((tree & island) || !t.any(joins(t, M, s, search, tree, island))) continue;
      island |= tree;
      grows = true;
    }
  }
  return island;
}

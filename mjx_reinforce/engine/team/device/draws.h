// Friction and inverse masses of contacts, which an episode may draw: then they are mixed when a
// contact is made, else a table has them.
#pragma once

// Which geom's friction a contact has: that of higher priority; or the friction of its pair.
enum Mix { LARGER, OF_FIRST, OF_SECOND, OF_PAIR };

DEV const Friction& friction_of(const Model& M, const Contact& c, int kind) {
  return DRAWS_FRICTION ? c[0] : M.kind_friction[kind];
}
// The regularized friction of an elliptic cone.
DEV real mu_of(const Model& M, const Contact& c, int kind) {
  return DRAWS_FRICTION ? CONE_SCALE * c[0].along[0] : M.kind_mu[kind];
}
// Gives a contact friction of its own (mj_contactParam).
DEV void mix_friction(const Model& M, Contact& c) {
  if (!DRAWS_FRICTION) return;
  const int kind = M.item_kind[c.item], mix = M.kind_mix[kind];
  const real* first = M.geom_friction + 3 * M.item[c.item].first();
  const real* second = M.geom_friction + 3 * M.item[c.item].second();
  for (int k = 0; k < 5; k++) {
    const real x = first[(k > 1) + (k > 2)], y = second[(k > 1) + (k > 2)];
    const real mixed = mix == OF_FIRST || (mix == LARGER && x > y) ? x : y;
    c[0].along[k] = mix == OF_PAIR ? M.kind_friction[kind].along[k]
                                   : mixed > real(1e-5) ? mixed : real(1e-5);
  }
}
// The inverse mass of a contact's first row (mj_diagApprox): of a pyramid an edge, which pushes
// along a tangent, too.
DEV real weight_of(const Model& M, const Contact& c) {
  if (!DRAWS_WEIGHTS) return M.item_weight[c.item];
  const Item item = M.item[c.item];
  const real weight =
      M.body_weight[M.geom_body[item.first()]] + M.body_weight[M.geom_body[item.second()]];
  const int kind = M.item_kind[c.item];
  if (ELLIPTIC || M.kind_dim[kind] == 1) return weight;
  const real mu = friction_of(M, c, kind).along[0], square = mu * mu;
  return 2 * CONE_SCALE * CONE_SCALE * square * (1 + square) * weight;
}

// Rows of contacts, in the basis of normal and tangents; of pyramids, whose rows are edges, also
// their costs. Those of elliptic cones are in cones.h.
#pragma once

// How the second body of a contact moves at the contact, as the first one sees it, in the contact's
// frame (mj_jacDifPair times a velocity). of: spatial velocities of links.
DEV void relative(const Model& M, const real (*of)[6], const Contact& c, real* out) {
  const Item item = M.item[c.item];
  const real *first = of[M.geom_link[item.first()]], *second = of[M.geom_link[item.second()]];
  real v[6], point[3];
  for (int k = 0; k < 6; k++) v[k] = second[k] - first[k];
  cross(point, v, c.at);
  for (int k = 0; k < 3; k++) point[k] += v[3 + k];
  for (int k = 0; k < CD; k++) out[k] = dot(c.frame + 3 * (k % 3), k < 3 ? point : v);
}
// The entries of the basis of a contact that degree of freedom i has.
DEV void basis(const Model& M, const State& s, const Contact& c, int i, real* out) {
  const Item item = M.item[c.item];
  const Mask first = M.link_dofs[M.geom_link[item.first()]];
  const Mask second = M.link_dofs[M.geom_link[item.second()]];
  const real sign = real(int(second >> i & 1) - int(first >> i & 1));
  const Quad a = s.cdof[i][0], b = s.cdof[i][1];
  real point[3];
  cross(point, a.x, c.at);
  point[0] = sign * (point[0] + a.x[3]);
  point[1] = sign * (point[1] + b.x[0]);
  point[2] = sign * (point[2] + b.x[1]);
  for (int k = 0; k < CD; k++)
    out[k] = k < 3 ? dot(c.frame + 3 * k, point) : sign * dot(c.frame + 3 * (k - 3), a.x);
}
// What a contact's stiffness makes of x [CD].
DEV void stiffness_times(const Contact& c, const real* x, real* out) {
  real along = x[0];
  out[0] = c.stiffness[0] * x[0];
  for (int k = 1; k < CD; k++) {
    out[0] += c.stiffness[k] * x[k];
    if (ELLIPTIC) along += c.stiffness[COUPLING] * c.stiffness[k] * x[k];
  }
  for (int k = 1; k < CD; k++) out[k] = c.stiffness[k] * along + c.stiffness[CD - 1 + k] * x[k];
}

// Calls do_edge(friction, k, sign) for the edges of a contact's pyramid; k is 0 for its only row.
template <class F> DEV void each_edge(const Model& M, const Contact& c, F do_edge) {
  const int kind = M.item_kind[c.item], dim = M.kind_dim[kind];
  if (dim == 1) do_edge(real(0), 0, real(1));
  UNROLL for (int k = 1; k < CD; k++) {
    if (k < dim) {
      const real friction = friction_of(M, c, kind).along[k - 1];
      do_edge(friction, k, real(1));
      do_edge(-friction, k, real(-1));
    }
  }
}
// Finds the forces and the stiffness of the rows that push (mj_constraintUpdate).
DEV void push(const Model& M, Contact& c) {
  for (int k = 0; k < CD; k++) c.force[k] = 0;
  for (int k = 0; k <= COUPLING; k++) c.stiffness[k] = 0;
  if (ELLIPTIC && M.kind_dim[M.item_kind[c.item]] > 1) return push_cone(M, c);
  each_edge(M, c, [&](real friction, int k, real) {
    const real residual = c.residual[0] + friction * c.residual[k];
    const real active_mass = residual < 0 ? c.constraint_mass : real(0);
    const real force = -active_mass * residual;
    c.force[0] += force;
    c.stiffness[0] += active_mass;
    if (k > 0) {
      c.force[k] += friction * force;
      c.stiffness[k] += friction * active_mass;
      c.stiffness[CD - 1 + k] += friction * friction * active_mass;
    }
  });
}

// What a contact's rows add to the derivative of the cost at a length along the step (PrimalEval).
DEV void bend(const Model& M, const Contact& c, real length, Bend& sum) {
  if (ELLIPTIC && M.kind_dim[M.item_kind[c.item]] > 1) return bend_cone(M, c, length, sum);
  each_edge(M, c, [&](real friction, int k, real) {
    const real residual = c.residual[0] + (k ? friction * c.residual[k] : real(0));
    const real change = c.change[0] + (k ? friction * c.change[k] : real(0));
    sum.add(c.constraint_mass, residual, change, length);
  });
}

// A contact by its number: the first are in the state, others in memory.
DEV Contact& contact_at(State& s, int number) {
  return !FAR || number < NEAR ? s.contacts[number] : s.far[number - NEAR];
}
// Each contact once, by the lane whose it is.
template <class F> DEV void each_contact(const Team& t, State& s, F act) {
  const int lane = t.lane, num_contacts = s.num_contacts;
  EACH(number, num_contacts) act(contact_at(s, number));
}
// All contacts, by all lanes together.
template <class F> DEV void all_contacts(const Team& t, State& s, F act) {
  const int num_contacts = s.num_contacts;
  LOOP for (int c = 0; c < num_contacts; c++) {
    const Contact* contact = s.contacts + c;
    if (FAR && c >= NEAR) {
      // Copied by all lanes, a word each: memory is far, and all of them read all of the contact.
      t.sync();
      char* to = reinterpret_cast<char*>(&s.guest);
      const char* from = reinterpret_cast<const char*>(s.far + (c - NEAR));
      for (int k = 4 * t.lane; k < int(sizeof(Contact)); k += 4 * W)
        memcpy(to + k, __builtin_assume_aligned(from + k, 4), 4);
      t.sync();
      contact = &s.guest;
    }
    act(*contact);
  }
}

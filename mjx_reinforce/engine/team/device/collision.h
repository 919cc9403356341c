// From geoms to contacts (MuJoCo's mj_collision): pairs that are near are queued, and each W of
// them are looked at closely.
#pragma once

// The contact of a part of an item, if its distance is below the margin.
DEV Touch touch_of(const Model& M, const State& s, int item, int part, real margin) {
  const int a = M.item[item].first(), b = M.item[item].second();
  Touch c;
  for (int k = 0; k < 3; k++) c.tangent[k] = 0;
  const int below = M.geom_kind[a], above = M.geom_kind[b];
  const auto are = [&](int flat, int other) {
    return may_meet(flat, other) && below == flat && above == other;
  };
  if (are(PLANE, BOX)) {
    touch_box_on_plane(M, s, a, b, part, margin, c);
  } else if (are(ROUND, BOX)) {
    touch_round_and_box(M, s, a, b, part, c);
  } else if (are(BOX, BOX)) {
    touch_boxes(M, s, a, b, part, margin, c);
  } else if (are(PLANE, CYLINDER)) {
    touch_cylinder_on_plane(M, s, a, b, part, c);
  } else if (are(ROUND, CYLINDER)) {
    touch_sphere_and_cylinder(M, s, a, b, c);
  } else if (are(PLANE, ELLIPSOID)) {
    touch_ellipsoid_on_plane(M, s, a, b, c);
  } else if (are(PLANE, MESH)) {
    touch_hull_on_plane(M, s, a, b, part, margin, c);
  } else if (below == PLANE) {
    const Quad q = s.geom_place[b], axis = s.geom_axis[b];
    const real half = M.geom_half[b], along = part ? -half : half;
    real end[3];
    for (int k = 0; k < 3; k++) {
      end[k] = q.x[k] + along * axis.x[k];
      c.tangent[k] = half > 0 ? axis.x[k] : real(0);
    }
    touch_plane(c, s.geom_place[a], s.geom_axis[a], end, M.geom_radius[b]);
  } else {
    touch_rounds(M, s, a, b, c);
  }
  return c;
}

// A contact, what its rows want included (mj_instantiateContact, mj_referenceConstraint).
DEV Contact contact_of(const Model& M, const State& s, int item, const Touch& touch) {
  Contact c;
  make_frame(c.frame, touch);
  for (int k = 0; k < 3; k++) c.at[k] = touch.at[k] - s.pose[0].origin(k);
  const int kind = M.item_kind[item];
  const real distance = touch.distance - M.kind_margin[kind];
  const Softness& soft = M.soft[M.kind_soft[kind]];
  const real strength = impedance(soft, distance);
  c.item = item;
  mix_friction(M, c);
  c.constraint_mass = constraint_mass(strength, weight_of(M, c));
  // A pair may name a softness of the rows of friction of a cone.
  const real friction_damping =
      ELLIPTIC ? M.soft[M.kind_soft_friction[kind]].damping : soft.damping;
  real speed[CD];
  relative(M, s.velocity, c, speed);
  relative(M, s.motion, c, c.residual);
  for (int k = 0; k < CD; k++)
    c.residual[k] += (k > 0 ? friction_damping : soft.damping) * speed[k];
  c.residual[0] += soft.stiffness * strength * distance;
  return c;
}

DEV void collide(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  int waiting = 0, num_contacts = 0;
  LOOP for (int first = 0; first < NI; first += W) {
    const int item = first + lane;
    bool near = false;
    if (item < NI) {
      const int a = M.item[item].first(), b = M.item[item].second();
      const Quad p = s.geom_place[a], q = s.geom_place[b];
      const real d[3] = {q.x[0] - p.x[0], q.x[1] - p.x[1], q.x[2] - p.x[2]};
      const real reach = p.x[3] + q.x[3] + M.kind_margin[M.item_kind[item]];
      near = M.geom_kind[a] == PLANE ? dot(d, s.geom_axis[a].x) < reach : dot(d, d) < reach * reach;
    }
    const unsigned near_lanes = t.ballot(near);
    // A near item's place in the queue is how many lanes before this one have one.
    if (near) s.queue[waiting + count(near_lanes & ((1u << lane) - 1))] = item;
    waiting += count(near_lanes);
    const bool last = first + W >= NI;
    // Items near by their bounding spheres are few. Only a queue that is full is looked at closely,
    // so that all lanes have one; what is left over, after the last items.
    LOOP while (waiting >= W || (last && waiting > 0)) {
      t.sync();
      const bool has_item = lane < waiting;
      const int queued_item = s.queue[lane];
      bool touches = false;
      int contacts = 1;
      Touch touch[MOST_TOUCHES];
      if (has_item) {
        const real margin = M.kind_margin[M.item_kind[queued_item]];
        if (CONVEX_CONTACTS && meet_as_convex(M, M.item[queued_item])) {
          contacts = touch_convex(M, s, queued_item, margin, touch);
          touches = contacts > 0;
        } else if (WHOLE_PAIRS) {
          contacts = 0;
          const int last_part = M.item[queued_item].part();
          LOOP for (int part = 0; part <= last_part && contacts < MOST_TOUCHES; part++) {
            touch[contacts] = touch_of(M, s, queued_item, part, margin);
            contacts += touch[contacts].distance < margin;
          }
          touches = contacts > 0;
        } else {
          touch[0] = touch_of(M, s, queued_item, M.item[queued_item].part(), margin);
          touches = touch[0].distance < margin;
        }
      }
      // In the order of the items, whatever the number of lanes: no_slip goes through them in it.
      unsigned touching_lanes[MOST_TOUCHES];
      UNROLL for (int n = 0; n < MOST_TOUCHES; n++)
        touching_lanes[n] = t.ballot(n > 0 ? touches && n < contacts : touches);
      LOOP for (int n = 0; n < MOST_TOUCHES; n++) {
        if (n > 0) touches &= n < contacts;
        if (touches) {
          int at = num_contacts + n;
          UNROLL for (int k = 0; k < MOST_TOUCHES; k++)
            at += count(touching_lanes[k] & ((1u << lane) - 1));
          const Contact contact = contact_of(M, s, queued_item, touch[n]);
          // Not by contact_at: stores through a reference to either would be to no known memory.
          if (!FAR || at < NEAR) s.contacts[at] = contact; else s.far[at - NEAR] = contact;
        }
      }
      UNROLL for (int n = 0; n < MOST_TOUCHES; n++) num_contacts += count(touching_lanes[n]);
      const int next = s.queue[W + lane];
      t.sync();
      waiting -= W;
      if (lane < waiting) s.queue[lane] = next;
    }
    if (waiting < 0) waiting = 0;
  }
  if (lane == 0) s.num_contacts = num_contacts;
  t.sync();
}

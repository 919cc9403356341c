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

// Whether the boxes around two geoms meet: no normal of a face of either shows a gap (MuJoCo's
// mj_collideOBB). Planes meet all boxes.
DEV bool boxes_meet(const Model& M, const State& s, int item) {
  const int geom[2] = {M.item[item].first(), M.item[item].second()};
  if (M.geom_kind[geom[0]] == PLANE) return true;
  const Pose pose[2] = {geom_pose(M, s, geom[0]), geom_pose(M, s, geom[1])};
  const GeomBox box[2] = {M.geom_box[geom[0]], M.geom_box[geom[1]]};
  real at[2][3], away[3], turn[3][3];
  for (int side = 0; side < 2; side++) pose[side].place(at[side], box[side].center);
  for (int k = 0; k < 3; k++) away[k] = at[1][k] - at[0][k];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      turn[i][j] = 0;
      for (int k = 0; k < 3; k++) turn[i][j] += pose[0].row[k].x[i] * pose[1].row[k].x[j];
    }
  const real rounding = GAP_ROUNDING * (M.geom_reach[geom[0]] + M.geom_reach[geom[1]]);
  const real most = M.kind_margin[M.item_kind[item]] + rounding;
  bool meet = true;
  UNROLL for (int side = 0; side < 2; side++) {
    real along[3];
    pose[side].turn_back(along, away);
    for (int i = 0; i < 3; i++) {
      real gap = fabs(along[i]) - box[side].half[i];
      for (int j = 0; j < 3; j++)
        gap -= fabs(side ? turn[j][i] : turn[i][j]) * box[1 - side].half[j];
      meet &= !(gap > most);
    }
  }
  return meet;
}

// Items in their order, of which W are taken at once: there is room for twice as many.
struct Queue { int* items, waiting; };
// Adds the items of lanes with a flag.
DEV void add_to(Queue& queue, const Team& t, bool flag, int item) {
  const unsigned lanes = t.ballot(flag);
  // An item's place is how many lanes before its own have one.
  if (flag) queue.items[queue.waiting + count(lanes & ((1u << t.lane) - 1))] = item;
  queue.waiting += count(lanes);
}
// Takes away the first W.
DEV void take_from(Queue& queue, const Team& t) {
  const int next = queue.items[W + t.lane];
  t.sync();
  queue.waiting -= W;
  if (t.lane < queue.waiting) queue.items[t.lane] = next;
  if (queue.waiting < 0) queue.waiting = 0;
}

// Adds the contacts of the first W items of a queue.
DEV void touch_items(const Team& t, const Model& M, State& s, const Queue& queue,
                     int& num_contacts) {
  const int lane = t.lane;
  const bool has_item = lane < queue.waiting;
  const int queued_item = queue.items[lane];
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
}

DEV void collide(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  int num_contacts = 0;
  Queue near = {s.queue, 0};
  // Where geoms meet as convex ones, which takes long, a second queue has the items of boxes that
  // meet.
  Queue meeting = {&s.meeting[0], 0};
  LOOP for (int first = 0; first < NI; first += W) {
    const int item = first + lane;
    bool is_near = false;
    if (item < NI) {
      const int a = M.item[item].first(), b = M.item[item].second();
      const Quad p = s.geom_place[a], q = s.geom_place[b];
      const real d[3] = {q.x[0] - p.x[0], q.x[1] - p.x[1], q.x[2] - p.x[2]};
      const real reach = p.x[3] + q.x[3] + M.kind_margin[M.item_kind[item]];
      is_near =
          M.geom_kind[a] == PLANE ? dot(d, s.geom_axis[a].x) < reach : dot(d, d) < reach * reach;
    }
    add_to(near, t, is_near, item);
    const bool last = first + W >= NI;
    // Items near by their bounding spheres are few. Only a queue that is full is looked at closely,
    // so that all lanes have one; what is left over, after the last items.
    LOOP while (near.waiting >= W || (last && near.waiting + meeting.waiting > 0)) {
      t.sync();
      if (CONVEX_CONTACTS) {
        if (near.waiting > 0) {
          const int queued_item = s.queue[lane];
          add_to(meeting, t, lane < near.waiting && boxes_meet(M, s, queued_item), queued_item);
          take_from(near, t);
          t.sync();
        }
        if (meeting.waiting < W && !(last && near.waiting == 0)) continue;
      }
      Queue& queue = CONVEX_CONTACTS ? meeting : near;
      touch_items(t, M, s, queue, num_contacts);
      take_from(queue, t);
    }
  }
  if (lane == 0) s.num_contacts = num_contacts;
  t.sync();
}

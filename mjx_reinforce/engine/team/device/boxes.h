// Contacts of boxes with planes, spheres and capsules.
#pragma once

// The lower corners of a box above a plane: the part-th of those that look down and are near
// enough, as C numbers them (mjc_PlaneBox).
DEV void touch_box_on_plane(const Model& M, const State& s, int a, int b, int part, real margin,
                            Touch& c) {
  const Pose box = geom_pose(M, s, b);
  const Quad plane = s.geom_place[a], up = s.geom_axis[a];
  const real* size = M.geom_size + 3 * b;
  real center[3];
  for (int k = 0; k < 3; k++) center[k] = box.origin(k) - plane.x[k];
  const real height = dot(center, up.x);
  c.distance = real(1e9);
  LOOP for (int n = 0; n < 8; n++) {
    const real own[3] = {n & 1 ? size[0] : -size[0], n & 2 ? size[1] : -size[1],
                         n & 4 ? size[2] : -size[2]};
    real corner[3];
    box.turn(corner, own);
    const real down = dot(corner, up.x);
    if (height + down > margin || down > 0) continue;
    if (part-- == 0) {
      for (int k = 0; k < 3; k++) corner[k] += box.origin(k);
      touch_plane(c, plane, up, corner, 0);
    }
  }
}

// A sphere about a point [3] of the box's frame, and the box (mjraw_SphereBox).
DEV void touch_sphere_and_box(const Pose& box, const real* size, const real* p, real radius,
                              Touch& c) {
  real inside[3], normal[3], at[3];
  for (int k = 0; k < 3; k++) {
    inside[k] = clip(p[k], -size[k], size[k]);
    normal[k] = inside[k] - p[k];
  }
  real length = root(dot(normal, normal));
  if (length <= real(1e-15)) {  // the center is in the box: out by the nearest face
    real least = 2 * (size[0] + size[1] + size[2]);
    int face = 0;
    for (int k = 0; k < 6; k++) {
      const real away = fabs((k & 1 ? size[k / 2] : -size[k / 2]) - p[k / 2]);
      if (away < least) least = away, face = k;
    }
    for (int k = 0; k < 3; k++) {
      normal[k] = k == face / 2 ? (face & 1 ? real(-1) : real(1)) : real(0);
      at[k] = p[k] + normal[k] * (radius - least) / 2;
    }
    length = -least;
  } else {
    for (int k = 0; k < 3; k++) {
      normal[k] /= length;
      at[k] = (inside[k] + p[k] + normal[k] * radius) / 2;
    }
  }
  c.distance = length - radius;
  box.turn(c.normal, normal);
  box.place(c.at, at);
}

// How a capsule meets a box, in the box's frame: the point of its axis that is closest, and another
// one where it lies on the box, both from -1 to 1 along the axis. Which other one is C's choice
// (mjraw_CapsuleBox).
struct OnBox {
  real first, second;
  bool has_second;
};
DEV OnBox along_box(const real* size, const real* center, const real* axis, real half) {
  real best = real(1e30), first = 0, on_edge = 0, reach[3];
  int face = -1, edge = -1, side = 0, corner = 0, toward = 0;
  for (int k = 0; k < 3; k++) {
    reach[k] = half * axis[k];
    toward |= int(reach[k] > 0) << k;
  }
  LOOP for (int end = -1; end <= 1; end += 2) {  // an end above a face, or inside
    real square = 0;
    int out = 0, which = -1;
    for (int k = 0; k < 3; k++) {
      const real x = center[k] + end * reach[k], beyond = x - clip(x, -size[k], size[k]);
      if (beyond != 0) out++, which = k;
      square += beyond * beyond;
    }
    if (out <= 1 && square < best) best = square, first = real(end), face = which;
  }
  LOOP for (int n = 0; n < 12; n++) {  // an edge: of direction j, at the signs that i's bits say
    const int j = n / 4, low = n % 4 & ((1 << j) - 1), i = n % 4 >> j << (j + 1) | low;
    real offset[3], square = 0;
    for (int k = 0; k < 3; k++)
      offset[k] = (k == j ? real(0) : i >> k & 1 ? size[k] : -size[k]) - center[k];
    const real edge_square = size[j] * size[j], axis_square = half * half;
    const real both = -size[j] * reach[j], by_edge = -size[j] * offset[j];
    const real by_axis = dot(reach, offset), determinant = edge_square * axis_square - both * both;
    if (fabs(determinant) < PARALLEL) continue;
    real on_a = (axis_square * by_edge - both * by_axis) / determinant;
    real on_b = (edge_square * by_axis - both * by_edge) / determinant;
    int end = fabs(on_a) > 1 ? (on_a > 0 ? 1 : -1) : 0;
    if (end) on_a = real(end), on_b = (by_axis - both * on_a) / axis_square;
    if (fabs(on_b) > 1) {
      on_b = clip(on_b, real(-1), real(1));
      on_a = (by_edge - both * on_b) / edge_square;
      if (fabs(on_a) > 1) end = on_a > 0 ? 1 : -1, on_a = real(end);
    }
    for (int k = 0; k < 3; k++) {
      const real d = offset[k] - on_b * reach[k] + (k == j ? size[j] * on_a : real(0));
      square += d * d;
    }
    if (square < best - real(1e-15)) {
      best = square;
      first = on_b;
      on_edge = on_a;
      edge = j;
      side = end;
      corner = i | int(end > 0) << j;
    }
  }
  OnBox found = {first, 0, false};
  int differs = toward ^ corner;
  real length = 2;
  if (edge < 0) {  // from above a face as far as the axis is above it
    if (face < 0) return found;
    for (int k = 0; k < 3; k++)
      for (int side = -1; side <= 1; side += 2) {
        const real meets = -first * (side * size[k] - center[k] - first * reach[k]) / reach[k];
        if (k != face && meets > 0 && meets < length) length = meets;
      }
    return {first, first - first * length, true};
  }
  real sign = 1;
  if (side) {  // from a corner along an edge or a face
    if (differs == 0 || differs == 7) return found;
    if (count(differs) == 2) sign = -1, differs = 7 - differs;
    const int k = differs >> 1;
    if (axis[k] * axis[k] > real(.5)) {
      length = 1 - sign * first;
      const real most = 2 * size[k] / fabs(reach[k]);
      length = most < length ? most : length;
    } else {
      length = 1 + sign * first;
      for (int j = 0; j < 3; j++) {
        const real most = 2 * size[j] / fabs(reach[j]);
        if (j != k && most < length) length = most;
      }
      sign = -sign;
    }
  } else {  // from an edge across a face
    differs &= ~(1 << edge);
    if (count(differs) != 1) return found;
    const int a = (edge + 1) % 3, b = (edge + 2) % 3;
    const int across = fabs(axis[a]) > fabs(axis[b]) ? a : b;
    const bool ahead = differs >> across & 1;
    sign = ahead ? 1 : -1;
    length = 1 - sign * first;
    const real most = 2 * size[across] / fabs(reach[across]);
    length = most < length ? most : length;
    const real left = bool(toward >> edge & 1) == ahead ? 1 - on_edge : 1 + on_edge;
    const real end = size[edge] * left / fabs(reach[edge]);
    length = end < length ? end : length;
  }
  return {first, first + sign * length, true};
}

DEV void touch_round_and_box(const Model& M, const State& s, int a, int b, int part, Touch& c) {
  const Pose box = geom_pose(M, s, b);
  const Quad p = s.geom_place[a];
  const real half = M.geom_half[a], *size = M.geom_size + 3 * b;
  real away[3], own[3];
  for (int k = 0; k < 3; k++) away[k] = p.x[k] - box.origin(k);
  box.turn_back(own, away);
  if (half > 0) {
    real axis[3];
    box.turn_back(axis, s.geom_axis[a].x);
    const OnBox on = along_box(size, own, axis, half);
    c.distance = real(1e9);
    if (part && !on.has_second) return;
    for (int k = 0; k < 3; k++) own[k] += half * (part ? on.second : on.first) * axis[k];
  }
  touch_sphere_and_box(box, size, own, M.geom_radius[a], c);
}

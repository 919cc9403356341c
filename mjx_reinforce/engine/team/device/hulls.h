// Hulls of meshes, by hulls.py.
#pragma once

DEV real height(const HullVertex& v, const real* d) {
  return d[0] * real(v.at[0]) + d[1] * real(v.at[1]) + d[2] * real(v.at[2]);
}

// The vertex of a hull that is farthest in a direction of the mesh's frame, from a vertex on, or
// from -1 (mjc_meshSupport, mjc_hillclimbSupport). Where several are, it is the one that C takes.
DEV int farthest_vertex(const Hull& hull, const real* direction, int start) {
  real most = start < 0 ? real(-1e30) : height(hull_vertex[start], direction);
  int best = start;
  if (hull.searched) {
    LOOP for (int v = hull.first; v < hull.first + hull.searched; v++) {
      const real x = height(hull_vertex[v], direction);
      if (x > most) most = x, best = v;
    }
    return best;
  }
  int cell = 0;
  for (int k = 0; k < 3; k++)
    cell = 3 * cell + (direction[k] > real(.4)) - (direction[k] < real(-.4)) + 1;
  const int seed = hull.seeds[cell];
  const real x = height(hull_vertex[seed], direction);
  if (x > most) most = x, best = seed;
  int previous;
  do {
    previous = best;
    LOOP for (int n = hull_vertex[previous].neighbors; hull_neighbor[n] >= 0; n++) {
      const int v = hull_neighbor[n];
      const real x = height(hull_vertex[v], direction);
      if (x > most) most = x, best = v;
    }
  } while (best != previous);
  return best;
}

// A vertex in the world.
DEV void mesh_vertex(real* at, const Pose& mesh, int vertex) {
  const float* own = hull_vertex[vertex].at;
  const real in_mesh[3] = {own[0], own[1], own[2]};
  mesh.place(at, in_mesh);
}

// Twice the area of the quadrilateral of corners n[4] of a face.
DEV real area(const int* corner, const int* n) {
  real along[3], across[3], normal[3];
  for (int k = 0; k < 3; k++) {
    const auto at = [&](int i) { return real(hull_vertex[corner[n[i]]].at[k]); };
    along[k] = at(0) - at(2);
    across[k] = at(1) - at(3);
  }
  cross(normal, along, across);
  return root(dot(normal, normal));
}
// Moves corners n[4] of a face apart, the first one aside, for as long as each step makes their
// area larger: first the last one, after each of its steps the third and the second (MuJoCo's
// hull4f, which Warp's _hull4 tells).
DEV void spread(const HullFace& face, int* n) {
  const int* corner = hull_corner + face.corners;
  real most = area(corner, n);
  const auto steps = [&](int i) {
    const int before = n[i];
    n[i] = before + 1 < face.count ? before + 1 : 0;
    const real x = area(corner, n);
    const bool larger = x > most;
    if (larger) most = x; else n[i] = before;
    return larger;
  };
  while (steps(3)) {
    while (steps(2)) {}
    while (steps(1)) {}
  }
}

// A mesh above a plane: its lowest vertex and, as further parts, three corners of the face there
// that looks down the most (mjc_PlaneConvex).
DEV void touch_hull_on_plane(const Model& M, const State& s, int a, int b, int part, real margin,
                             Touch& c) {
  const Pose mesh = geom_pose(M, s, b);
  const Quad plane = s.geom_place[a], up = s.geom_axis[a];
  real down[3], p[3];
  mesh.turn_back(down, up.x);
  for (int k = 0; k < 3; k++) down[k] = -down[k];
  const int lowest = farthest_vertex(hulls[M.geom_hull[b]], down, -1);
  mesh_vertex(p, mesh, lowest);
  touch_plane(c, plane, up, p, 0);
  if (part == 0 || c.distance > margin) return;
  c.distance = real(1e9);
  real most = -1;
  int bottom = -1;
  LOOP for (int n = hull_vertex[lowest].faces; hull_faces_of[n] >= 0; n++) {
    const int f = hull_faces_of[n];
    const real x = dot(hull_face[f].normal, down);
    if (x > most) most = x, bottom = f;
  }
  if (bottom < 0) return;  // a vertex inside a face is not one of the hull
  const HullFace& face = hull_face[bottom];
  if (part >= face.count) return;
  int first = 0;
  while (hull_corner[face.corners + first] != lowest) first++;
  int corners[4];
  for (int k = 0; k < 4; k++) corners[k] = (first + k) % face.count;
  if (face.count > 4) spread(face, corners);
  mesh_vertex(p, mesh, hull_corner[face.corners + corners[part]]);
  real above = 0;
  for (int k = 0; k < 3; k++) above += up.x[k] * (p[k] - mesh.origin(k));
  if (above <= 0) touch_plane(c, plane, up, p, 0);
}

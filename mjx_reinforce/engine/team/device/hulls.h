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

// A mesh above a plane: its lowest vertex, and those of that vertex's neighbors that are near
// enough to the plane and far enough from where it touches, in their order (mjc_PlaneConvex).
DEV void touch_hull_on_plane(const Model& M, const State& s, int a, int b, int part, real margin,
                             Touch& c) {
  const Pose mesh = geom_pose(M, s, b);
  const Quad plane = s.geom_place[a], up = s.geom_axis[a];
  const Hull& hull = hulls[M.geom_hull[b]];
  real down[3], p[3];
  mesh.turn_back(down, up.x);
  for (int k = 0; k < 3; k++) down[k] = -down[k];
  const int lowest = farthest_vertex(hull, down, -1);
  mesh_vertex(p, mesh, lowest);
  touch_plane(c, plane, up, p, 0);
  if (part == 0 || c.distance > margin) return;
  const real lowest_at[3] = {c.at[0], c.at[1], c.at[2]};
  const real apart = real(.3) * M.geom_reach[b];
  c.distance = real(1e9);
  if (hull.searched) return;  // C has one contact of so small a mesh
  LOOP for (int n = hull_vertex[lowest].neighbors; hull_neighbor[n] >= 0; n++) {
    Touch next = c;
    mesh_vertex(p, mesh, hull_neighbor[n]);
    touch_plane(next, plane, up, p, 0);
    real d[3];
    for (int k = 0; k < 3; k++) d[k] = p[k] - lowest_at[k];
    if (next.distance < margin && dot(d, d) >= apart * apart && --part == 0) c = next;
  }
}

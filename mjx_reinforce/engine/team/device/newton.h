// The acceleration under constraints: Newton's method with an exact line search, to the optimum.
//
// It minimizes what physics/newton.py says, in its letters: qacc, direction, imbalance = M qacc -
// qfrc_smooth, residual = J qacc - reference, constraint_mass = D. The imbalance and the residuals
// are carried from step to step, so that neither M nor J is multiplied by qacc.
#pragma once

constexpr int MOST_STEPS = SINGLE ? 20 : 100, MOST_LOOKS = 40;
// A line search ends where the slope is so small a part of that at its start. Less gives the same
// optimum: the last step is always a whole one that changes no row. Of cones, whose cost is not
// quadratic, the next step finds more than a longer search.
constexpr real LINE_TOLERANCE = real(ELLIPTIC ? .6 : .1);

// A lane has the rows lane, lane + W, ... of the degrees of freedom. Its loops over them are
// written out, so that what it has of each is in registers.
struct Search {
  real qacc[ROWS_A_LANE];       // the acceleration
  real imbalance[ROWS_A_LANE];  // M qacc - qfrc_smooth
  real diagonal[ROWS_A_LANE];   // of M
  real gradient[ROWS_A_LANE];   // of the cost at qacc
  real direction[ROWS_A_LANE];  // Newton's step
  Bounds bounds[ROWS_A_LANE];

  DEV Search(const Team& t, const Model& M, const State& s) {
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      qacc[r] = imbalance[r] = diagonal[r] = 0;
      bounds[r] = Bounds();
      if (i < NV) {
        qacc[r] = s.qacc_warmstart[i];
        imbalance[r] = s.imbalance[i];
        diagonal[r] = s.rows[i][i / 4].x[i % 4];
        bounds[r].make(M, s, i);
      }
    }
  }
};

// Writes the diagonal of H and begins the gradient: all but contacts and general rows. Where
// damping is implicit and the acceleration has been found, H is M plus the damping, and no row is
// left.
DEV void begin_step(const Team& t, const Model& M, State& s, Search& search, bool damps) {
  real* flat = &s.rows[0][0].x[0];
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    real stiffness = 0;
    search.gradient[r] = search.imbalance[r];
    if (damps) {
      stiffness = i < NV ? M.timestep * s.drag[i] : real(0);
      search.gradient[r] = stiffness * search.qacc[r];
    } else {
      search.bounds[r].push(search.qacc[r], search.gradient[r], stiffness);
    }
    if (i < NV) flat[i * (STRIDE + 1)] = search.diagonal[r] + stiffness;
  }
}
// M's rows; beyond the lanes' first columns from below the diagonal, the only place of M.
DEV void load_rows(const Team& t, const State& s, Rows& h) {
  if (VECTORS) return load_rows_in_vectors(s, h);
  const real* flat = &s.rows[0][0].x[0];
  UNROLL for (int q = 0; q < SIDE; q += 4)
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      const Quad row = s.rows[i < SIDE ? i : 0][q / 4];
      for (int k = 0; k < 4; k++) {
        const int j = q + k;
        if (j < SIDE) h[r][j] = j < (r + 1) * W ? row.x[k] : flat[j * STRIDE + i];
      }
    }
}

// Whether a contact may move a degree of freedom from row r W on: for all lanes alike.
DEV bool moves_rows(const Model& M, const Contact& c, int r) {
  const Item item = M.item[c.item];
  const Mask first = M.link_dofs[M.geom_link[item.first()]];
  const Mask second = M.link_dofs[M.geom_link[item.second()]];
  return r * W < NV && (first ^ second) >> (r * W);
}
// Adds what contacts and general rows push to the rows of H, and subtracts their forces from the
// gradient.
DEV void add_rows(const Team& t, const Model& M, State& s, Rows& h, real (&gradient)[ROWS_A_LANE]) {
  // Two buffers by turns: a lane that is ahead writes the next contact's entries while others still
  // read this one's, and one sync a contact is enough.
  int turn = 0;
  all_contacts(t, s, [&](const Contact& c) {
    if (c.stiffness[0] == 0) return;
    if (VECTORS) return add_contact_in_vectors(M, s, c, h, gradient);
    Quad(*const rows)[quads(SIDE + 1)] = s.columns[turn];
    turn ^= 1;
    real entries[ROWS_A_LANE][CD];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      for (int k = 0; k < CD; k++) entries[r][k] = 0;
      if (r > 0 && !moves_rows(M, c, r)) {
        for (int k = 0; k < CD && i < SIDE; k++) rows[k][i / 4].x[i % 4] = 0;
      } else if (i < NV) {
        basis(M, s, c, i, entries[r]);
        for (int k = 0; k < CD; k++) {
          rows[k][i / 4].x[i % 4] = entries[r][k];
          gradient[r] -= entries[r][k] * c.force[k];
        }
      } else if (i < SIDE) {
        for (int k = 0; k < CD; k++) rows[k][i / 4].x[i % 4] = 0;
      }
    }
    const int dim = M.kind_dim[M.item_kind[c.item]];
    t.sync();
    // J' stiffness J, where stiffness has a first row and column and a diagonal: the edges of the
    // pyramid couple the normal with each tangent, and no tangent with another one.
    real weight[ROWS_A_LANE][CD];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) stiffness_times(c, entries[r], weight[r]);
    UNROLL for (int k = 0; k < CD; k++) {
      if (k >= dim) break;
      UNROLL for (int q = 0; q < SIDE; q += 4) {
        const Quad row = rows[k][q / 4];
        UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
          for (int j = 0; j < 4; j++)
            if (q + j < SIDE) h[r][q + j] += weight[r][k] * row.x[j];
      }
    }
  });
  LOOP for (int e = 0; e < NE; e++) {
    real constraint_mass;
    const real force = general_force(M, s, e, constraint_mass);
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      const real entry = i < SIDE ? s.general[e][i / 4].x[i % 4] : real(0);
      gradient[r] -= entry * force;
      UNROLL for (int j = 0; j < SIDE; j++)
        h[r][j] += constraint_mass * entry * s.general[e][j / 4].x[j % 4];
    }
  }
  t.sync();
}

// Minus the gradient is the row below H, for the elimination, which so solves for it on the way.
// One lane has that row, and each has a part of the gradient: it goes through memory.
DEV void load_right_side(const Team& t, State& s, const Search& search, Rows& h) {
  real* right_side = &s.direction[0].x[0];
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    if (i < SIDE) right_side[i] = i < NV ? -search.gradient[r] : real(0);
  }
  t.sync();
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    if (t.lane + r * W == SIDE)
      UNROLL for (int j = 0; j < SIDE; j++) h[r][j] = right_side[j];
  UNROLL for (int r = 0; r < ROWS_A_LANE - 1; r++) h[r][SIDE] = right_side[t.lane + r * W];
}

// Newton's step, also in s.direction.
DEV void find_direction(const Team& t, State& s, Search& search, Rows& h) {
  if (VECTORS) return solve_in_vectors(s, h, search.gradient, search.direction);
  load_right_side(t, s, search, h);
  solve(t, s, h, search.direction);
}

// How the residuals change along s.direction. Of contacts by the velocities that the direction
// gives to links, which is less work than by the entries of J.
DEV void change_along(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  along_tree_of(t, &s.cdof[0][0].x[0], s.direction, s.motion[0]);
  t.sync();
  each_contact(t, s, [&](Contact& c) { relative(M, s.motion, c, c.change); });
  EACH(e, NE) {
    real sum = 0;
    for (int q = 0; q < QUADS; q++)
      for (int k = 0; k < 4; k++)
        if (4 * q + k < SIDE) sum += s.general[e][q].x[k] * s.direction[q].x[k];
    s.general_change[e] = sum;
  }
}

// What this lane's rows add to the derivative of the cost at a length along the direction.
DEV Bend bend_at(const Team& t, const Model& M, State& s, const Search& search, real length) {
  Bend sum = {0, 0, false};
  each_contact(t, s, [&](Contact& c) { bend(M, c, length, sum); });
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    search.bounds[r].bend(search.qacc[r], search.direction[r], length, sum);
  bend_bounds(t, M, s, length, sum);
  return sum;
}

// How far to go along a step, and the slope there as a part of that at the start.
struct Line { real length, rest; };

// The way along a step whose slope at the start is `along` (MuJoCo's PrimalSearch): Newton's method
// in one dimension, or halves where that leaves the interval. With no change of rows the slope is
// zero at length 1.
DEV Line line_search(const Team& t, const Model& M, State& s, const Search& search, Bend sum,
                     real along) {
  // Length 1 was looked at before: `sum` is of there.
  real length = 1, low = 0, high = real(1e30), rest = 1;
  LOOP for (int look = 0; look < MOST_LOOKS; look++) {
    const real slope = (1 - length) * along + t.sum(sum.slope);
    rest = slope / along;
    if (fabs(slope) <= -LINE_TOLERANCE * along) break;
    const real curvature = t.sum(sum.curvature) - along;
    if (slope < 0) low = length; else high = length;
    real next = length - slope / curvature;
    // As long as no length with a positive slope is known, there is no middle: twice as far.
    if (!(next > low && next < high)) next = high < real(1e29) ? (low + high) / 2 : 2 * length;
    length = next;
    sum = bend_at(t, M, s, search, length);
  }
  return {length, rest};
}

// M times s.direction: below the diagonal of s.rows is M.
DEV void inertia_times_direction(const Team& t, const State& s, const Search& search,
                                 real (&out)[ROWS_A_LANE]) {
  if (VECTORS) return inertia_times_in_vectors(s, search.diagonal, search.direction, out);
  const real* flat = &s.rows[0][0].x[0];
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W, row = i < NV ? i : 0;
    out[r] = search.diagonal[r] * search.direction[r];
    UNROLL for (int q = 0; q < (NV + 3) / 4; q++) {
      const Quad before = s.rows[row][q], step = s.direction[q];
      for (int k = 0; k < 4; k++) {
        const int j = 4 * q + k;
        if (j >= NV) continue;
        // Only in columns of the lanes' own numbers does it depend on the lane which is below.
        const bool below = j < r * W || (j < (r + 1) * W && j < row);
        const real entry = below ? before.x[k] : flat[j * STRIDE + row];
        if (j / W != r || j != row) out[r] += entry * step.x[k];
      }
    }
    if (i >= NV) out[r] = 0;
  }
}

// Moves the acceleration and the residuals along the direction.
DEV void move_along(const Team& t, State& s, Search& search, real length) {
  const int lane = t.lane;
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) search.qacc[r] += length * search.direction[r];
  each_contact(t, s, [&](Contact& c) {
    for (int k = 0; k < CD; k++) c.residual[k] += length * c.change[k];
  });
  EACH(e, NE) s.general_residual[e] += length * s.general_change[e];
  t.sync();
}
DEV void store_acceleration(const Team& t, State& s, const Search& search) {
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    if (t.lane + r * W < NV) s.qacc_warmstart[t.lane + r * W] = search.qacc[r];
  t.sync();
}

DEV void no_slip(const Team& t, const Model& M, State& s, Search& search);

// Replaces s.qacc_warmstart by the acceleration (MuJoCo's mj_solNewton); if damping is implicit,
// s.direction becomes what that adds to it. Returns the number of steps.
DEV int newton(const Team& t, const Model& M, State& s) {
  Search search(t, M, s);
  bool settled = false;
  int steps = 0;
  LOOP for (;; steps++) {
    // Once it is settled, another round solves for what implicit damping adds: the same
    // elimination, so that the code of a solve, which is long, is there once.
    const bool damps = IMPLICIT && settled;
    Rows h;
    begin_step(t, M, s, search, damps);
    if (!damps) each_contact(t, s, [&](Contact& c) { push(M, c); });
    t.sync();
    load_rows(t, s, h);
    if (!damps) add_rows(t, M, s, h, search.gradient);
    if (damps && IMPLICIT == 2 && NCABLE) damp_cables(t, M, s, search.qacc, search.gradient, h);
    find_direction(t, s, search, h);
    if (damps) break;
    change_along(t, M, s);
    // A whole step that changes no row led to the optimum: the cost was quadratic on the way.
    real length = 1;
    const Bend sum = bend_at(t, M, s, search, length);
    settled = !t.any(sum.some) || steps >= MOST_STEPS;
    if (!settled) {  // rows change: another step follows
      t.sync();
      real along = 0;
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
        along += search.gradient[r] * search.direction[r];
      along = t.sum(along);
      const Line line = line_search(t, M, s, search, sum, along);
      length = line.length;
      settled = -along <= M.smallest_gain;  // in float32, what is left is rounding
      // After a whole step a part of the gradient is left, about that of the slope; the next step
      // would gain its square. A tenth of that is for what the slope does not show.
      if (ELLIPTIC && SINGLE && length == 1)
        settled |= -along * line.rest * line.rest <= M.smallest_gain / 10;
      real inertia[ROWS_A_LANE];
      inertia_times_direction(t, s, search, inertia);
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++) search.imbalance[r] += length * inertia[r];
    }
    move_along(t, s, search, length);
    if (settled && NOSLIP) no_slip(t, M, s, search);
    if (settled && !IMPLICIT) break;
  }
  store_acceleration(t, s, search);
  return steps + 1;
}

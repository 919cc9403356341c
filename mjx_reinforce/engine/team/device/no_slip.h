// Friction anew after the search, as if its rows were hard (MuJoCo's mj_solNoSlip): sweeps over
// friction loss and contacts in C's order, each of which moves its forces of friction to where they
// hold best while all others stay. Normal forces, limits and equalities stay what they are.
#pragma once

// s.direction is by how much the acceleration has moved; a lane has its rows of s.inverse.
DEV real moved_along(const Team& t, const State& s, const real* entries) {
  real sum = 0;
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    if (i < NV) sum += entries[r] * s.direction[i / 4].x[i % 4];
  }
  return t.sum(sum);
}

// The inverse of M, by Gauss and Jordan.
DEV void invert_inertia(const Team& t, State& s, const Search& search) {
  const int lane = t.lane;
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = lane + r * W;
    for (int j = 0; j < NV && i < NV; j++) {
      const int low = i < j ? i : j, high = i < j ? j : i;
      s.inverse[i][j / 4].x[j % 4] =
          i == j ? search.diagonal[r] : s.rows[high][low / 4].x[low % 4];
    }
  }
  const auto entry = [&](int i, int j) -> real& { return s.inverse[i][j / 4].x[j % 4]; };
  LOOP for (int m = 0; m < NV; m++) {
    t.sync();
    const real pivot = 1 / entry(m, m);
    EACH(i, NV) {
      if (i == m) continue;
      const real share = entry(i, m) * pivot;
      for (int j = 0; j < NV; j++)
        entry(i, j) = j == m ? -share : entry(i, j) - share * entry(m, j);
    }
    t.sync();
    EACH(j, NV) entry(m, j) = j == m ? pivot : pivot * entry(m, j);
  }
  t.sync();
}

// Minimizes x A x / 2 + x b where x lies in the ellipsoid of `reach` times friction, all [n]
// (mju_QCQP and its kin): Newton's method for the multiplier of the ellipsoid.
DEV void minimize_in_ellipsoid(int n, const real (*a)[CD], const real* b, const real* friction,
                               real reach, real* x) {
  constexpr real SMALL = real(1e-10);
  real multiplier = 0, square = 0;
  LOOP for (int step = 0; step < 20; step++) {
    real l[CD][CD], y[CD], determinant = 1, least = real(1e30), slope = 0;
    for (int i = 0; i < n; i++) {
      for (int j = 0; j <= i; j++) {
        real sum = friction[i] * friction[j] * a[i][j] + (i == j ? multiplier : real(0));
        for (int k = 0; k < j; k++) sum -= l[i][k] * l[j][k] * l[k][k];
        l[i][j] = i == j ? sum : sum / l[j][j];
      }
      determinant *= l[i][i];
      least = l[i][i] < least ? l[i][i] : least;
    }
    if ((n < 4 ? determinant : least) < SMALL) {
      for (int i = 0; i < n; i++) x[i] = 0;
      return;
    }
    const auto solve_for = [&](const auto& right, real* out) {
      for (int i = 0; i < n; i++) {
        out[i] = right(i);
        for (int k = 0; k < i; k++) out[i] -= l[i][k] * out[k];
      }
      for (int i = n - 1; i >= 0; i--) {
        out[i] /= l[i][i];
        for (int k = i + 1; k < n; k++) out[i] -= l[k][i] * out[k];
      }
    };
    solve_for([&](int i) { return -friction[i] * b[i]; }, x);
    square = 0;
    for (int i = 0; i < n; i++) square += x[i] * x[i];
    const real over = square - reach * reach;
    if (over < SMALL) break;
    solve_for([&](int i) { return x[i]; }, y);
    for (int i = 0; i < n; i++) slope -= 2 * x[i] * y[i];
    if (-over / slope < SMALL) break;
    multiplier -= over / slope;
  }
  const real scale =
      multiplier == 0 ? real(1) : reach / root(square > real(1e-15) ? square : real(1e-15));
  for (int i = 0; i < n; i++) x[i] *= scale * friction[i];
}

// The cost of the softness of a contact's rows.
DEV real soft_cost(const Model& M, const Contact& c) {
  const int kind = M.item_kind[c.item], dim = M.kind_dim[kind];
  real sum = ELLIPTIC || dim == 1 ? c.force[0] * c.force[0] : real(0);
  for (int k = 1; k < dim; k++) {
    const real friction = friction_of(M, c, kind).along[k - 1], force = c.force[k] / friction;
    const real mu = ELLIPTIC ? mu_of(M, c, kind) : real(0), both = c.change[k] / friction;
    sum += ELLIPTIC ? mu * mu * force * force : (both * both + force * force) / 2;
  }
  return sum / c.constraint_mass / 2;
}

// Moves the forces of friction of a contact; returns what that gains.
DEV real hold_contact(const Team& t, const Model& M, State& s, Contact& c, int turn) {
  const int kind = M.item_kind[c.item], n = M.kind_dim[kind] - 1;
  Quad(*const rows)[quads(SIDE + 1)] = s.columns[turn];
  real entries[CD][ROWS_A_LANE], moves[CD][ROWS_A_LANE] = {};
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    real all[CD] = {};
    if (i < NV) basis(M, s, c, i, all);
    for (int k = 0; k < n; k++) {
      entries[k][r] = all[k + 1];
      if (i < SIDE) rows[k][i / 4].x[i % 4] = all[k + 1];
    }
  }
  t.sync();
  real a[CD][CD], residual[CD], b[CD], force[CD], before[CD];
  for (int k = 0; k < n; k++) {
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      for (int j = 0; j < NV && i < NV; j++)
        moves[k][r] += s.inverse[i][j / 4].x[j % 4] * rows[k][j / 4].x[j % 4];
    }
    for (int j = 0; j <= k; j++) {
      real sum = 0;
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++) sum += entries[j][r] * moves[k][r];
      a[k][j] = a[j][k] = t.sum(sum);
    }
    before[k] = force[k] = c.force[k + 1];
    residual[k] = c.residual[k + 1] + moved_along(t, s, entries[k]);
  }
  real gain = 0;
  if (ELLIPTIC) {
    for (int k = 0; k < n; k++) {
      a[k][k] = a[k][k] > real(1e-10) ? a[k][k] : real(1e-10);
      b[k] = residual[k];
    }
    for (int k = 0; k < n; k++)
      for (int j = 0; j < n; j++) b[k] -= a[k][j] * before[j];
    if (c.force[0] < real(1e-15)) {
      for (int k = 0; k < n; k++) force[k] = 0;
    } else {
      minimize_in_ellipsoid(n, a, b, friction_of(M, c, kind).along, c.force[0], force);
    }
    for (int k = 0; k < n; k++) {
      const real by = force[k] - before[k];
      gain -= by * residual[k];
      for (int j = 0; j < n; j++) gain -= a[k][j] * by * (force[j] - before[j]) / 2;
    }
    if (gain < real(-1e-10)) {
      for (int k = 0; k < n; k++) force[k] = before[k];
      gain = 0;
    }
  } else {
    // Two edges on opposite sides keep the sum of their forces: the other way they go to the best.
    for (int k = 0; k < n; k++) {
      for (int j = 0; j < k; j++) residual[k] += a[k][j] * (force[j] - before[j]);
      const real friction = friction_of(M, c, kind).along[k], most = c.change[k + 1];
      const bool moves_some = 4 * friction * friction * a[k][k] >= real(1e-15);
      force[k] = moves_some ? clip(before[k] - residual[k] / a[k][k], -most, most) : real(0);
      const real by = force[k] - before[k], more = -by * (residual[k] + a[k][k] * by / 2);
      if (more < real(-1e-10)) force[k] = before[k]; else gain += more;
    }
  }
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    for (int k = 0; k < n && i < NV; k++)
      s.direction[i / 4].x[i % 4] += moves[k][r] * (force[k] - before[k]);
  }
  if (t.lane == 0)
    for (int k = 0; k < n; k++) c.force[k + 1] = force[k];
  t.sync();
  return gain;
}

// Moves the friction loss of a degree of freedom; returns what that gains.
DEV real hold_dof(const Team& t, const Model& M, State& s, int i, bool starts) {
  Bounds bounds;
  bounds.make(M, s, i);
  const real residual = s.qacc_warmstart[i] - bounds.loss_reference;
  const real most = bounds.loss, mass = bounds.loss_constraint_mass;
  const real before = starts ? clip(-mass * residual, -most, most) : s.loss_force[i];
  const real now = residual + s.direction[i / 4].x[i % 4];
  const real a = s.inverse[i][i / 4].x[i % 4], force = clip(before - now / a, -most, most);
  const real by = force - before, soft = starts && mass > 0 ? before * before / mass / 2 : real(0);
  t.sync();
  const int lane = t.lane;
  EACH(j, NV) s.direction[j / 4].x[j % 4] += s.inverse[j][i / 4].x[i % 4] * by;
  if (lane == 0) s.loss_force[i] = force;
  t.sync();
  return soft - by * (now + a * by / 2);
}

// What the softness of limits and general rows costs, a lane's part.
DEV real soft_rows(const Team& t, const Model& M, const State& s, const Search& search,
                   Mask island) {
  real sum = 0;
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    if (!(island >> (t.lane + r * W) & 1)) continue;
    for (int n = 0; n < LIMITS; n++) {
      const Bounds& b = search.bounds[r];
      const real residual = b.limit_sign[n] * search.qacc[r] - b.limit_reference[n];
      if (residual < 0) sum += b.limit_constraint_mass[n] * residual * residual / 2;
    }
  }
  for (int e = t.lane; e < NE; e += W) {
    real stiffness, moves = 0;
    const real force = general_force(M, s, e, stiffness);
    for (int i = 0; i < NV; i++)
      if (island >> i & 1) moves += fabs(s.general[e][i / 4].x[i % 4]);
    if (moves > 0 && force != 0) sum += force * force / s.general_constraint_mass[e] / 2;
  }
  return sum;
}

DEV void no_slip(const Team& t, const Model& M, State& s, Search& search) {
  const int lane = t.lane;
  store_acceleration(t, s, search);
  invert_inertia(t, s, search);
  each_contact(t, s, [&](Contact& c) {
    push(M, c);
    if (!ELLIPTIC)  // what friction may be at most: as much as two edges push together
      for (int k = 1; k < M.kind_dim[M.item_kind[c.item]]; k++) {
        const real mu = friction_of(M, c, M.item_kind[c.item]).along[k - 1];
        const real x = c.residual[0], y = mu * c.residual[k];
        c.change[k] = mu * c.constraint_mass * ((x + y < 0 ? -x - y : 0) + (x - y < 0 ? y - x : 0));
      }
  });
  EACH(q, QUADS) s.direction[q] = {0, 0, 0, 0};
  t.sync();
  Mask left = EVERYTHING >> (8 * int(sizeof(Mask)) - NV);
  while (left) {
    const Mask island = ISLANDS ? next_island(t, M, s, search, left) : left;
    left &= ~island;
    real trace = 0;
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
      if (island >> (lane + r * W) & 1) trace += search.diagonal[r];
    trace = ONE_ISLAND ? MEAN_TRACE : t.sum(trace);
    LOOP for (int sweep = 0; sweep < NOSLIP; sweep++) {
      real gain = sweep ? real(0) : t.sum(soft_rows(t, M, s, search, island));
      LOOP for (int i = 0; LOSSES && i < NV; i++)
        if (island >> i & 1 && M.dof_loss[i].most > 0) gain += hold_dof(t, M, s, i, sweep == 0);
      LOOP for (int n = 0; n < s.num_contacts; n++) {
        Contact& c = contact_at(s, n);
        const Item item = M.item[c.item];
        const Mask moved = M.link_dofs[M.geom_link[item.first()]] |
                           M.link_dofs[M.geom_link[item.second()]];
        if (!(moved & island)) continue;
        if (!sweep) gain += soft_cost(M, c);
        if (M.kind_dim[M.item_kind[c.item]] > 1) gain += hold_contact(t, M, s, c, n & 1);
      }
      if (gain / trace < NOSLIP_TOLERANCE) break;
    }
  }
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = lane + r * W;
    if (i < NV) search.qacc[r] += s.direction[i / 4].x[i % 4];
  }
  t.sync();
}

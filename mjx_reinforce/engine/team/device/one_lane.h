// What one lane does alone, where a compiler for a CPU makes vectors of its loops: the algebra of
// newton.h and elimination.h, by whole rows of H. Below the diagonal and on it H is in rows h.
#pragma once

// M's rows: above the diagonal s.rows is zero, as nothing eliminates there.
DEV void load_rows_alone(const State& s, Rows& h) {
  for (int i = 0; i < SIDE; i++) {
    const real* row = &s.rows[i][0].x[0];
    for (int j = 0; j < int(sizeof(h[0]) / sizeof(real)); j++) h[i][j] = j < SIDE ? row[j] : real(0);
  }
}

// As add_rows. Degrees of freedom that a contact does not move are left out.
DEV void add_contact_alone(const Model& M, const State& s, const Contact& c, Rows& h,
                           real (&gradient)[ROWS_A_LANE]) {
  const Item item = M.item[c.item];
  const Mask moved =
      M.link_dofs[M.geom_link[item.first()]] ^ M.link_dofs[M.geom_link[item.second()]];
  real rows[CD][SIDE] = {};
  for (int i = 0; i < NV; i++) {
    if (!(moved >> i & 1)) continue;
    real entries[CD], weight[CD];
    basis(M, s, c, i, entries);
    for (int k = 0; k < CD; k++) {
      rows[k][i] = entries[k];
      gradient[i] -= entries[k] * c.force[k];
    }
    stiffness_times(c, entries, weight);
    for (int j = 0; j < SIDE; j++) {
      real sum = 0;
      for (int k = 0; k < CD; k++) sum += weight[k] * rows[k][j];
      h[i][j] += sum;
    }
  }
}

// As solve. From the last row to the first, each is eliminated from those before it: what its row
// of H leaves out, as other branches of the tree, is left out.
DEV void solve_alone(State& s, Rows& h, const real (&gradient)[ROWS_A_LANE],
                     real (&p)[ROWS_A_LANE]) {
  constexpr int WIDTH = sizeof(h[0]) / sizeof(real);
  real inverse[SIDE], x[WIDTH] = {};
  for (int i = 0; i < NV; i++) x[i] = -gradient[i];
  for (int m = SIDE - 1; m >= 0; m--) {
    inverse[m] = 1 / h[m][m];
    const real solved = x[m];
    for (int i = 0; i < m; i++) {
      const real share = h[m][i] * inverse[m];
      if (share == 0) continue;
      x[i] -= solved * share;
      for (int b = 0; b <= i / 8; b++)
        for (int k = 0; k < 8; k++) h[i][8 * b + k] -= share * h[m][8 * b + k];
    }
  }
  real y[WIDTH] = {};
  for (int i = 0; i < SIDE; i++) {
    real sum[8] = {};
    for (int b = 0; b <= i / 8; b++)
      for (int k = 0; k < 8; k++) sum[k] += h[i][8 * b + k] * y[8 * b + k];
    for (int k = 0; k < 4; k++) sum[k] += sum[k + 4];
    y[i] = (x[i] - ((sum[0] + sum[1]) + (sum[2] + sum[3]))) * inverse[i];
  }
  for (int i = 0; i < SIDE; i++) s.direction[i / 4].x[i % 4] = p[i] = y[i];
}

// As inertia_times_direction.
DEV void inertia_times_alone(const State& s, const real* diagonal, const real* direction,
                             real* out) {
  for (int i = 0; i < NV; i++) out[i] = diagonal[i] * direction[i];
  for (int i = 1; i < NV; i++) {
    const real* row = &s.rows[i][0].x[0];
    real sum = 0;
    for (int j = 0; j < i; j++) {
      sum += row[j] * direction[j];
      out[j] += row[j] * direction[i];
    }
    out[i] += sum;
  }
}

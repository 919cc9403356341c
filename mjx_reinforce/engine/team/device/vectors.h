// What one lane does alone where a compiler makes vectors of its loops: the algebra of newton.h and
// elimination.h by whole rows of H, whose entries below the diagonal and on it count.
#pragma once

// Sums along the tree of six components at once; as along_tree.
DEV void along_tree_in_vectors(const real* entries, const Quad* by, real* out, int width) {
  real sum[NV][8];
  for (int i = 0; i < NV; i++) {
    const int parent = dof_parent(i), link = last_of_link(i);
    const real factor = by[i / 4].x[i % 4];
    for (int k = 0; k < 8; k++) {
      const real before = parent < 0 ? real(0) : sum[parent < 0 ? 0 : parent][k];
      sum[i][k] = before + entries[8 * i + k] * factor;
    }
    if (link >= 0)
      for (int k = 0; k < 6; k++) out[link * width + k] = sum[i][k];
  }
}

// M's rows: above the diagonal s.rows is zero, as nothing eliminates there.
DEV void load_rows_in_vectors(const State& s, Rows& h) {
  for (int i = 0; i < SIDE; i++) {
    const real* row = &s.rows[i][0].x[0];
    for (int j = 0; j < ROW_SIZE; j++) h[i][j] = j < SIDE ? row[j] : real(0);
  }
}

// Of one contact as add_rows. Degrees of freedom that it does not move are left out.
DEV void add_contact_in_vectors(const Model& M, const State& s, const Contact& c, Rows& h,
                                real (&gradient)[ROWS_A_LANE]) {
  const Item item = M.item[c.item];
  const Mask first = M.link_dofs[M.geom_link[item.first()]];
  const Mask second = M.link_dofs[M.geom_link[item.second()]];
  real rows[CD][SIDE] = {};
  for (int i = 0; i < NV; i++) {
    if (!((first ^ second) >> i & 1)) continue;
    real entries[CD], weight[CD];
    basis(M, s, c, i, entries);
    for (int k = 0; k < CD; k++) {
      rows[k][i] = entries[k];
      gradient[i] -= entries[k] * c.force[k];
    }
    stiffness_times(c, entries, weight);
    // Rows after this one are zero so far: below the diagonal nothing is lost.
    for (int j = 0; j < SIDE; j++)
      for (int k = 0; k < CD; k++) h[i][j] += weight[k] * rows[k][j];
  }
}

// As load_right_side and solve (mj_factorI's order). From the last row to the first, each is
// eliminated from those before it; those that it does not meet, as of other branches of the tree,
// stay as they are.
DEV void solve_in_vectors(State& s, Rows& h, const real (&gradient)[ROWS_A_LANE],
                          real (&p)[ROWS_A_LANE]) {
  constexpr int PART = 8;
  real inverse[SIDE], right_side[SIDE] = {}, solution[ROW_SIZE] = {};
  for (int i = 0; i < NV; i++) right_side[i] = -gradient[i];
  for (int m = SIDE - 1; m >= 0; m--) {
    inverse[m] = 1 / h[m][m];
    for (int i = 0; i < m; i++) {
      const real share = h[m][i] * inverse[m];
      if (share == 0) continue;
      right_side[i] -= share * right_side[m];
      // By whole vectors: what is beyond the diagonal has no meaning.
      for (int j = 0; j <= i; j += PART)
        for (int k = 0; k < PART; k++) h[i][j + k] -= share * h[m][j + k];
    }
  }
  for (int i = 0; i < SIDE; i++) {
    // What is not solved yet is zero.
    real sum[PART] = {};
    for (int j = 0; j <= i; j += PART)
      for (int k = 0; k < PART; k++) sum[k] += h[i][j + k] * solution[j + k];
    for (int half = PART / 2; half; half /= 2)
      for (int k = 0; k < half; k++) sum[k] += sum[k + half];
    solution[i] = (right_side[i] - sum[0]) * inverse[i];
  }
  for (int i = 0; i < SIDE; i++) s.direction[i / 4].x[i % 4] = p[i] = solution[i];
  p[SIDE] = 0;
}

// As inertia_times_direction.
DEV void inertia_times_in_vectors(const State& s, const real* diagonal, const real* direction,
                                  real (&out)[ROWS_A_LANE]) {
  for (int i = 0; i < ROWS_A_LANE; i++) out[i] = i < NV ? diagonal[i] * direction[i] : real(0);
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

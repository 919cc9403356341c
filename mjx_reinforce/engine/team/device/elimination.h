// The Newton step: a symmetric system of equations, its rows dealt to the lanes in turn.
#pragma once

// Whether rows lane + r W are eliminated with columns m and m + 1, in all lanes.
DEV constexpr bool is_over(int r, int m) { return (r + 1) * W <= m + 2; }

// Solves H p = right (MuJoCo factors H, mju_cholFactor) by elimination of two columns at a time,
// for the rows h and, as one row more, the right side. Leaves p in p and in s.direction.
DEV void solve(const Team& t, State& s, Rows& h, real (&p)[ROWS_A_LANE]) {
  real *flat = &s.rows[0][0].x[0], *right_side = &s.direction[0].x[0];
  UNROLL for (int m = 0; m < SIDE; m += 2) {
    // Columns m and m + 1 by all lanes, in one of two buffers by turns: one sync a pair of columns.
    real *first = &s.columns[m / 2 % 2][0][0].x[0], *second = &s.columns[m / 2 % 2][1][0].x[0];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      if (i <= SIDE) {
        if (r == m / W) first[i] = h[r][m];
        if (r == (m + 1) / W) second[i] = h[r][m + 1];
      }
    }
    // What is further down in these columns is at the end of rows m and m + 1.
    UNROLL for (int c = m; c < m + 2; c++)
      if (t.lane == c % W)
        UNROLL for (int j = (c / W + 1) * W; j <= SIDE; j++)
          (c == m ? first : second)[j] = h[c / W][j];
    t.sync();
    // Multipliers u, w of columns m and m + 1: the 2 x 2 pivot inverted, times this lane's rows.
    // Row r of the lane is row i = lane + r W of H; i == SIDE is the right side.
    const real corner = first[m + 1], inverse = 1 / first[m], ratio = corner * inverse;
    const real last = 1 / (second[m + 1] - ratio * corner);
    real u[ROWS_A_LANE], w[ROWS_A_LANE];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      if (is_over(r, m)) continue;
      const int i = t.lane + r * W, row = i <= SIDE ? i : SIDE;
      const real x = uses_column(r, m) ? h[r][m] : first[row];
      const real y = uses_column(r, m) ? h[r][m + 1] : second[row];
      w[r] = (y - ratio * x) * last;
      u[r] = x * inverse - ratio * w[r];
      if (i > m + 1 && i < SIDE + (ROWS_A_LANE == 1)) {
        flat[m * STRIDE + i] = u[r];
        flat[(m + 1) * STRIDE + i] = w[r];
      }
      if (ROWS_A_LANE > 1 && i == SIDE) {
        right_side[m] = u[r];
        right_side[m + 1] = w[r];
      }
    }
    UNROLL for (int q = (m + 2) / 4; q < (SIDE + (ROWS_A_LANE > 1) + 3) / 4; q++) {
      const Quad a = s.columns[m / 2 % 2][0][q], b = s.columns[m / 2 % 2][1][q];
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
        for (int k = 0; k < 4; k++) {
          const int j = 4 * q + k;
          if (j >= m + 2 && uses_column(r, j) && !is_over(r, m))
            h[r][j] = h[r][j] - u[r] * a.x[k] - w[r] * b.x[k];
        }
    }
  }
  // The multipliers are above the diagonal, and those of the right side are a column behind it or,
  // where it is in no row, alone: from the last rows on, each row's solution is subtracted from the
  // rows before it.
  t.sync();
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    p[r] = i >= SIDE ? real(0) : ROWS_A_LANE > 1 ? right_side[i] : flat[i * STRIDE + SIDE];
  }
  UNROLL for (int q = (SIDE - 1) / 4; q >= 0; q--) {
    Quad row[ROWS_A_LANE];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      row[r] = s.rows[i < SIDE ? i : 0][q];
    }
    UNROLL for (int k = 2; k >= 0; k -= 2) {
      const int m = 4 * q + k;
      if (m == 0 || m >= SIDE) continue;
      const real a = t.from(p[m / W], m % W), b = t.from(p[(m + 1) / W], (m + 1) % W);
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
        if (r * W < m && t.lane + r * W < m) p[r] = p[r] - row[r].x[k] * a - row[r].x[k + 1] * b;
    }
  }
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    if (i < SIDE) s.direction[i / 4].x[i % 4] = p[r];
  }
  t.sync();
}

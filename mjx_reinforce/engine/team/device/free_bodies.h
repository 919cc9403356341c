// Free bodies that nothing else moves with, under implicitfast: MuJoCo adds how their own turning
// changes with the velocity, which makes the 6 equations of such a body unsymmetric
// (mj_implicitSkip, mjd_freeMhat).
#pragma once

// Replaces what implicit damping adds to their accelerations. The inertia, and implicit damping of
// single degrees of freedom on its diagonal, are in s.rows.
DEV void turn_free_bodies(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  real* more = &s.direction[0].x[0];
  EACH(n, NFREE) {
    const int link = M.free_link[n], first = M.link_dof[link];
    const real *w = s.qvel + first + 3, *center = M.link_com + 3 * link;
    const real *inertia = M.link_inertia + 6 * link, mass = M.link_mass[link], h = M.timestep;
    // What is beyond M, and from there on the right side and all of the matrix.
    real a[6][6] = {}, right[6];
    // In the body's axes: the center's velocity, and the angular momentum about it.
    real turns[10], zero[3] = {}, moves[3], momentum[6], angular[6] = {w[0], w[1], w[2], 0, 0, 0};
    spatial_inertia(turns, inertia, 0, zero);
    inertia_times(momentum, turns, angular);
    cross(moves, w, center);
    UNROLL for (int c = 0; c < 3; c++) {
      real axis[6] = {}, x[3], y[3], linear[3], turned[6];
      axis[c] = 1;
      cross(x, center, axis);
      cross(x, w, x);
      cross(y, moves, axis);
      for (int k = 0; k < 3; k++) x[k] += y[k];
      s.pose[link].turn(linear, x);
      cross(x, center, x);
      inertia_times(turned, turns, axis);
      cross(turned, w, turned);
      cross(y, momentum, axis);
      for (int k = 0; k < 3; k++) {
        a[k][3 + c] = -h * mass * linear[k];
        a[3 + k][3 + c] = h * (turned[k] - y[k] - mass * x[k]);
      }
    }
    UNROLL for (int r = 0; r < 6; r++) {
      const int i = first + r;
      a[r][r] += h * s.drag[i];
      for (int m = 0; m < NCABLE; m++) {
        const Cable& cable = s.cables[m];
        const real weight = h * cable.drag * cable.moment[i / 4].x[i % 4];
        for (int c = 0; c < 6; c++) {
          const int j = first + c;
          a[r][c] += weight * cable.moment[j / 4].x[j % 4];
        }
      }
      right[r] = STOPS_EARLY ? -s.imbalance[i] : real(0);
      UNROLL for (int c = 0; c < 6; c++) {
        const int j = first + c, low = r < c ? i : j, high = r < c ? j : i;
        right[r] -= a[r][c] * s.qacc_warmstart[j];
        a[r][c] += s.rows[high][low / 4].x[low % 4] - (r == c ? h * s.drag[i] : real(0));
      }
    }
    UNROLL for (int m = 0; m < 6; m++)
      UNROLL for (int r = m + 1; r < 6; r++) {
        const real share = a[r][m] / a[m][m];
        UNROLL for (int c = m + 1; c < 6; c++) a[r][c] -= share * a[m][c];
        right[r] -= share * right[m];
      }
    UNROLL for (int m = 5; m >= 0; m--) {
      UNROLL for (int c = m + 1; c < 6; c++) right[m] -= a[m][c] * right[c];
      right[m] /= a[m][m];
      more[first + m] = right[m];
    }
  }
  t.sync();
}

// Sensors of touch: the normal forces on a body whose lines meet a zone of it (mjSENS_TOUCH).
#pragma once

// Whether a ray meets a zone about the origin, whose first axes are round: 3 of an ellipsoid, 2 of
// a cylinder, none of a box (mju_rayGeom). All are convex: the lengths of the ray within them are
// between two.
DEV bool meets_zone(const real* size, int round_axes, const real* from, const real* along) {
  real a = 0, b = 0, c = -1, low = 0, high = real(1e30);
  const auto narrow = [&](real least, real most) {
    if (least > low) low = least;
    if (most < high) high = most;
  };
  for (int k = 0; k < 3; k++) {
    const real place = from[k] / size[k], way = along[k] / size[k];
    if (k >= round_axes) {
      const real x = (-1 - place) / way, y = (1 - place) / way;
      narrow(x < y ? x : y, x < y ? y : x);
      continue;
    }
    a += way * way;
    b += way * place;
    c += place * place;
  }
  const real square = b * b - a * c;
  if (round_axes && (square < 0 || (a == 0 && c > 0))) return false;
  if (round_axes && a > 0) narrow((-b - root(square)) / a, (-b + root(square)) / a);
  return low <= high;
}

// A template, so that a model without such sensors needs no tables of them.
template <class Tables> DEV void feel(const Team& t, const Tables& M, State& s) {
  const int lane = t.lane;
  EACH(n, NTOUCH) s.touch[n] = 0;
  if (!reports(CFRC_EXT) && !NOSLIP) each_contact(t, s, [&](Contact& c) { push(M, c); });
  t.sync();
  all_contacts(t, s, [&](const Contact& c) {
    if (!(c.force[0] > 0)) return;
    const int first = M.geom_body[M.item[c.item].first()];
    const int second = M.geom_body[M.item[c.item].second()];
    EACH(n, NTOUCH) {
      const int b = M.touch_body[n];
      if (b != first && b != second) continue;
      const Pose& link = s.pose[M.touch_link[n]];
      const real *turn = M.touch_turn + 9 * n, *at = M.touch_at + 3 * n;
      real away[3], place[3], normal[3], from[3], along[3];
      for (int k = 0; k < 3; k++) away[k] = c.at[k] + s.pose[0].origin(k) - link.origin(k);
      link.turn_back(place, away);
      link.turn_back(normal, c.frame);
      for (int k = 0; k < 3; k++) {
        from[k] = along[k] = 0;
        for (int j = 0; j < 3; j++) {
          from[k] += turn[3 * j + k] * (place[j] - at[j]);
          along[k] += turn[3 * j + k] * (b == second ? -normal[j] : normal[j]);
        }
      }
      if (meets_zone(M.touch_size + 3 * n, M.touch_round[n], from, along))
        s.touch[n] += c.force[0];
    }
  });
}

// The solver of models that allow it few steps, or few lengths of one: what C answers is where its
// search happened to be, so that this is C's own search (mj_solNewton; in JAX
// physics/early_stop.py).
#pragma once

// A length of a step, and there the cost above that at length 0, with its derivatives.
struct Mark {
  real length, cost, slope, curvature;
  // Where the slope would be zero if no row changed.
  DEV real next() const { return length - slope / curvature; }
};

// Rows of one lane along a step.
struct Work {
  real length;
  real cost = 0, slope = 0, curvature = 0;
  // A row whose force is linear from `then` to `now`, or zero at one of them.
  DEV void add(real mass, real then, real change, bool pushed, bool pushes) {
    const real now = then + length * change;
    // The difference of two costs has no digits where a row stays what it is; its mean force has.
    cost += pushed && pushes ? mass * length * change * (then + now) / 2
                             : mass * ((pushes ? now * now : 0) - (pushed ? then * then : 0)) / 2;
    if (pushes) {
      slope += mass * now * change;
      curvature += mass * change * change;
    }
  }
  DEV void add_one_sided(real mass, real residual, real change) {
    add(mass, residual, change, residual < 0, residual + length * change < 0);
  }
  // A row of friction loss: beyond its reach the force is at its bound.
  DEV void add_bounded(real mass, real bound, real residual, real change) {
    const real reach = bound / mass, now = residual + length * change;
    const bool was_linear = fabs(residual) < reach, is_linear = fabs(now) < reach;
    add(mass, residual, change, was_linear, is_linear);
    const real sign = now < 0 ? real(-1) : real(1);
    if (!was_linear && !is_linear && residual * now > 0) {
      cost += bound * sign * length * change;
    } else {
      if (!was_linear) cost -= bound * (fabs(residual) - reach / 2);
      if (!is_linear) cost += bound * (fabs(now) - reach / 2);
    }
    if (!is_linear) slope += bound * sign * change;
  }
};

DEV void add_contact(const Model& M, const Contact& c, Work& sum) {
  if (ELLIPTIC && M.kind_dim[M.item_kind[c.item]] > 1) {
    const ConeCost end = cone_cost(M, c, sum.length);
    sum.cost += end.cost - cone_cost(M, c, 0).cost;
    sum.slope += end.slope;
    sum.curvature += end.curvature;
    return;
  }
  each_edge(M, c, [&](real friction, int k, real) {
    const real residual = c.residual[0] + (k ? friction * c.residual[k] : real(0));
    const real change = c.change[0] + (k ? friction * c.change[k] : real(0));
    sum.add_one_sided(c.constraint_mass, residual, change);
  });
}

DEV void add_general(const Model& M, const State& s, int e, Work& sum) {
  const int n = e - (NE - NLIMITED - NLOSS);
  const real mass = s.general_constraint_mass[e];
  const real residual = s.general_residual[e], change = s.general_change[e];
  if (n < 0) {
    sum.add(mass, residual, change, true, true);
  } else if (n < NLIMITED) {
    if (mass > 0) sum.add_one_sided(mass, residual, change);
  } else {
    sum.add_bounded(mass, M.bound_loss[n - NLIMITED], residual, change);
  }
}

// A step of the search: its slope and curvature without rows.
struct Step { real slope, curvature; };

DEV Mark mark_at(const Team& t, const Model& M, State& s, const Search& search, const Step& step,
                 real length) {
  const int lane = t.lane;
  Work sum = {length};
  each_contact(t, s, [&](Contact& c) { add_contact(M, c, sum); });
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    search.bounds[r].work(search.qacc[r], search.direction[r], sum);
  EACH(e, NE) add_general(M, s, e, sum);
  const real curvature = step.curvature + t.sum(sum.curvature);
  return {length, length * (step.slope + length * step.curvature / 2) + t.sum(sum.cost),
          step.slope + length * step.curvature + t.sum(sum.slope),
          curvature > 0 ? curvature : real(1e-15)};
}

// Moves an end to the candidate on its side of the root that is nearest (updateBracket).
DEV void move_inwards(Mark& end, const Mark& first, const Mark& second, const Mark& third) {
  const auto try_mark = [&](const Mark& mark) {
    if (mark.slope * end.slope > 0 && fabs(mark.slope) < fabs(end.slope)) end = mark;
  };
  try_mark(first);
  try_mark(second);
  try_mark(third);
}

// Where C's line search (PrimalSearch) ends: Newton steps along the line until the slope changes
// its sign, then both ends of that interval move inwards. A round evaluates one length, so that the
// code of mark_at, which is long, is there once; `starts` asks for length 1 alone.
//
// `along` is the slope at length 0. The curvature there is minus that, as H direction is minus the
// gradient, so that the first Newton step is of length 1; C evaluates length 0, and counts it.
DEV Mark line_as_c(const Team& t, const Model& M, State& s, const Search& search, const Step& step,
                   real along, real small, bool starts) {
  enum { AT_NEWTON, FOLLOWS, AT_ROOT, AT_MIDDLE, AT_LOW_ROOT, AT_HIGH_ROOT };
  int phase = AT_NEWTON, lengths = 1;
  real length = 1, sign = 1;
  bool moves_low = false, moves_high = false;
  Mark low = {}, high = {0, 0, along, -along}, low_root = {}, high_root = {};
  LOOP for (;;) {
    const Mark mark = mark_at(t, M, s, search, step, length);
    lengths++;
    if (starts) return mark;
    const bool flat = fabs(mark.slope) < small;
    if (phase <= FOLLOWS) {
      if (flat && mark.cost < 0) return mark;
      if (phase == AT_NEWTON) sign = mark.slope < 0 ? real(1) : real(-1);
      if (phase == FOLLOWS) high = low;
      low = mark;
      if (lengths >= LENGTHS) return low;
      phase = low.slope * sign <= -small ? FOLLOWS : AT_ROOT;
      length = low.next();
      continue;
    }
    if (phase == AT_MIDDLE) {
      // Of those where the slope is zero the one of least cost; C looks at the middle last.
      Mark best = low_root;
      bool some = fabs(low_root.slope) < small;
      if (fabs(high_root.slope) < small && (!some || high_root.cost < best.cost))
        best = high_root, some = true;
      if (flat && (!some || mark.cost < best.cost)) best = mark, some = true;
      if (some) return best;
      const Mark low_before = low, high_before = high;
      move_inwards(low, low_root, high_root, mark);
      move_inwards(high, low_root, high_root, mark);
      moves_low = low.slope != low_before.slope;
      moves_high = high.slope != high_before.slope;
      if (!moves_low && !moves_high) return mark;
    }
    if (phase == AT_ROOT) low_root = mark, high_root = low;
    if (phase == AT_LOW_ROOT) low_root = mark;
    if (phase == AT_HIGH_ROOT) high_root = mark;
    if (phase == AT_MIDDLE && moves_low) {
      phase = AT_LOW_ROOT;
      length = low.next();
    } else if ((phase == AT_MIDDLE || phase == AT_LOW_ROOT) && moves_high) {
      phase = AT_HIGH_ROOT;
      length = high.next();
    } else {
      if (lengths >= LENGTHS) break;
      phase = AT_MIDDLE;
      length = (low.length + high.length) / 2;
    }
  }
  const Mark end = low.cost <= high.cost ? low : high;
  return end.cost < 0 ? end : Mark{0, 0, 0, 0};
}

// Subtracts the forces of contacts and general rows from the gradient.
DEV void subtract_forces(const Team& t, const Model& M, State& s, real (&gradient)[ROWS_A_LANE]) {
  all_contacts(t, s, [&](const Contact& c) {
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      real moves[CD];
      if (i < NV) {
        basis(M, s, c, i, moves);
        for (int k = 0; k < CD; k++) gradient[r] -= moves[k] * c.force[k];
      }
    }
  });
  for (int e = 0; e < NE; e++) {
    real stiffness;
    const real force = general_force(M, s, e, stiffness);
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      if (i < NV) gradient[r] -= s.general[e][i / 4].x[i % 4] * force;
    }
  }
}

// As begin_step.
DEV void begin_step_as_c(const Team& t, const Model& M, State& s, Search& search, bool starts,
                         bool damps) {
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    real stiffness = 0;
    search.gradient[r] = search.imbalance[r];
    if (!starts) search.bounds[r].push(search.qacc[r], search.gradient[r], stiffness);
    if (damps) stiffness = i < NV ? M.timestep * s.drag[i] : real(0);
    if (i < NV) s.rows[i][i / 4].x[i % 4] = search.diagonal[r] + stiffness;
  }
}

// A search that stops early leaves a gradient, of which implicit damping takes part, and
// turn_free_bodies in s.imbalance.
DEV void damp_rest(const Team& t, const Model& M, State& s, Search& search) {
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
    const int i = t.lane + r * W;
    if (i >= NV) continue;
    if (NFREE) s.imbalance[i] = search.gradient[r];
    search.gradient[r] += M.timestep * s.drag[i] * search.qacc[r];
  }
}

// Replaces newton, and returns as that.
DEV int newton_as_c(const Team& t, const Model& M, State& s) {
  Search search(t, M, s);
  // Of the island that is solved: first of all, and last of all, all is one.
  Mask island = EVERYTHING, left = EVERYTHING;
  bool settled = false, loose = false;
  real scale = 0, improvement = 0;
  const auto enter = [&](Mask entered) {
    island = entered;
    improvement = 0;
    real trace = 0;
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
      if (!ISLANDS || island >> (t.lane + r * W) & 1) trace += search.diagonal[r];
    trace = t.sum(trace);
    scale = 1 / (ONE_ISLAND ? MEAN_TRACE : trace);
  };
  enter(EVERYTHING);
  int steps = -1, earlier = 0;  // the first goes to where no row pushes, if that costs less
  LOOP for (;; steps++) {
    const bool starts = steps < 0, damps = IMPLICIT && settled;
    Rows h;
    begin_step_as_c(t, M, s, search, starts, damps);
    if (!starts) each_contact(t, s, [&](Contact& c) { push(M, c); });
    t.sync();
    load_rows(t, s, h);
    if (damps) {
      subtract_forces(t, M, s, search.gradient);
      damp_rest(t, M, s, search);
      if (IMPLICIT == 2 && NCABLE) damp_cables(t, M, s, search.qacc, search.gradient, h);
    } else if (!starts) {
      add_rows(t, M, s, h, search.gradient);
    }
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
      if (ISLANDS && !damps && !(island >> (t.lane + r * W) & 1)) search.gradient[r] = 0;
    find_direction(t, s, search, h);
    if (damps) break;
    change_along(t, M, s);
    t.sync();
    real inertia[ROWS_A_LANE], slope = 0, curvature = 0, square = 0, norm = 0, along = 0;
    inertia_times_direction(t, s, search, inertia);
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      slope += search.direction[r] * search.imbalance[r];
      curvature += search.direction[r] * inertia[r];
      square += search.gradient[r] * search.gradient[r];
      norm += search.direction[r] * search.direction[r];
      along += search.gradient[r] * search.direction[r];
    }
    const Step step = {t.sum(slope), t.sum(curvature)};
    norm = root(t.sum(norm));
    along = t.sum(along);
    if (!starts) {
      const bool flat = scale * root(t.sum(square)) < TOLERANCE;
      const bool low = -scale * along / 2 < TOLERANCE;
      const bool slow = scale * improvement > 0 && scale * improvement < TOLERANCE;
      settled = steps == 0 ? flat && low : flat || low || slow;
    }
    Mark mark = {0, 0, 0, 0};
    if (starts || (!loose && !settled && norm >= real(1e-15))) {
      const real small = TOLERANCE * LENGTH_TOLERANCE * norm / scale;
      mark = line_as_c(t, M, s, search, step, along, small, starts);
    }
    if (starts) {
      if (WARM && !(mark.cost < 0)) mark.length = 0;
    } else if (loose) {  // no row changes on the way to the optimum
      mark.length = 1;
      settled = true;
    } else {
      settled |= mark.length == 0 || steps + 1 >= STEPS;
      improvement = -mark.cost;
    }
    t.sync();
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
      search.imbalance[r] += mark.length * inertia[r];
    move_along(t, s, search, mark.length);
    if (ISLANDS && (starts || settled)) {
      left = starts ? EVERYTHING >> (8 * int(sizeof(Mask)) - NV) : left & ~island;
      const Mask rest = starts ? loose_trees(t, M, s, search) : 0;
      loose = rest != 0;
      settled = left == 0;
      if (left) enter(loose ? rest : next_island(t, M, s, search, left));
      earlier += steps + 1;
      steps = -1;
    }
    if (settled && !IMPLICIT) break;
  }
  store_acceleration(t, s, search);
  return earlier + steps + 1;
}

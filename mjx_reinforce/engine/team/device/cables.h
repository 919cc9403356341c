// Cables: what has a length and pulls at degrees of freedom along its moments. Tendons, the
// transmissions of actuators of sites and of free and ball joints (MuJoCo's mj_tendon and
// mj_transmission), and the angles of ball joints that have a limit.
#pragma once

// Of a fixed tendon a joint; of a spatial one a straight line between sites; a wrench, one that
// measures how far a place is along it, or how far a ball has turned; the angle of a ball.
enum { COEFFICIENT, SEGMENT, WRENCH, APART, TWIST, ANGLE };

// A rotation of at most half a turn as a vector, by a quaternion of any length (mju_quat2Vel).
DEV void rotation_vector(real* r, const real* quat) {
  const real sine = root(dot(quat + 1, quat + 1)), pi = real(3.14159265358979323846);
  real angle = 2 * atan2(sine, quat[0]);
  if (angle > pi) angle -= 2 * pi;
  for (int k = 0; k < 3; k++) r[k] = sine > real(1e-15) ? angle / sine * quat[1 + k] : real(0);
}
// A place of a link, about the point of reference.
DEV void place_of(const State& s, int link, const real* local, real* at) {
  s.pose[link].place(at, local);
  for (int k = 0; k < 3; k++) at[k] -= s.pose[0].origin(k);
}
// A polynomial of MuJoCo's springs and dampers, and the derivative of x times it (mju_polyForce).
DEV real polynomial(const real* p, real x) { return p[0] + x * (p[1] + x * p[2]); }
DEV real polynomial_rate(const real* p, real x) { return p[0] + x * (2 * p[1] + x * 3 * p[2]); }

// What a spring and a damper pull with (of mj_springdamper).
DEV real tension(const Tendon& tendon, real length, real speed) {
  const real off = length - clip(length, tendon.rest[0], tendon.rest[1]);
  return -off * polynomial(tendon.stiffness, off) - speed * polynomial(tendon.damping, fabs(speed));
}

// The ends of a segment about the point of reference, and the direction from the second to the
// first, less by the divisor. Returns its length.
DEV real segment(const Model& M, const State& s, int p, real (*ends)[3], real* along) {
  const Part& part = M.part[p];
  place_of(s, M.part_on[p], part.at, ends[0]);
  place_of(s, M.part_off[p], part.gear, ends[1]);
  for (int k = 0; k < 3; k++) along[k] = ends[0][k] - ends[1][k];
  const real distance = root(dot(along, along)), share = part.gear[3];
  for (int k = 0; k < 3; k++) along[k] *= distance > 0 ? share / distance : real(0);
  return share * distance;
}

// Lengths and moments, and how they move by qvel and by qacc_warmstart.
DEV void place_cables(const Team& t, const Model& M, State& s) {
  LOOP for (int n = 0; n < NCABLE; n++) {
    Cable& cable = s.cables[n];
    real length = 0, row[ROWS_A_LANE] = {};
    const real none[3] = {};
    const auto pull = [&](int on, int off, const real* at, const real* force, const real* torque) {
      real moment[3];
      cross(moment, at, force);
      for (int k = 0; k < 3; k++) moment[k] += torque[k];
      const Mask moved = M.link_dofs[on] & ~M.link_dofs[off];
      UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
        const int i = t.lane + r * W;
        if (i >= NV || !(moved >> i & 1)) continue;
        const real* moves = s.cdof[i][0].x;
        row[r] += dot(moves, moment) + dot(moves + 3, force);
      }
    };
    LOOP for (int p = M.cable_part[n]; p < M.cable_part[n + 1]; p++) {
      const Part& part = M.part[p];
      const int kind = M.part_kind[p], on = M.part_on[p], off = M.part_off[p];
      real at[3], force[3], torque[3];
      if (kind == COEFFICIENT) {
        length += part.gear[1] * s.qpos[M.dof_qpos[on]];
        UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
          if (t.lane + r * W == on) row[r] += part.gear[0];
        continue;
      }
      if (kind == SEGMENT) {
        real ends[2][3];
        length += segment(M, s, p, ends, force);
        pull(on, NL, ends[0], force, none);
        for (int k = 0; k < 3; k++) force[k] = -force[k];
        pull(off, NL, ends[1], force, none);
        continue;
      }
      place_of(s, on, part.at, at);
      const Pose& frame = s.pose[M.part_frame[p]];
      frame.turn(force, part.gear);
      frame.turn(torque, part.gear + 3);
      if (kind == APART) length += dot(force, at);
      if (kind == TWIST || kind == ANGLE) {
        real turned[3];
        rotation_vector(turned, s.qpos + M.link_qpos[on]);
        if (kind == TWIST) {
          length += dot(turned, part.at);
        } else {
          length = root(dot(turned, turned));
          for (int k = 0; k < 3; k++) turned[k] /= length > 0 ? length : real(1);
          frame.turn(torque, turned);
        }
      }
      pull(on, off, at, force, torque);
    }
    real speed = 0, acceleration = 0;
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      if (i < NV) speed += row[r] * s.qvel[i], acceleration += row[r] * s.qacc_warmstart[i];
      if (i < 4 * QUADS) cable.moment[i / 4].x[i % 4] = row[r];
    }
    cable.length = length;
    cable.speed = t.sum(speed);
    cable.acceleration = t.sum(acceleration);
  }
  t.sync();
}

// Which limit of a row pushes: 0 the least length, 1 the most, -1 none.
DEV int near_side(const Model& M, const Cable& cable, int n) {
  const Limit& limit = M.bound[n];
  if (M.bound_sides[n] & 1 && cable.length - limit.range[0] < limit.margin) return 0;
  return M.bound_sides[n] & 2 && limit.range[1] - cable.length < limit.margin ? 1 : -1;
}
// Rows of limits and, behind them, of friction loss (of mj_instantiateLimit and
// mj_instantiateFriction).
DEV void bound_rows(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  LOOP for (int n = 0; n < NLIMITED + NLOSS; n++) {
    const int e = NE - NLIMITED - NLOSS + n;
    const Cable& cable = s.cables[M.bound_cable[n]];
    const Softness& soft = M.soft[M.bound_soft[n]];
    const Limit& limit = M.bound[n];
    const int side = n < NLIMITED ? near_side(M, cable, n) : 0;
    const real sign = side == 1 ? real(-1) : real(1);
    const real distance =
        n < NLIMITED ? sign * (cable.length - limit.range[side == 1]) - limit.margin : real(0);
    const real strength = impedance(soft, distance);
    EACH(q, QUADS)
      for (int k = 0; k < 4; k++) s.general[e][q].x[k] = sign * cable.moment[q].x[k];
    s.general_constraint_mass[e] = side >= 0 ? constraint_mass(strength, limit.weight) : real(0);
    s.general_residual[e] = sign * (cable.acceleration + soft.damping * cable.speed) +
                            soft.stiffness * strength * distance;
  }
}
// The force of a general row where its residual is the current one, and how stiff it is there.
DEV real general_force(const Model& M, const State& s, int e, real& stiffness) {
  stiffness = s.general_constraint_mass[e];
  const real residual = s.general_residual[e];
  if (e < NE - NLIMITED - NLOSS) return -stiffness * residual;
  if (e < NE - NLOSS) {
    if (residual >= 0) stiffness = 0;
    return -stiffness * residual;
  }
  const real most = M.bound_loss[e - (NE - NLOSS)], force = -stiffness * residual;
  if (fabs(force) >= most) stiffness = 0;
  return clip(force, -most, most);
}
// All that pulls along a cable: actuators, springs and dampers, rows.
DEV real whole_force(const Model& M, const State& s, int c) {
  const Cable& cable = s.cables[c];
  real sum = cable.force, stiffness;
  if (TENDON_FORCES) sum += tension(M.tendon[c], cable.length, cable.speed);
  for (int n = 0; n < NLIMITED + NLOSS; n++) {
    if (M.bound_cable[n] != c) continue;
    const real force = general_force(M, s, NE - NLIMITED - NLOSS + n, stiffness);
    sum += n < NLIMITED && near_side(M, cable, n) == 1 ? -force : force;
  }
  return sum;
}
// What this lane's limits and friction losses add to the derivative of the cost along a step.
DEV void bend_bounds(const Team& t, const Model& M, const State& s, real length, Bend& sum) {
  const int lane = t.lane;
  EACH(e, NE) {  // by the lane that has found how its residual changes
    const int n = e - (NE - NLIMITED - NLOSS);
    if (n < 0) continue;
    const real mass = s.general_constraint_mass[e];
    const real residual = s.general_residual[e], change = s.general_change[e];
    if (n < NLIMITED) {
      if (mass > 0) sum.add(mass, residual, change, length);
    } else {
      sum.add_bounded(mass, M.bound_loss[n - NLIMITED], residual, change, length);
    }
  }
}
// Adds to H and to the gradient what cables damp implicitly: where M may have an entry, as in
// mj_implicitSkip.
DEV void damp_cables(const Team& t, const Model& M, State& s, const real (&qacc)[ROWS_A_LANE],
                     real (&gradient)[ROWS_A_LANE], Rows& h) {
  UNROLL for (int r = 0; r < ROWS_A_LANE; r++)
    if (t.lane + r * W < NV) s.qacc_warmstart[t.lane + r * W] = qacc[r];
  t.sync();
  LOOP for (int n = 0; n < NCABLE; n++) {
    const Cable& cable = s.cables[n];
    UNROLL for (int r = 0; r < ROWS_A_LANE; r++) {
      const int i = t.lane + r * W;
      if (i >= NV) continue;
      const real weight = M.timestep * cable.drag * cable.moment[i / 4].x[i % 4];
      UNROLL for (int j = 0; j < NV; j++) {
        const Mask meet = M.link_dofs[M.dof_link[i]] >> j | M.link_dofs[M.dof_link[j]] >> i;
        if (!(meet & 1)) continue;
        const real entry = weight * cable.moment[j / 4].x[j % 4];
        h[r][j] += entry;
        gradient[r] += entry * s.qacc_warmstart[j];
      }
    }
  }
}

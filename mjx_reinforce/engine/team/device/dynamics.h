// The inertia matrix, and the forces without constraints.
#pragma once

// Sums along the tree, from the root on: a component of the sum of value[i] * by[i] over the dofs i
// that move a link, for each link. A lane has a component; the tree is written out, so that the
// sums stay in registers. value: 8 numbers a dof; out: `width` numbers a link.
DEV void along_tree(const real* value, const Quad* by, real* out, int width) {
  real sum[NV];
  UNROLL for (int i = 0; i < NV; i++) {
    const real before = dof_parent(i) < 0 ? real(0) : sum[dof_parent(i) < 0 ? 0 : dof_parent(i)];
    sum[i] = before + value[8 * i] * by[i / 4].x[i % 4];
    if (last_of_link(i) >= 0) out[last_of_link(i) * width] = sum[i];
  }
}

// The six components of a spatial vector, by all lanes.
DEV void along_tree_of(const Team& t, const real* entries, const Quad* by, real* out) {
  const int lane = t.lane;
  if (VECTORS) return along_tree_in_vectors(entries, by, out, 6);
  EACH(k, 6) along_tree(entries + k, by, out + k, 6);
}

// Adds the force of the actuators of a degree of freedom or, after all of these, of a cable, and
// how much they damp.
DEV void drive(const Model& M, const State& s, int target, real position, real velocity,
               real& force, real& drag) {
  LOOP for (int a = M.target_actuator[target]; a < M.target_actuator[target + 1]; a++) {
    const Actuator& p = M.actuator[a];
    const real length = p.gear * position, speed = p.gear * velocity;
    const real control = clip(s.ctrl[M.actuator_ctrl[a]], p.control_low, p.control_high);
    const real gain = p.gain + p.gain_by_length * length + p.gain_by_speed * speed;
    const real push =
        gain * control + p.bias + p.bias_by_length * length + p.bias_by_speed * speed;
    force += p.gear * clip(push, p.force_low, p.force_high);
    // A force at its bound does not change with the speed: it damps nothing.
    if (IMPLICIT == 2 && push > p.force_low && push < p.force_high)
      drag -= p.gear * p.gear * (p.bias_by_speed + p.gain_by_speed * control);
  }
}
// Forces of actuators, and how much they damp (mj_fwdActuation).
DEV void actuate(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  EACH(n, NCABLE) {
    Cable& cable = s.cables[n];
    real force = 0, drag = 0;
    if (TENDON_FORCES) drag = polynomial_rate(M.tendon[n].damping, fabs(cable.speed));
    drive(M, s, NV + n, cable.length, cable.speed, force, drag);
    cable.force = force;
    cable.drag = drag;
  }
  if (NCABLE) t.sync();
  EACH(i, NV) {
    real damping = M.dof_damping[i];
    if (JOINT_LAWS) damping += polynomial_rate(M.dof_law[i].damping, fabs(s.qvel[i]));
    real force = 0, drag = damping;
    drive(M, s, i, s.qpos[M.dof_qpos[i]], s.qvel[i], force, drag);
    for (int n = 0; n < NCABLE; n++)
      force += s.cables[n].moment[i / 4].x[i % 4] * s.cables[n].force;
    if (ACTUATOR_COMPENSATION && M.dof_actuator_compensation[i]) force += compensation(M, s, i);
    const Range range = M.dof_force[i];
    const bool bounded = IMPLICIT == 1 || force <= range.low || force >= range.high;
    if (IMPLICIT) s.drag[i] = bounded ? damping : drag;
    s.qfrc_actuator[i] = clip(force, range.low, range.high);
  }
}

// Velocities of links (mj_comVel), and the accelerations that qvel and x = qacc_warmstart bring
// (the way out of mj_rne).
DEV void motions(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  const Quad *qvel = reinterpret_cast<const Quad*>(s.qvel),
             *x = reinterpret_cast<const Quad*>(s.qacc_warmstart);
  along_tree_of(t, &s.cdof[0][0].x[0], qvel, s.velocity[0]);
  t.sync();
  EACH(i, NV) {
    real moves[6], change[6] = {};
    for (int k = 0; k < 6; k++) moves[k] = s.cdof[i][k / 4].x[k % 4];
    const real* velocity = s.velocity[M.dof_link[i]];
    if (M.dof_kind[i] != SHIFTS_IN_THE_WORLD) cross_motion(change, velocity, moves);
    s.terms[i][0] = {change[0], change[1], change[2], change[3]};
    s.terms[i][1] = {change[4], change[5], 0, 0};
  }
  t.sync();
  // The acceleration that qvel brings, into the force's place, and that of x.
  real(*by_velocity)[20] = reinterpret_cast<real(*)[20]>(&s.subtree[0][0].x[0]);
  if (VECTORS) {
    along_tree_in_vectors(&s.terms[0][0].x[0], qvel, &by_velocity[0][10], 20);
    along_tree_in_vectors(&s.cdof[0][0].x[0], x, s.motion[0], 6);
  }
  EACH(k, VECTORS ? 0 : 12) {
    const bool first = k < 6;
    const real* value = first ? &s.terms[0][0].x[0] + k : &s.cdof[0][0].x[0] + (k - 6);
    real* out = first ? &by_velocity[0][10 + k] : &s.motion[0][k - 6];
    along_tree(value, first ? qvel : x, out, first ? 20 : 6);
  }
  t.sync();
}

// Leaves M below the diagonal of s.rows (mj_crb), and M x - qfrc_smooth in s.imbalance (the way
// back of mj_rne, mj_passive), where x is qacc_warmstart: the force that x takes is found with that
// of qvel, without a product of M.
DEV void forces_and_inertia(const Team& t, const Model& M, State& s) {
  const int lane = t.lane;
  real(*whole)[20] = reinterpret_cast<real(*)[20]>(&s.subtree[0][0].x[0]);
  EACH(l, NL) {
    real v[6], a[6], inertia[10], force[6], momentum[6];
    for (int k = 0; k < 10; k++) inertia[k] = s.subtree[l][k / 4].x[k % 4];
    for (int k = 0; k < 6; k++) v[k] = s.velocity[l][k], a[k] = whole[l][10 + k] + s.motion[l][k];
    for (int k = 0; k < 3; k++) a[3 + k] -= M.gravity[k];
    inertia_times(force, inertia, a);
    inertia_times(momentum, inertia, v);
    cross_force(a, v, momentum);
    if (MEDIUM) subtract_medium(M, s, l, a);
    for (int k = 0; k < 6; k++) whole[l][10 + k] = force[k] + a[k];
  }
  t.sync();
  // From the leaves to the root: each link's inertia and force become those of its subtree. A lane
  // has one of their 16 numbers, and the tree is written out.
  for (int l = NL - 1; VECTORS && l > 0; l--)
    for (int k = 0; k < 16 && link_parent(l) >= 0; k++) whole[link_parent(l)][k] += whole[l][k];
  EACH(k, VECTORS ? 0 : 16) {
    real sum[NL];
    UNROLL for (int l = 0; l < NL; l++) sum[l] = whole[l][k];
    UNROLL for (int l = NL - 1; l > 0; l--)
      if (link_parent(l) >= 0) sum[link_parent(l) < 0 ? 0 : link_parent(l)] += sum[l];
    UNROLL for (int l = 0; l < NL; l++)
      if (has_children(l)) whole[l][k] = sum[l];
  }
  t.sync();
  // The diagonal waits in registers: s.rows lies where the subtrees are, which are still read.
  real diagonal[(NV + W - 1) / W];
  UNROLL for (int n = 0; n < (NV + W - 1) / W; n++) {
    const int i = lane + n * W;
    if (i >= NV) continue;
    const Quad* c = s.subtree[M.dof_link[i]];
    real inertia[10], moves[6], force[6], f[6];
    for (int k = 0; k < 10; k++) inertia[k] = c[k / 4].x[k % 4];
    for (int k = 0; k < 6; k++) {
      moves[k] = s.cdof[i][k / 4].x[k % 4];
      force[k] = c[(10 + k) / 4].x[(10 + k) % 4];
    }
    inertia_times(f, inertia, moves);
    s.terms[i][0] = {f[0], f[1], f[2], f[3]};
    s.terms[i][1] = {f[4], f[5], 0, 0};
    const real armature = M.dof_armature[i];
    diagonal[n] = dot6(f, moves) + armature;
    real imbalance =
        dot6(force, moves) + armature * s.qacc_warmstart[i] + M.dof_damping[i] * s.qvel[i];
    imbalance += M.dof_stiffness[i] * (s.qpos[M.dof_qpos[i]] - M.dof_spring[i]);
    if (PASSIVE) imbalance += s.imbalance[i];
    s.imbalance[i] = imbalance - s.qfrc_actuator[i];
  }
  t.sync();
  EACH(n, SIDE * QUADS) (&s.rows[0][0])[n] = {0, 0, 0, 0};
  t.sync();
  real* rows = &s.rows[0][0].x[0];
  UNROLL for (int n = 0; n < (NV + W - 1) / W; n++) {
    const int i = lane + n * W;
    if (i < NV) rows[i * (STRIDE + 1)] = diagonal[n];
  }
  if (NV % 2 && lane == 0) rows[NV * (STRIDE + 1)] = 1;
  EACH(n, NPAIRED) {  // an entry below the diagonal that is not zero
    const int i = M.paired[n].high(), j = M.paired[n].low();
    const Quad a = s.terms[i][0], b = s.cdof[j][0], c = s.terms[i][1], d = s.cdof[j][1];
    rows[i * STRIDE + j] = a.x[0] * b.x[0] + a.x[1] * b.x[1] + a.x[2] * b.x[2] +
                           (a.x[3] * b.x[3] + c.x[0] * d.x[0] + c.x[1] * d.x[1]);
  }
  t.sync();
}

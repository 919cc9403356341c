// What a team has of its episode, in shared memory on a GPU. What is needed at different times of a
// step shares its place, in the three unions of State:
//
//   phase               rows | subtree | reports     contacts | terms     columns | geom_*
//   place_inertias      subtree: inertias            .                    .
//   place_geoms         |                            .                    geom_place, geom_axis
//   motions             subtree: + accelerations     terms: of cdof       |
//   general_rows        | (reads accelerations)      .                    |
//   forces_and_inertia  subtree: + forces; then      terms: inertia       |
//                       rows: M                        times cdof         |
//   collide             |                            contacts             | (reads geoms)
//   newton              rows: M, elimination         |                    columns: of J, of H
//   report              xpos to cfrc_ext             | (reads contacts)   .
//
// A bar is what stays from above, a point is a place that nothing needs. A task reads the reports
// until the next step begins.
#pragma once

DEV constexpr int padded(int n) { return n < 1 ? 4 : (n + 3) / 4 * 4; }
// H has an even number of rows, a row of ones on the diagonal is added; the right side is one more.
constexpr int SIDE = NV + NV % 2;
constexpr int ROWS_A_LANE = (SIDE + W) / W;
// H and, as its row SIDE, the right side: h[r] is row lane + r W. As H is symmetric, entries before
// column r W are not used: they are those of rows before, which have the right side as column SIDE.
constexpr int ROW_SIZE = VECTORS ? (SIDE + 7) / 8 * 8 : SIDE + (ROWS_A_LANE > 1);
typedef real Rows[ROWS_A_LANE][ROW_SIZE];
DEV constexpr bool uses_column(int r, int j) {
  return j >= r * W && j < SIDE + (r < ROWS_A_LANE - 1);
}
// Quads of so many numbers: odd, so that lanes that read one row each meet no bank twice.
DEV constexpr int quads(int numbers) { return ((numbers + 3) / 4) | 1; }
// Of a row, in which the right side has a place only where a lane has one row.
constexpr int QUADS = quads(SIDE + (ROWS_A_LANE == 1));
constexpr int STRIDE = 4 * QUADS;
// Contacts that the state has no room for.
constexpr int FAR = NC > NEAR ? NC - NEAR : 0;

// What a task may read after a step; the program that plays it says what it reads.
// SEEN_ is of its last forward pass.
enum Report {
  XPOS = 1, XIPOS = 2, CINERT = 4, CVEL = 8, CFRC_EXT = 16,
  PASS_QPOS = 32, PASS_QVEL = 64, PASS_QACC = 128, TOUCH = 256
};
#ifndef REPORTS
#define REPORTS 511
#endif
DEV constexpr bool reports(int fields) { return (REPORTS) & fields; }
// The numbers of all bodies, if one of the fields is reported.
DEV constexpr int room(int fields, int numbers) { return reports(fields) ? numbers * NB : 1; }

// A contact's rows are those of an elliptic cone, or the edges n + mu t and n - mu t of a pyramid;
// here they are in the basis of the normal, the tangents and, from condim 4 on, turning about
// these.
constexpr int COUPLING = 2 * CD - 2 + ELLIPTIC;
// A contact has friction of its own where episodes draw it.
struct Contact : Some<Friction, DRAWS_FRICTION> {
  real at[3];               // from the point of reference (m)
  real frame[9];            // normal, two tangents
  real residual[CD];        // J qacc - reference
  real change[CD];          // J direction
  real force[CD];           // of the rows that push
  // Of the same: normal, each tangent with the normal, with itself; of a cone also the coupling.
  real stiffness[2 * CD - 1 + ELLIPTIC];
  real constraint_mass;     // MuJoCo's D, of the normal
  int item;
};

// A cable of cables.h: what it pulls at, how long it is, and how that changes by qvel and by
// qacc_warmstart; the force of its actuators, and how much it damps implicitly.
struct Cable {
  Quad moment[QUADS];
  real length, speed, acceleration, force, drag;
};

// Before all else it has the tables that an episode draws, if any (draws.py).
struct alignas(4 * sizeof(real)) State : Drawn {
  real qpos[padded(NQ)], qvel[padded(NV)], qacc_warmstart[padded(NV)];
  real qfrc_actuator[padded(NV)], ctrl[padded(NU)], act[1], time[1];
  Quad cdof[NV][2];
  Pose pose[NL + 1 + NMOCAP];  // of links, then of the world, then of mocap bodies
  Quad direction[QUADS];    // of a Newton step
  real velocity[NL + 1 + NMOCAP][6];  // of these, by qvel
  real motion[NL + 1 + NMOCAP][6];    // of these, by an acceleration or by a step of it
  real imbalance[NV];       // M qacc - qfrc_smooth
  real drag[IMPLICIT ? NV : 1];  // what damps implicitly
  real start_qpos[RK4 ? NQ : 1], start_qvel[RK4 ? NV : 1];
  real sum_qvel[RK4 ? NV : 1], sum_qacc[RK4 ? NV : 1], turning[RK4 && NTURN ? 3 * NTURN : 1];
  Some<Quad[QUADS], NE> general;  // J of rows of no contact and no single dof
  Some<real, NE> general_residual, general_change, general_constraint_mass;
  Some<Cable, NCABLE> cables;
  Some<Quad[QUADS], NOSLIP ? SIDE : 0> inverse;  // of M
  Some<real, NOSLIP && LOSSES ? NV : 0> loss_force;
  union {
    Quad rows[SIDE][QUADS];  // below the diagonal M, above it what eliminates
    Quad subtree[NL][5];     // inertia [10], force [6]
    struct {
      real xpos[room(XPOS, 3)], xipos[room(XIPOS | CINERT | CVEL | CFRC_EXT, 3)];
      real cinert[room(CINERT, 10)], cvel[room(CVEL, 6)], cfrc_ext[room(CFRC_EXT, 6)];
      real pass_qpos[reports(PASS_QPOS) ? NQ : 1], pass_qvel[reports(PASS_QVEL) ? NV : 1];
      real pass_qacc[reports(PASS_QACC) ? NV : 1], touch[reports(TOUCH) && NTOUCH ? NTOUCH : 1];
    };
  };
  union {
    Contact contacts[NEAR];
    Quad terms[NV][2];
  };
  union {
    Quad columns[2][CD < 2 ? 2 : CD][quads(SIDE + 1)];
    struct { Quad geom_place[NG]; Quad geom_axis[NG]; };
  };
  Contact guest;        // a far contact that is everybody's for a moment
  Contact* far;         // [FAR], in memory that the launcher gives
  int num_contacts;
  int queue[2 * W];
  Some<int, CONVEX_CONTACTS ? 2 * W : 0> meeting;  // another queue
};

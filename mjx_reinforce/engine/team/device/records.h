// The rows of a model's tables that have several numbers. `engine.team.tables` writes the rows, and
// has the compiler check that both have the same fields in the same order.
#pragma once

// A part of a pair of geoms that makes one contact at most: an end of a capsule, a corner of a box.
// The geoms are numbered among those that may meet. With WHOLE_PAIRS an item is all of a pair.
struct Item {
  int packed;  // 12 bits of a geom, 12 bits of the other one, the part's number or the last one's
  DEV constexpr int first() const { return packed & 0xfff; }
  DEV constexpr int second() const { return packed >> 12 & 0xfff; }
  DEV constexpr int part() const { return packed >> 24 & 7; }
};
// Two numbers of 16 bits.
struct Pair {
  int packed;
  DEV constexpr int low() const { return packed & 0xffff; }
  DEV constexpr int high() const { return packed >> 16; }
};

// How hard a constraint row pushes back (MuJoCo's solref and solimp).
struct Softness {
  real stiffness, damping;    // MuJoCo's K and B
  real least, rise;           // the impedance where a row begins, and by how much it grows
  real width, middle, power;  // the way in which it grows (m or rad)
};
// What an actuator pushes with: gear * clip(gain * control + bias), where gain and bias are affine
// in its length and speed.
struct Actuator {
  real gear, control_low, control_high;
  real gain;
  real bias, bias_by_length, bias_by_speed;
  real force_low, force_high;
  real gain_by_length, gain_by_speed;
};
// The limits of a joint, from where on they push, and the inverse mass of a row.
struct Limit { real range[2], margin, weight; };
// The most that friction loss pushes, and the inverse mass of its row.
struct Loss { real most, weight; };
struct Range { real low, high; };
// A part of a cable: a place, and a force and a torque; see cables.py.
struct Part { real at[3], gear[6]; };
// The polynomials of a tendon's spring and damper, and the lengths between which it is slack.
struct Tendon { real stiffness[3], damping[3], rest[2]; };
// The same of a degree of freedom.
struct Law { real stiffness[3], damping[3]; };
// What a medium does to a body: its center, its axes of inertia, and the forces and torques along
// these by the speed and by its square.
struct FluidBody {
  real at[3], axes[9], viscous_torque, viscous_force, drag_torque[3], drag_force[3];
};
// What gravity compensation holds of a link: the mass times its place in the link's frame, the
// mass.
struct Compensation { real moment[3], mass; };
// Along the two tangents, about the normal, about the two tangents.
struct Friction { real along[5]; };
// A box around a geom, in the geom's frame.
struct GeomBox { real center[3], half[3]; };

// The hull of a mesh, in memory that all teams read (hulls.py). What has no room in a struct is a
// list from its place in hull_neighbor, hull_faces_of or hull_corner on; the first two end with -1.
// These number vertices and faces across all hulls.
struct alignas(16) HullVertex {
  float at[3];            // in the frame of the mesh, which MuJoCo has in float32, too (m)
  int neighbors;          // of hull_neighbor, in MuJoCo's order
  int faces;              // of hull_faces_of
};
struct HullFace {
  real normal[3];
  int corners, count;     // of hull_corner, in order around the face, and how many
};
struct Hull {
  int first, searched;    // a vertex; how many from there on are looked at one by one, or 0
  int seeds[27];          // vertices to climb from, by directions (MuJoCo's mesh_extrema)
};

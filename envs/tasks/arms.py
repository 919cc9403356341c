"""Two arms: Reacher brings its fingertip to a target, Pusher pushes a cylinder to a goal."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv

_GOAL_RADIUS = 0.2
_POSITION_NOISE = 0.1
_VELOCITY_NOISE = 0.005
# The cylinder starts in [-_DEPTH, 0] x [-_HALF_WIDTH, _HALF_WIDTH], farther than _CLEAR from the
# goal at the origin.
_DEPTH = 0.3
_HALF_WIDTH = 0.2
_CLEARANCE = 0.17


class Reacher(MujocoEnv):
    """Gymnasium's Reacher (gymnasium/envs/mujoco/reacher_v5.py).

    Observation, O = 10: cosines of the two joint angles; their sines; target position x, y (m);
    the joints' angular velocities (rad/s); fingertip minus target, x, y (m). Action, A = 2:
    torques in [-1, 1], times a gear of 200 (N m).

    Reward: minus the distance from fingertip to target (m), minus the sum of the squared actions.
    Start: angles uniform within 0.1 rad, angular velocities within 0.005 rad/s; the target
    uniform on the disc of 0.2 m, at rest. Never terminates. Solved at a return of -3.75; at most
    50 steps of 0.02 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Reacher."""

        xml_file: str = "reacher.xml"
        """The model, with bodies "fingertip" and "target"."""
        frame_skip: int = 2
        max_episode_steps: int = 50
        reward_threshold: float | None = -3.75
        reward_dist_weight: float = 1.0
        """What 1 m of distance costs."""
        reward_control_weight: float = 1.0
        """What one unit of squared action costs; Gymnasium's page says 0.1, its code has 1."""

    settings: Settings

    def initial(self, rng):
        """Draws qpos [4] and qvel [4]; the target in polar coordinates, without rejection."""
        angle_key, target_key, qvel_key = jax.random.split(rng, 3)
        noise = jax.random.uniform(angle_key, (2,), minval=-_POSITION_NOISE, maxval=_POSITION_NOISE)
        # The area within a radius grows as its square, so the root of a uniform number is uniform
        # on the disc. Gymnasium draws points of the square until one is in it.
        area_share, turns = jax.random.uniform(target_key, (2,))
        radius = _GOAL_RADIUS * jnp.sqrt(area_share)
        angle = 2 * jnp.pi * turns
        qvel = jax.random.uniform(qvel_key, (2,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        angles = jnp.asarray(self.mj_model.qpos0[:2], noise.dtype) + noise
        target = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return jnp.concatenate([angles, target]), jnp.concatenate([qvel, jnp.zeros(2)])

    def observe(self, data):
        """Returns the observation [10]."""
        # qpos[2:] is the target's position: it moves on two joints, which no motor drives.
        angles = data.qpos[:2]
        target_offset = self._away(data)[:2]
        return jnp.concatenate(
            [jnp.cos(angles), jnp.sin(angles), data.qpos[2:], data.qvel[:2], target_offset]
        )

    def outcome(self, before, data, action):
        """Returns the penalties for distance and control; never terminates."""
        terms = {
            "reward_dist": -self.settings.reward_dist_weight * jnp.linalg.norm(self._away(data)),
            "reward_ctrl": -self.settings.reward_control_weight * jnp.sum(action**2),
        }
        return sum(terms.values()), jnp.zeros((), bool), terms

    def _away(self, data):
        """Returns fingertip minus target [3] (m).

        Both positions are those of the last Runge-Kutta stage, as in Gymnasium, not those of the
        new qpos.
        """
        return data.body("fingertip").xpos - data.body("target").xpos


class Pusher(MujocoEnv):
    """Gymnasium's Pusher (gymnasium/envs/mujoco/pusher_v5.py).

    Observation, O = 23: the arm's joint angles, shoulder to wrist (7, rad); their angular
    velocities (7, rad/s); positions of the arm's tip, the cylinder and the goal (3 each, m).
    Action, A = 7: torques on the arm's joints in [-2, 2] (N m).

    Reward: minus half the distance from cylinder to tip, minus the distance from cylinder to
    goal (m), minus 0.1 times the sum of the squared actions. Start: the arm at zero, its
    velocities uniform within 0.005 rad/s; the cylinder uniform in a rectangle of 0.3 m x 0.4 m
    without the half-disc of 0.17 m around the goal, both at rest. Never terminates. The threshold
    of 0 is out of reach; at most 100 steps of 0.05 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Pusher."""

        xml_file: str = "pusher_v5.xml"
        """The model, with bodies "tips_arm", "object" and "goal"."""
        frame_skip: int = 5
        max_episode_steps: int = 100
        reward_threshold: float | None = 0.0
        reward_near_weight: float = 0.5
        """What 1 m between tip and cylinder costs."""
        reward_dist_weight: float = 1.0
        """What 1 m between cylinder and goal costs."""
        reward_control_weight: float = 0.1
        """What one unit of squared action costs."""

    settings: Settings

    def initial(self, rng):
        """Draws qpos [11] and qvel [11]."""
        cylinder_key, qvel_key = jax.random.split(rng)
        cylinder = _cylinder(cylinder_key)
        qvel = jax.random.uniform(qvel_key, (7,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        # Of 11 joints seven are the arm's; then come the cylinder's two and the goal's two.
        arm = jnp.asarray(self.mj_model.qpos0[:7], qvel.dtype)
        return (
            jnp.concatenate([arm, cylinder, jnp.zeros(2)]),
            jnp.concatenate([qvel, jnp.zeros(4)]),
        )

    def observe(self, data):
        """Returns the observation [23].

        The bodies' positions are those at which the last physics step began, as in Gymnasium.
        """
        bodies = (data.body(name).xpos for name in ("tips_arm", "object", "goal"))
        return jnp.concatenate([data.qpos[:7], data.qvel[:7], *bodies])

    def outcome(self, before, data, action):
        """Returns the penalties for distances and control; never terminates."""
        # All at the last forward pass, as in Gymnasium, not at the new qpos.
        cylinder = data.body("object").xpos
        tip_offset = cylinder - data.body("tips_arm").xpos
        dist = cylinder - data.body("goal").xpos
        weights = self.settings
        terms = {
            "reward_dist": -weights.reward_dist_weight * jnp.linalg.norm(dist),
            "reward_ctrl": -weights.reward_control_weight * jnp.sum(action**2),
            "reward_near": -weights.reward_near_weight * jnp.linalg.norm(tip_offset),
        }
        return sum(terms.values()), jnp.zeros((), bool), terms


def _cylinder(key):
    """Draws the cylinder's start [2], uniform in the rectangle outside the disc.

    Gymnasium draws again until the point is outside; here the distribution function of the depth is
    inverted, which takes the same time for every draw. The area nearer than depth d is convex in d,
    so that Newton's method from the greatest depth approaches the root from one side; after twelve
    steps it has converged to rounding error.
    """
    depth_share, side = jax.random.uniform(key, (2,))
    side = 2 * side - 1

    def edge(depth):
        """Returns half the width of the disc at a depth."""
        return jnp.sqrt(jnp.maximum(_CLEARANCE**2 - depth**2, 0))

    def area(depth):
        # Half of it, to one side: the rectangle nearer than ``depth`` less its part of the disc.
        disc_depth = jnp.minimum(depth, _CLEARANCE)
        disc = _CLEARANCE**2 * jnp.arcsin(disc_depth / _CLEARANCE) + disc_depth * edge(disc_depth)
        return _HALF_WIDTH * depth - disc / 2

    # The derivative of the area is how wide the free strip is at that depth.
    target_area = depth_share * area(jnp.full_like(side, _DEPTH))
    depth = jnp.full_like(side, _DEPTH)
    for _ in range(12):
        depth = depth - (area(depth) - target_area) / (_HALF_WIDTH - edge(depth))
    # Uniform in the free strip beside the disc (m); the sign of ``side`` picks the left or right
    # one.
    lateral_distance = edge(depth) + jnp.abs(side) * (_HALF_WIDTH - edge(depth))
    return jnp.stack([-depth, jnp.copysign(lateral_distance, side)])

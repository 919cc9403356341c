"""Pusher: a seven-joint arm pushes a cylinder over a table to a goal."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv

_VELOCITY_NOISE = 0.005
# The cylinder starts in [-_DEPTH, 0] x [-_HALF_WIDTH, _HALF_WIDTH], farther than _CLEAR from the
# goal at the origin.
_DEPTH, _HALF_WIDTH, _CLEAR = 0.3, 0.2, 0.17


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

    def __init__(self, **arguments: Any):
        """Builds the task; see ``MujocoEnv``."""
        super().__init__(**arguments)
        self._tip = self.mj_model.body("tips_arm").id
        self._object = self.mj_model.body("object").id
        self._goal = self.mj_model.body("goal").id

    def initial(self, rng):
        """Draws qpos [11] and qvel [11]."""
        cylinder_key, qvel_key = jax.random.split(rng)
        cylinder = _cylinder(cylinder_key)
        qvel = jax.random.uniform(qvel_key, (7,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        arm = jnp.asarray(self.mj_model.qpos0[:7], qvel.dtype)
        return (
            jnp.concatenate([arm, cylinder, jnp.zeros(2)]),
            jnp.concatenate([qvel, jnp.zeros(4)]),
        )

    def observe(self, data):
        """Returns the observation [23].

        The bodies' positions are those at which the last physics step began, as in Gymnasium.
        """
        bodies = (data.xpos[i] for i in (self._tip, self._object, self._goal))
        return jnp.concatenate([data.qpos[:7], data.qvel[:7], *bodies])

    def outcome(self, before, data, action):
        """Returns the penalties for distances and control; never terminates."""
        near = data.xpos[self._object] - data.xpos[self._tip]
        dist = data.xpos[self._object] - data.xpos[self._goal]
        weights = self.settings
        terms = {
            "reward_dist": -weights.reward_dist_weight * jnp.linalg.norm(dist),
            "reward_ctrl": -weights.reward_control_weight * jnp.sum(action**2),
            "reward_near": -weights.reward_near_weight * jnp.linalg.norm(near),
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

    def edge(depth):  # of the disc, across
        return jnp.sqrt(jnp.maximum(_CLEAR**2 - depth**2, 0))

    def area(depth):
        inside = jnp.minimum(depth, _CLEAR)
        disc = _CLEAR**2 * jnp.arcsin(inside / _CLEAR) + inside * edge(inside)
        return _HALF_WIDTH * depth - disc / 2

    wanted = depth_share * area(jnp.full_like(side, _DEPTH))
    depth = jnp.full_like(side, _DEPTH)
    for _ in range(12):
        depth = depth - (area(depth) - wanted) / (_HALF_WIDTH - edge(depth))
    across = edge(depth) + jnp.abs(side) * (_HALF_WIDTH - edge(depth))
    return jnp.stack([-depth, jnp.copysign(across, side)])

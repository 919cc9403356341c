"""Reacher: bring the fingertip of a two-joint arm to a target in the plane."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv

_GOAL_RADIUS = 0.2
_POSITION_NOISE = 0.1
_VELOCITY_NOISE = 0.005


class Reacher(MujocoEnv):
    """Gymnasium's Reacher (gymnasium/envs/mujoco/reacher_v5.py).

    Observation, O = 10: cosines of the two joint angles; their sines; target position x, y (m);
    the joints' angular velocities (rad/s); fingertip less target, x, y (m). Action, A = 2:
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

    def __init__(self, **arguments: Any):
        """Builds the task; see ``MujocoEnv``."""
        super().__init__(**arguments)
        self._fingertip = self.mj_model.body("fingertip").id
        self._target = self.mj_model.body("target").id

    def initial(self, rng):
        """Draws qpos [4] and qvel [4]; the target in polar coordinates, without rejection."""
        angle_key, target_key, qvel_key = jax.random.split(rng, 3)
        noise = jax.random.uniform(angle_key, (2,), minval=-_POSITION_NOISE, maxval=_POSITION_NOISE)
        area, turn = jax.random.uniform(target_key, (2,))
        radius, turn = _GOAL_RADIUS * jnp.sqrt(area), 2 * jnp.pi * turn
        qvel = jax.random.uniform(qvel_key, (2,), minval=-_VELOCITY_NOISE, maxval=_VELOCITY_NOISE)
        angles = jnp.asarray(self.mj_model.qpos0[:2], noise.dtype) + noise
        target = radius * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
        return jnp.concatenate([angles, target]), jnp.concatenate([qvel, jnp.zeros(2)])

    def observe(self, data):
        """Returns the observation [10]."""
        angles = data.qpos[:2]
        away = self._away(data)[:2]
        return jnp.concatenate(
            [jnp.cos(angles), jnp.sin(angles), data.qpos[2:], data.qvel[:2], away]
        )

    def outcome(self, before, data, action):
        """Returns the penalties for distance and control; never terminates."""
        terms = {
            "reward_dist": -self.settings.reward_dist_weight * jnp.linalg.norm(self._away(data)),
            "reward_ctrl": -self.settings.reward_control_weight * jnp.sum(action**2),
        }
        return sum(terms.values()), jnp.zeros((), bool), terms

    def _away(self, data):
        """Returns fingertip less target [3] (m).

        Both positions are those of the last Runge-Kutta stage, as in Gymnasium, not those of the
        new qpos.
        """
        return data.xpos[self._fingertip] - data.xpos[self._target]

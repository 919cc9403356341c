"""Reacher: bring the fingertip of a two-joint arm to a target in the plane."""

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

    def __init__(
        self,
        *,
        xml_file: str = "reacher.xml",
        frame_skip: int = 2,
        reward_dist_weight: float = 1.0,
        reward_control_weight: float = 1.0,
        solver: str = "exact",
    ):
        """Builds the task.

        Args:
          xml_file: the model, with bodies "fingertip" and "target".
          frame_skip: physics steps of 0.01 s an env step.
          reward_dist_weight: what 1 m of distance costs.
          reward_control_weight: what one unit of squared action costs; Gymnasium's page says 0.1
            where its code has 1.
          solver: "exact", "mjx" or "fast", see ``MujocoEnv``.
        """
        super().__init__(
            xml_file=xml_file,
            frame_skip=frame_skip,
            max_episode_steps=50,
            reward_threshold=-3.75,
            solver=solver,
        )
        self._fingertip = self.mj_model.body("fingertip").id
        self._target = self.mj_model.body("target").id
        self._dist_weight = reward_dist_weight
        self._control_weight = reward_control_weight

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
            "reward_dist": -self._dist_weight * jnp.linalg.norm(self._away(data)),
            "reward_ctrl": -self._control_weight * jnp.sum(action**2),
        }
        return sum(terms.values()), jnp.zeros((), bool), terms

    def _away(self, data):
        """Returns fingertip less target [3], in the last stage of Runge-Kutta, not at qpos."""
        return data.xpos[self._fingertip] - data.xpos[self._target]

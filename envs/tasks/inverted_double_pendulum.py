"""InvertedDoublePendulum: keep two poles, one on the other, upright on a cart."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv


class InvertedDoublePendulum(MujocoEnv):
    """Gymnasium's InvertedDoublePendulum (gymnasium/envs/mujoco/inverted_double_pendulum_v5.py).

    Observation, O = 9: cart position (m); sine of the lower pole's angle and of the upper's
    against the lower; their cosines; cart velocity (m/s) and the two angular velocities (rad/s),
    clipped to 10; constraint force on the cart (N), clipped to 10, not zero where it pushes
    against the end of the rail. Action, A = 1: force on the cart in [-1, 1], times a gear of
    500 (N).

    Reward: 10 each step the tip stays up, less 0.01 x^2 + (y - 2)^2 for the tip's position x, y
    (m) and 1e-3 v1^2 + 5e-3 v2^2 for the angular velocities. Start: positions uniform within
    ``reset_noise_scale``, velocities normal with that standard deviation. Terminates when the
    tip is at 1 m or lower, of 1.2 m. Solved at a return of 9100; at most 1000 steps of 0.05 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of InvertedDoublePendulum."""

        xml_file: str = "inverted_double_pendulum.xml"
        """The model; its first site is the tip."""
        frame_skip: int = 5
        max_episode_steps: int = 1000
        reward_threshold: float | None = 9100.0
        healthy_reward: float = 10.0
        """The reward of a step that does not end the episode."""
        reset_noise_scale: float = 0.1
        """Half the width of the start positions (m, rad) and the standard deviation of the start
        velocities (m/s, rad/s)."""

    settings: Settings

    def initial(self, rng):
        """Draws qpos [3] uniformly and qvel [3] normally around upright rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        noise = self.settings.reset_noise_scale
        qpos = jax.random.uniform(qpos_key, (3,), minval=-noise, maxval=noise)
        qvel = noise * jax.random.normal(qvel_key, (3,))
        return jnp.asarray(self.mj_model.qpos0, qpos.dtype) + qpos, qvel

    def observe(self, data):
        """Returns the observation [9]."""
        angles = data.qpos[1:]
        rates = jnp.clip(data.qvel, -10, 10)
        force = jnp.clip(data.qfrc_constraint[:1], -10, 10)
        return jnp.concatenate([data.qpos[:1], jnp.sin(angles), jnp.cos(angles), rates, force])

    def outcome(self, before, data, action):
        """Returns the bonus less the penalties, and whether the tip is down.

        The tip's position is that of the last Runge-Kutta stage, as in Gymnasium, not that of the
        new qpos.
        """
        x, _, y = data.site_xpos[0]
        terminated = y <= 1
        terms = {
            "reward_survive": self.settings.healthy_reward * ~terminated,
            "distance_penalty": -(0.01 * x**2 + (y - 2) ** 2),
            "velocity_penalty": -(1e-3 * data.qvel[1] ** 2 + 5e-3 * data.qvel[2] ** 2),
        }
        return sum(terms.values()), terminated, terms

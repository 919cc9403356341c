"""InvertedPendulum: keep a pole upright on a cart that runs on a rail."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv

_MAX_ANGLE = 0.2


class InvertedPendulum(MujocoEnv):
    """Gymnasium's InvertedPendulum (gymnasium/envs/mujoco/inverted_pendulum_v5.py).

    Observation, O = 4: cart position (m), pole angle (rad), cart velocity (m/s),
    pole angular velocity (rad/s). Action, A = 1: force on the cart in [-3, 3],
    times a gear of 100 (N).

    Reward: 1 each step the pole stays up. The step on which it falls earns 0 in
    v5 and 1 in v4. Start: every position and velocity uniform within
    ``reset_noise_scale``. Terminates when the angle leaves [-0.2, 0.2] rad or the
    observation is not finite. Solved at a return of 950; at most 1000 steps of
    0.04 s.
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of InvertedPendulum."""

        xml_file: str = "inverted_pendulum.xml"
        frame_skip: int = 2
        max_episode_steps: int = 1000
        reward_threshold: float | None = 950.0
        reset_noise_scale: float = 0.01
        """Half the width of the start distribution (m, rad, m/s, rad/s)."""
        reward_at_fall: float = 0.0
        """The reward of the step that ends the episode: 0 is v5, 1 is v4."""

    settings: Settings

    def initial(self, rng):
        """Draws qpos [2] and qvel [2] uniformly within the noise scale of upright rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        noise = self.settings.reset_noise_scale
        qpos = jax.random.uniform(qpos_key, (2,), minval=-noise, maxval=noise)
        qvel = jax.random.uniform(qvel_key, (2,), minval=-noise, maxval=noise)
        return jnp.asarray(self.mj_model.qpos0, qpos.dtype) + qpos, qvel

    def outcome(self, before, data, action):
        """Returns 1 while the pole is up, and whether it fell."""
        finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        terminated = ~finite | (jnp.abs(data.qpos[1]) > _MAX_ANGLE)
        reward = jnp.where(terminated, self.settings.reward_at_fall, 1.0)
        return reward, terminated, {"reward_survive": reward}

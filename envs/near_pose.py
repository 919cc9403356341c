"""What tasks share whose episodes start near the pose of their model."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.checks import check_number
from mjx_reinforce.envs.base import MujocoEnv


class NearPose(MujocoEnv):
    """A task that starts near its model's pose."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of these tasks."""

        max_episode_steps: int = 1000
        reset_noise_scale: float
        """Half the width of the start distribution where it is uniform, its standard deviation
        where it is normal (m, rad, m/s, rad/s)."""

        def __post_init__(self):
            """Raises ValueError for a value that is out of its range."""
            super().__post_init__()
            check_number("reset_noise_scale", self.reset_noise_scale)

    settings: Settings
    #: Whether the starting velocities are normal; otherwise they are uniform.
    normal_velocity = False

    def initial(self, rng):
        """Draws qpos [nq] around the model's pose and qvel [nv] around rest."""
        qpos_key, qvel_key = jax.random.split(rng)
        model = self.mj_model
        noise = self.settings.reset_noise_scale
        qpos = jax.random.uniform(qpos_key, (model.nq,), minval=-noise, maxval=noise)
        if self.normal_velocity:
            qvel = noise * jax.random.normal(qvel_key, (model.nv,))
        else:
            qvel = jax.random.uniform(qvel_key, (model.nv,), minval=-noise, maxval=noise)
        return jnp.asarray(model.qpos0, qpos.dtype) + qpos, qvel

"""A task on MuJoCo that does everything right; tests change one thing."""

import dataclasses

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv


class Pole(MujocoEnv):
    """The cart and pole, from anywhere."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Pole."""

        xml_file: str = "inverted_pendulum.xml"
        frame_skip: int = 1
        max_episode_steps: int = 5
        reward_threshold: float | None = None
        solver: str = "mjx"

    def initial(self, rng):
        return jax.random.uniform(rng, (2,)), jnp.zeros(2)

    def outcome(self, before, data, action):
        return data.qpos[0], False, {}

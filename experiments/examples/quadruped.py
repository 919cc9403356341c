"""A quadruped of position servos with box feet that learns to walk; its MJCF in quadruped.xml.

In this folder:

    python -m mjx_reinforce.train --env quadruped:Quadruped --output quadruped
"""

from pathlib import Path

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv


class Quadruped(MujocoEnv):
    """Walk forward, 50 actions a second: the angles (rad) that the servos are to reach."""

    def __init__(self):
        xml = str(Path(__file__).with_name("quadruped.xml"))
        super().__init__(xml_file=xml, frame_skip=5, max_episode_steps=500, reward_threshold=None)

    def initial(self, rng):
        """Stands, each joint up to 0.1 rad from there, at rest."""
        noise = jax.random.uniform(rng, (12,), minval=-0.1, maxval=0.1)
        return self.mj_model.qpos0 + jnp.pad(noise, (7, 0)), jnp.zeros(self.mj_model.nv)

    def observe(self, data):
        """Sees all positions but x and y (m, rad), and all speeds (m/s, rad/s)."""
        return jnp.concatenate([data.qpos[2:], data.qvel])

    def outcome(self, before, data, action):
        """Pays for standing and for speed, up to 1 m/s; ends where the torso sinks or leans."""
        speed = jnp.minimum((data.qpos[0] - before.qpos[0]) / self.dt, 1)
        cost = 0.05 * jnp.sum(jnp.square(action))
        up = 1 - 2 * jnp.sum(data.qpos[4:6] ** 2)  # the cosine of how far it leans
        fallen = (data.qpos[2] < 0.18) | (up < 0.5)
        return 1 + speed - cost, fallen, {"reward_forward": speed, "reward_ctrl": -cost}

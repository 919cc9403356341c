r"""Your own robot: an arm that learns to reach for a ball, its MJCF in my_arm.xml.

Two commands in this folder, the first of half a minute on two cores, train it and make a video:

    python -m mjx_reinforce.train --env my_arm:Arm --output arm --num-episodes 64 \
        --env-steps 2000000
    python -m mjx_reinforce.watch arm --env my_arm:Arm
"""

from pathlib import Path

import jax
import jax.numpy as jnp

from mjx_reinforce.envs.base import MujocoEnv


class Arm(MujocoEnv):
    """Bring the tip to the ball, which is somewhere else in each episode."""

    def __init__(self):
        xml = str(Path(__file__).with_name("my_arm.xml"))
        super().__init__(xml_file=xml, frame_skip=4, max_episode_steps=75, reward_threshold=None)

    def initial(self, rng):
        """Stands upright, at rest; the ball is up to 0.4 m to the side and 0.5 m high."""
        near, far = jnp.array([0.15, -0.4, 0.1]), jnp.array([0.4, 0.4, 0.5])
        ball = jax.random.uniform(rng, (3,), minval=near, maxval=far)
        return jnp.concatenate([jnp.zeros(3), ball]), jnp.zeros(6)

    def observe(self, data):
        """Sees the joints (rad), their speeds (rad/s), and where the ball is, seen from the tip."""
        return jnp.concatenate([data.qpos, data.qvel[:3], data.qpos[3:] - data.site_xpos[0]])

    def outcome(self, before, data, action):
        """Costs the distance from tip to ball (m); never ends."""
        reward = -jnp.linalg.norm(data.qpos[3:] - data.site_xpos[0])
        return reward, False, {"reward_reach": reward}

"""Your own MJCF and reward, trained without touching the package: a crane that must hold still."""

from pathlib import Path

import jax
import jax.numpy as jnp

from mjx_reinforce import envs, reinforce, train_step
from mjx_reinforce.envs.base import MujocoEnv


class Crane(MujocoEnv):
    """Bring trolley and load to rest at 0; observation: positions, then velocities."""

    def __init__(self):
        xml = str(Path(__file__).parent / "own_model.xml")
        super().__init__(xml_file=xml, frame_skip=2, max_episode_steps=100, reward_threshold=None)

    def initial(self, rng):
        """Starts up to 1 m and 1 rad away, at rest."""
        return jax.random.uniform(rng, (2,), minval=-1, maxval=1), jnp.zeros(2)

    def outcome(self, before, data, action):
        """Costs the distance from rest at 0; never ends."""
        reward = -jnp.sum(data.qpos**2) - 0.1 * jnp.sum(data.qvel**2)
        return reward, False, {"reward_rest": reward}


if __name__ == "__main__":
    envs.register("Crane-v0", Crane)
    learner = reinforce(envs.make("Crane-v0"), num_episodes=32)
    state = learner.init(jax.random.key(0))
    for update in range(61):
        state, metrics = train_step(learner, state)
        if update % 20 == 0:
            print(f"update {update:3d}  return {metrics['episode_return']:8.1f}")

# %% [markdown]
# # Your own robot
#
# A robot is a MuJoCo model. A task is a class that says how an episode starts and what the reward is. This arm has two
# joints and learns to bring its tip to a target. Each episode has a different target.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from mujoco import MjSpec

import mjx_reinforce as mr
from mjx_reinforce.envs.base import MujocoEnv

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <default><geom type="capsule" size="0.02" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.5"/>
      <geom fromto="0 0 0 0.3 0 0"/>
      <body pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.5"/>
        <geom fromto="0 0 0 0.3 0 0"/>
        <site name="tip" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" ctrlrange="-8 8"/>
    <motor joint="elbow" ctrlrange="-4 4"/>
  </actuator>
</mujoco>
"""


class Arm(MujocoEnv):
    """Bring the tip to a target in the plane of the arm."""

    def __init__(self):
        super().__init__(
            xml_file=MjSpec.from_string(MODEL),
            frame_skip=4,
            max_episode_steps=50,
            reward_threshold=None,
        )

    def randomize(self, rng):
        """Draws the target of the episode (m)."""
        x, z = jax.random.uniform(rng, (2,), minval=-0.3, maxval=0.3)
        return {"target": jnp.stack([x, jnp.zeros(()), z])}

    def initial(self, rng):
        """Starts at rest, in any pose (rad)."""
        return jax.random.uniform(rng, (2,), minval=-1.0, maxval=1.0), jnp.zeros(2)

    def observe(self, data):
        """Sees the joints, their speeds, and where the target is from the tip."""
        away = data.episode["target"] - data.site("tip").xpos
        joints = jnp.concatenate([jnp.cos(data.qpos), jnp.sin(data.qpos), data.qvel])
        return jnp.concatenate([joints, away[::2], data.episode["target"][::2]])

    def outcome(self, before, data, action):
        """Costs the distance (m); never ends early."""
        distance = jnp.linalg.norm(data.episode["target"] - data.site("tip").xpos)
        return -distance, False, {"reward_reach": -distance}


# %% [markdown]
# ## Train
#
# `of_task` returns settings that suit untuned tasks. More episodes in each update make the gradient less noisy.
#
# The class has a name in `envs`, so that `run` finds it. On the command line it would be `--env my_module:Arm`.

# %%
mr.envs.register("Arm-v0", Arm)
config = dataclasses.replace(
    mr.of_task("Arm-v0", env_steps=6_000_000),
    num_episodes=64,
    num_seeds=2,
    hidden_sizes=(32, 32),
    discount=0.95,
    update="natural-gradient",
    max_kl=0.02,
)
results = mr.run(config, quiet=True)
print(f"return {results.eval_return[0].mean():.1f} at first, {results.test_returns.mean():.1f} now")

# %% [markdown]
# ## Look at it
#
# The policy plays 64 episodes. How far is the tip from the target?

# %%
env = mr.envs.make("Arm-v0")
policy, actor = results.policy, jax.tree.map(lambda x: x[0], results.actor)
episodes = mr.rollout(
    env,
    lambda actor, observation: mr.act(policy, actor, observation),
    actor,
    policy.distribution,
    jax.random.key(0),
    num_episodes=64,
    horizon=50,
    deterministic=True,
)
distance = -np.asarray(episodes.reward)  # [50, 64]

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
left.plot(results.env_steps / 1e6, results.eval_return)
left.set(xlabel="million env steps", ylabel="return of two seeds")
time = np.arange(50) * 0.04
right.plot(time, 100 * distance[:, :16], color="tab:blue", alpha=0.3)
right.plot(time, 100 * np.median(distance, 1), color="black", label="median of 64 episodes")
right.set(xlabel="time (s)", ylabel="distance from the target (cm)", ylim=(0, None))
right.legend()
fig.savefig("robot.png", dpi=90)
print(f"median distance at the end: {100 * np.median(distance[-1]):.1f} cm")

# %% [markdown]
# ## To try
#
# 1. Your own MJCF: `xml_file="my_robot.xml"`. `python -m mjx_reinforce.new my_robot.xml` begins the class.
# 2. Let the mass vary: `randomize` may also return `{"body_mass": self.model.body_mass * factor}`.
# 3. A video: `python -m mjx_reinforce.watch RUN --env my_module:Arm`, for a run that `run(config, output="RUN")` wrote.
#
# [Your own environment](../own_task.md) says which parts a model may have, and which are refused.

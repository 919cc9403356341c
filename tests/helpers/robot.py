"""A small robot, and a task that is made of all parts."""

import jax
import jax.numpy as jnp
from mujoco import MjSpec  # type: ignore

from mjx_reinforce.envs import parts
from mjx_reinforce.envs.base import MujocoEnv

ROBOT = """
<mujoco>
  <option gravity="0 0 -9"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 0.4" simple="false">
      <freejoint/>
      <geom type="box" size="0.1 0.07 0.05" pos="0.01 0 0.02" contype="0" conaffinity="0"/>
      <body name="leg" pos="0.1 0 0">
        <joint name="hip" axis="0 1 0" damping="0.3" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03" contype="0" conaffinity="0"/>
        <body pos="0 0 -0.2">
          <joint name="knee" axis="0 1 0" damping="0.3" armature="0.01"/>
          <geom size="0.03" pos="0 0 -0.17" friction="0.7 0.01 0.001"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="hip" kp="20" kv="0.5" ctrlrange="-1 1" forcerange="-8 8"/>
    <motor joint="knee" gear="5" ctrlrange="-1 1" forcerange="-1 1"/>
  </actuator>
</mujoco>
"""
PERIOD = 5
LONGEST_DELAY = 2
WEIGHTS = {"track": 1.0, "upright": 0.3, "rate": -0.05, "effort": -0.1, "speed": 0.2}


class Robot(MujocoEnv):
    """It draws a model, acts and observes late, is pushed, follows a command, has two frames."""

    frames = 2

    def __init__(self, steps=12):
        super().__init__(
            xml_file=MjSpec.from_string(ROBOT),
            frame_skip=4,
            max_episode_steps=steps,
            reward_threshold=None,
        )

    def initial(self, rng):
        return jnp.asarray(self.mj_model.qpos0), 0.2 * jax.random.normal(rng, (8,))

    def randomize(self, rng):
        keys = jax.random.split(rng, 7)
        model = self.mj_model
        servos = {"stiffness": (0.8, 1.2), "damping": (0.5, 1.5), "strength": (0.9, 1.1)}
        return (
            parts.friction(keys[0], model, 0.4, 1.0)
            | parts.masses(keys[1], model, 0.9, 1.1)
            | parts.centers(keys[2], model, 0.02)
            | parts.armature(keys[3], model, 1.0, 1.05)
            | parts.damping(keys[4], model, 0.8, 1.2)
            | parts.actuators(keys[5], model, **servos)
            | {"delay": jax.random.randint(keys[6], (), 0, LONGEST_DELAY + 1)}
        )

    def _command(self, key):
        return parts.command(key, [0.0, -0.5], [1.0, 0.5], rest_share=0.3)

    def memory(self, rng, data):
        return {
            "actions": parts.history(jnp.zeros(2), LONGEST_DELAY + 1),
            "command": self._command(rng),
            "gravity": parts.history(parts.gravity(data, "trunk"), LONGEST_DELAY + 1),
            "noise": jnp.zeros(4),
            "push": jnp.zeros(2),
            "step": 0,
        }

    def remember(self, rng, data, action):
        keys = jax.random.split(rng, 4)
        memory = data.memory
        step = memory["step"] + 1
        is_due = parts.is_due(step, PERIOD)
        joints = parts.uniform_noise(keys[0], [0.03, 0.03])
        gyro = parts.normal_noise(keys[1], [0.1, 0.2])
        return {
            "actions": parts.append(memory["actions"], action),
            "command": jnp.where(is_due, self._command(keys[2]), memory["command"]),
            "gravity": parts.append(memory["gravity"], parts.gravity(data, "trunk")),
            "noise": jnp.concatenate([joints, gyro]),
            "push": parts.push(keys[3], 0.5, is_due),
            "step": step,
        }

    def actuate(self, before, action):
        # The action itself comes with no delay; the newest in the history is the one before.
        actions = parts.append(before.memory["actions"], action)
        return self.control(parts.delayed(actions, before.episode["delay"]))

    def push(self, before):
        return parts.push_velocity(self.mj_model, before.memory["push"])

    def observe(self, data):
        memory = data.memory
        joints = data.qpos[7:] + memory["noise"][:2]
        gyro = parts.angular_velocity(data, "trunk")[:2] + memory["noise"][2:]
        gravity = parts.delayed(memory["gravity"], 1)
        last_action = memory["actions"][-1]
        return jnp.concatenate([joints, gyro, gravity, last_action, memory["command"]])

    def outcome(self, before, data, action):
        speed = parts.linear_velocity(data, "trunk")
        terms = {
            "track": parts.tracking(speed[:2] - data.memory["command"], 0.5),
            "upright": parts.upright(parts.gravity(data, "trunk")),
            "rate": parts.action_rate(action, before.memory["actions"][-1]),
            "effort": parts.effort(data.actuator_force, self.mj_model.actuator_forcerange[:, 1]),
            "speed": jnp.tanh(parts.angular_velocity(data, "leg")[1]),
        }
        reward, metrics = parts.weighted(WEIGHTS, terms)
        return reward, data.qpos[2] < 0.1, metrics

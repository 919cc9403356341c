"""What noise, delays, commands, pushes, frames and random models cost: env steps per second.

    python -m experiments.speed.robot_parts --episodes 256

The quadruped of the examples, with all parts of ``envs.parts`` and with none, plays the same number
of episodes in turn, under an untrained policy. The ratio of the medians is what counts.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from experiments.examples import quadruped
from experiments.speed.benchmark.ours import rollout_of
from mjx_reinforce.envs import parts
from mjx_reinforce.envs.base import MujocoEnv

_C: Any = mujoco  # a C extension without stubs
TORSO = "torso"
NUM_SERVOS = 12
LONGEST_DELAY = 2
NOISE = np.repeat([0.05, 0.2, 0.03, 1.5], [3, 3, NUM_SERVOS, NUM_SERVOS])


class Bare(MujocoEnv):
    """A quadruped that walks as commanded, and knows its sensors without noise or delay."""

    def __init__(self):
        spec = _C.MjSpec.from_file(str(Path(quadruped.__file__).with_name("quadruped.xml")))
        # So that its center of mass may move.
        spec.body(TORSO).simple = False
        super().__init__(xml_file=spec, frame_skip=5, max_episode_steps=500, reward_threshold=None)

    def initial(self, rng):
        """Stands, each joint up to 0.1 rad from there, at rest."""
        noise = jax.random.uniform(rng, (NUM_SERVOS,), minval=-0.1, maxval=0.1)
        return self.mj_model.qpos0 + jnp.pad(noise, (7, 0)), jnp.zeros(self.mj_model.nv)

    def sensors(self, data):
        """Returns what an inertial unit and the joints measure [30]."""
        body = (parts.gravity(data, TORSO), parts.angular_velocity(data, TORSO))
        return jnp.concatenate([*body, data.qpos[7:], data.qvel[6:]])

    def observe(self, data):
        """Sees its sensors."""
        return self.sensors(data)

    def outcome(self, before, data, action):
        """Pays for standing upright, and for 0.5 m/s; ends where the torso tilts."""
        gravity = parts.gravity(data, TORSO)
        velocity = parts.linear_velocity(data, TORSO)
        reward = parts.upright(gravity) - jnp.abs(velocity[0] - 0.5)
        return reward, gravity[2] > -0.6, {"reward_speed": reward}


class Full(Bare):
    """The same with everything that ``envs.parts`` has."""

    frames = 3

    def randomize(self, rng):
        """Draws the model, and how late actions come."""
        keys = jax.random.split(rng, 7)
        model = self.mj_model
        return (
            parts.friction(keys[0], model, 0.4, 1.0)
            | parts.masses(keys[1], model, 0.9, 1.1)
            | parts.centers(keys[2], model, 0.02)
            | parts.armature(keys[3], model, 1.0, 1.05)
            | parts.damping(keys[4], model, 0.8, 1.2)
            | parts.actuators(keys[5], model, stiffness=(0.9, 1.1), strength=(0.9, 1.1))
            | {"delay": jax.random.randint(keys[6], (), 0, LONGEST_DELAY + 1)}
        )

    def command(self, rng):
        """Draws a command [3]: forward, sideways (m/s), and turning (rad/s)."""
        return parts.command(rng, [0.0, -0.3, -0.5], [1.0, 0.3, 0.5], 0.1)

    def memory(self, rng, data):
        """Draws what an episode remembers at its start."""
        return {
            "actions": parts.history(jnp.zeros(NUM_SERVOS), LONGEST_DELAY + 1),
            "command": self.command(rng),
            "noise": jnp.zeros(NOISE.shape),
            "push": jnp.zeros(2),
            "step": 0,
        }

    def remember(self, rng, data, action):
        """Returns what an episode remembers after an env step."""
        keys = jax.random.split(rng, 3)
        step = data.memory["step"] + 1
        return {
            "actions": parts.append(data.memory["actions"], action),
            "command": jax.lax.cond(
                parts.is_due(step, 250), self.command, lambda key: data.memory["command"], keys[0]
            ),
            "noise": parts.uniform_noise(keys[1], NOISE),
            "push": parts.push(keys[2], 0.5, parts.is_due(step, 200)),
            "step": step,
        }

    def actuate(self, before, action):
        """Returns the angles that the servos are to reach (rad), late."""
        actions = parts.append(before.memory["actions"], action)
        return self.control(parts.delayed(actions, before.episode["delay"]))

    def push(self, before):
        """Returns the push with which an env step begins."""
        return parts.push_velocity(self.mj_model, before.memory["push"])

    def observe(self, data):
        """Sees its noisy sensors, its last action, and the command."""
        memory = data.memory
        noisy_sensors = self.sensors(data) + memory["noise"]
        return jnp.concatenate([noisy_sensors, memory["actions"][-1], memory["command"]])


@dataclasses.dataclass(frozen=True)
class PartsSettings:
    """Time a task with all parts beside the same without."""

    episodes: int = 256
    """How many episodes are played at once."""
    steps: int = 200
    """Env steps of each."""
    repeats: int = 7
    """Timed runs of each."""


def main() -> None:
    """Prints env steps per second of both, and their ratio."""
    settings = tyro.cli(PartsSettings, description=__doc__)
    tasks = [f"{__spec__.name}:{task.__name__}" for task in (Bare, Full)]
    candidates = [rollout_of(task, "native", settings.steps)(settings.episodes) for task in tasks]
    seconds: list[list[float]] = [[] for _ in candidates]
    for repeat in range(settings.repeats + 1):
        for times, candidate in zip(seconds, candidates, strict=True):
            start = time.perf_counter()
            candidate.run()
            if repeat:  # the first warms up
                times.append(time.perf_counter() - start)
    rates = [
        candidate.env_steps / np.median(times)
        for times, candidate in zip(seconds, candidates, strict=True)
    ]
    print(f"{jax.devices()[0].device_kind}, {settings.episodes} episodes of {settings.steps}")
    print(
        f"no parts {rates[0]:.3g}, all parts {rates[1]:.3g} env steps/s: {rates[1] / rates[0]:.2f}"
    )


if __name__ == "__main__":
    main()

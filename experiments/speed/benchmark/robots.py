"""Robots to be timed: the quadruped of the examples with elliptic cones, and files of others."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from experiments.checks.robots import models
from experiments.examples import quadruped
from mjx_reinforce import envs
from mjx_reinforce.engine.base import Box
from mjx_reinforce.envs.base import MujocoEnv

_C: Any = mujoco  # a C extension without stubs
#: An env step of a robot of others (s), and how far an action of 1 moves a servo (rad).
_PERIOD = 0.02
_SCALE = 0.5


def make(task: str) -> Any:
    """Builds the environment of a task: an id, with settings after it, "ID NAME=VALUE ..."."""
    env_id, *words = task.split()
    return envs.make_set(env_id, words)


class EllipticQuadruped(quadruped.Quadruped):
    """The quadruped of the examples with elliptic cones, impratio 100, and feet that can roll."""

    def __init__(self):
        xml = str(Path(quadruped.__file__).with_name("quadruped.xml"))
        spec = _C.MjSpec.from_file(xml)
        spec.option.cone = _C.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 100
        for geom in spec.geoms:
            is_foot = geom.type == _C.mjtGeom.mjGEOM_BOX and geom.parent.name != "torso"
            if is_foot:
                geom.condim = 6
        MujocoEnv.__init__(
            self, xml_file=spec, frame_skip=5, max_episode_steps=500, reward_threshold=None
        )


class Robot(MujocoEnv):
    """A legged robot of others, with servos: walk forward from the file's first key frame."""

    def __init__(self, **settings: Any):
        # The files of Playground name meshes that it does not ship, and that nothing collides with.
        model, _ = models.load(Path(settings["xml_file"]))
        defaults = {
            "frame_skip": round(_PERIOD / model.opt.timestep),
            "max_episode_steps": 500,
            "reward_threshold": None,
        }
        super().__init__(**(defaults | settings | {"xml_file": model}))
        self.action_space = Box(np.full(model.nu, -1.0), np.full(model.nu, 1.0))
        self.home_control = np.array(model.key_ctrl[0])
        self.home_pose = np.array(model.key_qpos[0])

    def control(self, action):
        """Returns the angles that the servos are to reach (rad)."""
        return jnp.asarray(self.home_control) + _SCALE * action

    def initial(self, rng):
        """Stands, each joint up to 0.1 rad from there, at rest."""
        noise = jax.random.uniform(rng, (self.mj_model.nq - 7,), minval=-0.1, maxval=0.1)
        pose = jnp.asarray(self.home_pose) + jnp.pad(noise, (7, 0))
        return pose, jnp.zeros(self.mj_model.nv)

    def observe(self, data):
        """Sees all positions but x and y (m, rad), and all speeds (m/s, rad/s)."""
        return jnp.concatenate([data.qpos[2:], data.qvel])

    def outcome(self, before, data, action):
        """Pays for standing and for speed, up to 1 m/s; ends where the robot sinks or leans."""
        speed = jnp.minimum((data.qpos[0] - before.qpos[0]) / self.dt, 1)
        cost = 0.05 * jnp.mean(jnp.square(action))
        up = 1 - 2 * jnp.sum(data.qpos[4:6] ** 2)  # the cosine of how far it leans
        has_fallen = (data.qpos[2] < 0.6 * self.home_pose[2]) | (up < 0.5)
        return 1 + speed - cost, has_fallen, {"reward_forward": speed, "reward_ctrl": -cost}

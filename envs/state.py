"""What an env step hands to the next, and what a task knows of its start."""

from typing import Any

import jax
from flax import struct

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.envs.parts import Named


@struct.dataclass(kw_only=True)
class Physics:
    """What the next physics step needs (``models.CARRIED``); the rest of mjx.Data follows from it.

    time: [] since the start of the episode (s)
    qpos: [nq] generalized positions (m, rad)
    qvel: [nv] generalized velocities (m/s, rad/s)
    act: [na] activations of the actuators that have a state
    qacc_warmstart: [nv] where the constraint solver starts (m/s^2, rad/s^2)
    carried: fields of the last step's mjx.Data that the next outcome reads, by their names
    episode: what ``MujocoEnv.randomize`` returned
    constants: fields of the model that follow from it, see ``derived.constants``
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    carried: dict[str, jax.Array] = struct.field(default_factory=dict)
    episode: dict[str, jax.Array] = struct.field(default_factory=dict)
    constants: dict[str, jax.Array] = struct.field(default_factory=dict)


class Before(Named, Simulation):
    """What is known of the start of an env step, under MuJoCo's own names."""

    def __init__(self, fields: dict[str, jax.Array], mj_model: MjModel, episode: dict[str, Any]):
        """Shows these fields of mjData; any other raises AttributeError when it is read."""
        vars(self).update(fields)
        self.mj_model = mj_model
        self.episode = episode

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"before.{name} is not known, since nothing kept it from the env step before; "
            f"write carried = ({name!r},) in the class of the task"
        )

"""What an env step hands to the next, and what a task knows of its start."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from flax import struct

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import check_count
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.engine.play.counter import key_of_words
from mjx_reinforce.envs.outcomes import check_memory
from mjx_reinforce.envs.views import Named


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
    memory: what the episode remembers, see ``MujocoEnv.memory``
    key: the words of the key of what it will remember next; of a task without memory none
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    carried: dict[str, jax.Array] = struct.field(default_factory=dict)
    episode: dict[str, jax.Array] = struct.field(default_factory=dict)
    constants: dict[str, jax.Array] = struct.field(default_factory=dict)
    memory: dict[str, jax.Array] = struct.field(default_factory=dict)
    key: jax.Array | tuple[()] = ()


class Before(Named, Simulation):
    """What is known of the start of an env step, under MuJoCo's own names."""

    def __init__(
        self,
        fields: dict[str, jax.Array],
        mj_model: MjModel,
        episode: dict[str, Any],
        memory: dict[str, Any] | None = None,
    ):
        """Shows these fields of mjData; any other raises AttributeError when it is read."""
        vars(self).update(fields)
        self.mj_model = mj_model
        self.episode = episode
        self.memory = dict(memory or {})

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"before.{name} is not known, since nothing kept it from the env step before; "
            f"write carried = ({name!r},) in the class of the task"
        )


class Recollection(NamedTuple):
    """The two fields of ``Physics`` that change with what an episode remembers."""

    memory: dict[str, jax.Array]
    key: jax.Array | tuple[()]


#: That of a task whose ``memory`` is the default.
NOTHING = Recollection({}, ())


def recollect_start(env: Any, rng: jax.Array | None, view: Any) -> Recollection:
    """Returns what an episode remembers at its start, which the view then shows.

    Args:
      env: the ``MujocoEnv``.
      rng: of the episode's memory; consumed.
      view: the simulation at the start, as the task reads it.
    """
    if not env.has_memory:
        return NOTHING
    if rng is None:
        rng = jax.random.key(0)
    # Two words, whatever generator the key is of.
    key, memory_key = jax.random.split(key_of_words(jax.random.bits(rng, (2,), jnp.uint32)))
    memory = check_memory(type(env).__name__, "memory", env.memory(memory_key, view))
    # A copy, here and below: a task may change entries of the dict that it reads.
    view.memory = dict(memory)
    # The words: machine code knows arrays of numbers alone.
    return Recollection(memory, jax.random.key_data(key))


def recollect_step(
    env: Any, before: Physics | Recollection, view: Any, action: jax.Array
) -> Recollection:
    """Returns what an episode remembers after an env step, which the view then shows.

    Args:
      env: the ``MujocoEnv``.
      before: what has the memory and the key at the start of the env step.
      view: the simulation after it, as the task reads it.
      action: [A] as the policy gave it.
    """
    if not env.has_memory:
        return NOTHING
    key, step_key = jax.random.split(key_of_words(cast(jax.Array, before.key)))
    view.memory = dict(before.memory)
    entries = env.remember(step_key, view, action)
    memory = check_memory(type(env).__name__, "remember", entries, before.memory)
    view.memory = dict(memory)
    return Recollection(memory, jax.random.key_data(key))


def observed(env: Any, view: Any, last_frames: jax.Array | None = None) -> jax.Array:
    """Returns what a policy sees: the last ``env.frames`` observations, the oldest first.

    Args:
      env: the ``MujocoEnv``.
      view: the simulation, as the task reads it.
      last_frames: what the policy saw before this env step, as this returns it. At the start of an
        episode there is none, and all frames are the first observation.
    """
    check_count("frames", env.frames)
    observation = env.observe(view)
    if env.frames == 1:
        return observation
    if last_frames is None:
        return jnp.tile(observation, env.frames)
    return jnp.concatenate([last_frames[observation.shape[0] :], observation])

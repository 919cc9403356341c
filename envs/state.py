"""What an env step hands to the next, and what a task knows of its start."""

import dataclasses
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from brax.envs.base import State
from flax import struct
from mujoco import mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import check_count
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.engine.play.counter import key_of_words
from mjx_reinforce.envs.models import CARRIED, CONSTANT, Fields, fields_of
from mjx_reinforce.envs.outcomes import check_memory, check_outcome
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
    carried: Fields = struct.field(default_factory=dict)
    episode: Fields = struct.field(default_factory=dict)
    constants: Fields = struct.field(default_factory=dict)
    memory: Fields = struct.field(default_factory=dict)
    key: jax.Array | tuple[()] = ()


class Before(Named, Simulation):
    """What is known of the start of an env step, under MuJoCo's own names."""

    def __init__(
        self,
        fields: Fields,
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

    memory: Fields
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


def physics_state(
    env: Any, view: Any, constants: Fields, carried: Fields, recollection: Recollection
) -> Physics:
    """Returns what the next env step needs to know of a simulation.

    Args:
      env: the ``MujocoEnv``.
      view: the simulation, as the task reads it.
      constants: fields of the model that follow from its episode, see ``derived.constants``.
      carried: what is carried beside the fields that the task has asked for, by names.
      recollection: what the episode remembers.
    """
    return Physics(
        **fields_of(view, CARRIED),
        carried=fields_of(view, env.carried) | carried,
        episode=view.episode,
        constants=constants,
        **recollection._asdict(),
    )


def before_of(mj_model: MjModel, state: Physics, data: mjx.Data) -> Before:
    """Returns what a task knows of the start of an env step.

    Args:
      mj_model: the model.
      state: what the env step before has handed on.
      data: what no physics step changes of the simulation.
    """
    # The state's own come last: a task may have asked to carry one of these, too.
    fields = fields_of(data, CONSTANT) | state.carried | fields_of(state, CARRIED)
    return Before(fields, mj_model, state.episode, state.memory)


def first_state(env: Any, physics: Physics, before: Before, view: Any) -> State:
    """Returns the state of an episode before its first env step.

    Args:
      env: the ``MujocoEnv``.
      physics: what its first env step needs.
      before: what the task knows of the start of that.
      view: the simulation, as the task reads it.
    """
    # No env step was made: the outcome says only which terms there are, each 0 so far. Wrappers
    # and loops need a state of one structure from the first step on.
    zero = jnp.zeros((), physics.qpos.dtype)
    action = jnp.zeros(env.action_size, zero.dtype)
    terms = check_outcome(type(env).__name__, env.outcome(before, view, action))[2]
    metrics = dict.fromkeys(terms, zero)
    return State(cast(Any, physics), observed(env, view), zero, zero, metrics)


def next_state(
    env: Any,
    state: State,
    physics: Physics,
    view: Any,
    outcome: tuple[Any, Any, dict[str, Any]],
    is_sound: jax.Array,
) -> State:
    """Returns the state after an env step.

    Args:
      env: the ``MujocoEnv``.
      state: the state before it.
      physics: what the next env step needs.
      view: the simulation after it, as the task reads it.
      outcome: what the task's ``outcome`` returned.
      is_sound: [] whether C MuJoCo would go on; else the reward is NaN.
    """
    reward, terminated, terms = outcome
    dtype = state.reward.dtype
    return dataclasses.replace(
        state,
        pipeline_state=physics,
        obs=observed(env, view, cast(jax.Array, state.obs)),
        reward=jnp.where(is_sound, jnp.asarray(reward, dtype), jnp.nan),
        done=jnp.asarray(terminated, dtype),
        metrics=state.metrics | jax.tree.map(lambda x: jnp.asarray(x, dtype), terms),
    )

"""A task of Playground as a ``MujocoEnv``.

What comes before the physics in its ``reset`` and ``step`` becomes the start and the controls, and
what comes after it the observation and the reward. All of Playground's ``State`` but the simulation
is what the episode remembers.
"""

import contextlib
import dataclasses
import importlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_reinforce.engine.base import Box
from mjx_reinforce.engine.checks import BadEnvironmentError, explain, require
from mjx_reinforce.engine.play.counter import key_of_words
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco.fields import FieldRecorder
from mjx_reinforce.envs.playground.exchange import (
    PhysicsReached,
    Start,
    Step,
    TaskData,
    exchanged,
)
from mjx_reinforce.envs.starts import start_shapes

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco


#: The fields of Playground's ``State`` that are remembered.
_REMEMBERED = ("obs", "reward", "done", "metrics", "info")
#: What stands before the names of what the next step reads of a simulation.
_DATA = "data/"


class _Outline(NamedTuple):
    """What is known of a task from its traces.

    tree: that of what is remembered of its state
    names: of the leaves of the tree
    keys: the names of those that are random keys
    data_fields: of a simulation, what its next step reads
    start_calls: how often its ``reset`` calls the physics
    settle_steps: physics steps in ``reset``
    pushes: whether its ``step`` sets velocities
    """

    tree: Any
    names: tuple[str, ...]
    keys: frozenset[str]
    data_fields: tuple[str, ...]
    start_calls: int
    settle_steps: int
    pushes: bool


def _remembered(state: Any) -> dict[str, Any]:
    return {name: getattr(state, name) for name in _REMEMBERED}


def _named(state: Any) -> dict[str, Any]:
    """Returns what is remembered of a state by names, such as info/rng."""
    leaves = jax.tree_util.tree_flatten_with_path(_remembered(state))[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): x for path, x in leaves}


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(getattr(x, "dtype", type(x)), jax.dtypes.prng_key)


def _words(rng: jax.Array) -> jax.Array:
    """Returns the words [2] of a key; those of a generator with longer ones are drawn."""
    words = jax.random.key_data(rng)
    if words.shape == (2,):
        return words
    return jax.random.bits(rng, (2,), jnp.uint32)


def _outlined(task: Any) -> _Outline:
    """Returns what is known of a task, whose ``reset`` and ``step`` are traced by shapes alone.

    Raises:
      ValueError: it does what no engine here can, or fails.
    """
    outlines = []

    def play(rng: jax.Array, action: jax.Array) -> None:
        """Traces the start of an episode and its first step."""
        outlines.append(_traced(task, rng, action))

    try:
        jax.eval_shape(play, jax.random.key(0), jnp.zeros(task.action_size))
    except BadEnvironmentError:
        raise
    except Exception as error:  # a class of the user's may raise anything
        name = type(task).__name__
        raise BadEnvironmentError(f"{name} cannot be played: {explain(error)}") from error
    return outlines[0]


def _traced(task: Any, rng: jax.Array, action: jax.Array) -> _Outline:
    """Returns what a trace of the start of an episode and of its first step shows."""
    name = type(task).__name__
    zeros = _C.MjData(task.mj_model)
    before = FieldRecorder(zeros, task.mj_model)
    after = FieldRecorder(zeros, task.mj_model)
    start = Start(task.mj_model, lambda fields: after, after)
    with exchanged(start):
        state = task.reset(rng)
    moved = sorted(state.data.fields.keys() & {"qpos", "qvel", "act"})
    require(
        not (start.settle_steps and moved),
        f"{name}.reset sets {', '.join(moved)} after its physics steps",
    )
    named = _named(state)
    keys = frozenset(field for field, x in named.items() if _is_key(x))
    tree = jax.tree.structure(_remembered(state))

    # What a step reads of the simulation before it is recorded; what it sets is a field.
    step = Step(task.n_substeps, after)
    with exchanged(step):
        state = task.step(state.replace(data=TaskData({}, before)), action)
    require(step.calls == 1, f"{name}.step must call mjx_env.step once, by this name")
    others = sorted(step.data.fields.keys() - {"qvel"})
    require(
        not others,
        f"{name}.step sets {', '.join(others)} before its physics; it can set the controls and "
        "qvel",
    )
    changed = sorted(state.data.fields)
    require(not changed, f"{name}.step sets {', '.join(changed)} after its physics")
    pushes = "qvel" in step.data.fields
    if pushes:
        before.names.add("qvel")
    return _Outline(
        tree=tree,
        names=tuple(named),
        keys=keys,
        data_fields=tuple(sorted(before.names)),
        start_calls=start.calls,
        settle_steps=start.settle_steps,
        pushes=pushes,
    )


class PlaygroundEnv(MujocoEnv):
    """A task of Playground, with its own ``reset`` and ``step``, on the physics of an engine here.

    Its starts are those of ``task.reset`` from the same key, and its time limit is that of the
    task's configuration. Actions are in [-1, 1], as Playground's trainers have them. An observation
    of several parts is the part "state", as for Playground's policies.

    task: the instance of Playground's class
    """

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """The arguments of ``MujocoEnv``, which the task says."""

    def __init__(self, task: Any):
        """Traces the task's ``reset`` and ``step``, by shapes alone.

        Args:
          task: an instance of one of Playground's classes, or of a subclass of the user's own.

        Raises:
          ValueError: the task does what no engine here can, or it fails.
        """
        self.task = task
        config = task._config
        repeats = config.get("action_repeat", 1)
        require(repeats == 1, f"action_repeat of {type(task).__name__} must be 1, got {repeats}")
        self._outline = _outlined(task)
        self.settle_steps = self._outline.settle_steps
        super().__init__(
            xml_file=task.mj_model,
            frame_skip=task.n_substeps,
            max_episode_steps=int(config.episode_length),
            reward_threshold=None,
        )
        bound = np.ones(task.action_size)
        self.action_space = Box(-bound, bound)

    def _reset(self, rng: jax.Array, data: Any = None) -> tuple[Any, Start]:
        """Traces the task's ``reset``; returns its state, and what stood for the physics.

        Args:
          rng: its key.
          data: the simulation at the start of the episode, if it is known.
        """

        def forward(fields: dict[str, jax.Array]) -> Any:
            """Computes what the task reads of a simulation before it sets more of it."""
            return self._dynamics.forward(models.make_data(self.mj_model).replace(**fields))

        start = Start(self.task.mj_model, forward, data, self._outline.start_calls)
        with exchanged(start):
            return self.task.reset(rng), start

    def split_rng(self, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the key twice: the task's ``reset`` is traced for both from the same one."""
        return rng, rng

    def draw(self, rng: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Returns the words of the key, and the start that the task's ``reset`` draws from it."""
        _, start = super().draw(rng)
        return {"key": _words(rng)}, start

    def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
        """Draws the start as the task's ``reset`` does, up to its physics."""
        state, start = self._reset(key_of_words(_words(rng)))
        fields = start.fields | state.data.fields
        return {name: fields[name] for name in start_shapes(self.task.mj_model)}

    def memory(self, rng: jax.Array, data: Any) -> dict[str, Any]:
        """Returns the state that the task's ``reset`` returns, without its simulation."""
        state, _ = self._reset(key_of_words(data.episode["key"]), data)
        return self._entries(state, data)

    def _entries(self, state: Any, data: Any) -> dict[str, Any]:
        """Returns what an episode remembers of a task's state, and of its simulation."""
        entries = {
            name: jax.random.key_data(x) if _is_key(x) else x for name, x in _named(state).items()
        }
        data_fields = self._outline.data_fields
        return entries | {f"{_DATA}{name}": getattr(data, name) for name in data_fields}

    def _state(self, memory: dict[str, Any]) -> Any:
        """Returns the task's state before an env step, of what the episode remembers."""
        outline = self._outline
        leaves = [
            key_of_words(memory[name]) if name in outline.keys else memory[name]
            for name in outline.names
        ]
        module = importlib.import_module("mujoco_playground._src.mjx_env")
        fields = {name: memory[f"{_DATA}{name}"] for name in outline.data_fields}
        return module.State(data=TaskData(fields), **outline.tree.unflatten(leaves))

    def _applied(self, memory: dict[str, Any], action: jax.Array) -> Step:
        """Returns what the task's ``step`` hands to its physics."""
        step = Step(self.frame_skip)
        with exchanged(step), contextlib.suppress(PhysicsReached):
            self.task.step(self._state(memory), action)
        return step

    def actuate(self, before: Any, action: jax.Array) -> jax.Array:
        """Returns the controls [nu] that the task's ``step`` applies."""
        return self._applied(before.memory, action).control

    def control(self, action: jax.Array) -> jax.Array:
        """Returns the controls [nu] that an action applies, whatever the episode was so far.

        Raises:
          ValueError: they depend on more than the action.
        """
        # In the precision in which MJX has the model; exports ask in float64.
        with jax.enable_x64(self.model.body_mass.dtype == jnp.float64):
            shapes = jax.eval_shape(self.reset, jax.random.key(0)).pipeline_state.memory
        # What is not known shows in the controls, if they depend on it.
        memory = {
            name: jnp.full(
                x.shape, jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else 0, x.dtype
            )
            for name, x in shapes.items()
        }
        control = self._applied(memory, action).control
        name = type(self.task).__name__
        require(
            bool(jnp.all(jnp.isfinite(control))),
            f"the controls of {name} depend on more than the action; leave --env out, and compute "
            "ctrl as its step does",
        )
        return control

    @property
    def has_pushes(self) -> bool:
        """Whether the task sets velocities before its physics."""
        return self._outline.pushes

    def push(self, before: Any) -> jax.Array:
        """Returns the change of the velocities [nv] that the task's ``step`` makes first."""
        # A push that depends on the action, which is not known here, breaks the episode.
        action = jnp.full(self.action_size, jnp.nan)
        return self._applied(before.memory, action).data.qvel - before.memory[f"{_DATA}qvel"]

    def remember(self, rng: jax.Array, data: Any, action: jax.Array) -> dict[str, Any]:
        """Returns the state that the task's ``step`` returns, without its simulation."""
        with exchanged(Step(self.frame_skip, data)):
            state = self.task.step(self._state(data.memory), action)
        return self._entries(state, data)

    def observe(self, data: Any) -> jax.Array:
        """Returns the task's observation [O], or its part "state"."""
        if "obs" in data.memory:
            return data.memory["obs"]
        return data.memory["obs/state"]

    def outcome(self, before: Any, data: Any, action: jax.Array) -> Any:
        """Returns the task's reward [], whether it is done [], and its metrics."""
        start = "metrics/"
        terms = {
            name.removeprefix(start): x
            for name, x in data.memory.items()
            if name.startswith(start) and jnp.ndim(x) == 0
        }
        return data.memory["reward"], data.memory["done"] != 0, terms

    def __repr__(self) -> str:
        return f"from_playground({type(self.task).__name__})"

"""The states of runs side by side, and what they begin with: keys, a budget, policies."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax

from mjx_reinforce.engine import counts
from mjx_reinforce.engine.base import PyTree, plain, with_keys
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config

#: A root of randomness; traced inside of programs.
Seed = int | np.uint32 | jax.Array


class RunState(struct.PyTreeNode, kw_only=True):
    """All that R runs need to go on, such as the seeds of one configuration.

    train_states: [R, ...] the ``TrainState`` of every run
    eval_keys: [R] the key of each run's evaluations, from which its start states are drawn
    settings: [R] each, settings that differ from run to run; none where all have the same
    """

    train_states: TrainState
    eval_keys: jax.Array
    settings: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


class Budget(NamedTuple):
    """What each run may use. It is an input of the programs: another budget compiles nothing.

    env_steps: [2] a count, see ``counts``; a run stops after the update that reaches it
    updates: [2] a count, how many updates it makes at most
    """

    env_steps: counts.Count
    updates: counts.Count

    @classmethod
    def of(cls, env_steps: int | None, updates: int | None) -> "Budget":
        """Returns a budget, of which what has no limit has the greatest count."""
        budget_limits = (MAX_COUNT if limit is None else limit for limit in (env_steps, updates))
        return cls(*map(counts.from_int, budget_limits))


def shape_of_all(shapes: RunState, num_runs: int) -> RunState:
    """Returns the shapes of the states of so many runs, from those of some."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_runs, *x.shape[1:]), x.dtype), shapes)


class StateRows:
    """Writes the states of runs as rows [R, B] of bytes, and reads them; no bit changes."""

    def __init__(self, state_shapes: PyTree):
        """Takes the states of any number of runs, or their shapes."""
        self._like = state_shapes
        leaves, self._structure = jax.tree.flatten(jax.eval_shape(plain, state_shapes))
        self._shapes = [leaf.shape[1:] for leaf in leaves]
        self._types = [np.dtype(leaf.dtype) for leaf in leaves]
        leaf_bytes = [
            int(np.prod(shape)) * dtype.itemsize
            for shape, dtype in zip(self._shapes, self._types, strict=True)
        ]
        *self._ends, self.size = np.cumsum(leaf_bytes).tolist()

    @property
    def layout(self) -> str:
        """What is in a row, in short: rows of another layout are others' states."""
        description = repr((self._structure, self._shapes, self._types))
        return hashlib.sha256(description.encode()).hexdigest()

    def rows(self, states: PyTree) -> np.ndarray:
        """Returns the rows of states, on the host."""
        leaves = map(np.ascontiguousarray, jax.tree.leaves(jax.device_get(plain(states))))
        return np.concatenate([_flat(leaf).view(np.uint8) for leaf in leaves], axis=1)

    def states(self, rows: np.ndarray) -> Any:
        """Returns the states of rows, on the host in memory of their own, and their keys."""
        # Bytes are read as another type where they lie together: a column of rows is copied first.
        columns = (column.copy() for column in np.split(rows, self._ends, axis=1))
        return self._shaped(
            column.view(dtype) for column, dtype in zip(columns, self._types, strict=True)
        )

    def traced_rows(self, states: PyTree) -> jax.Array:
        """Returns the rows of states, in a program."""

        def as_bytes(leaf: jax.Array) -> jax.Array:
            # XLA has no bitcast of booleans, and bytes need none.
            if leaf.dtype.itemsize == 1:
                return _flat(leaf.astype(jnp.uint8))
            return _flat(lax.bitcast_convert_type(leaf, jnp.uint8))

        return jnp.concatenate([as_bytes(leaf) for leaf in jax.tree.leaves(plain(states))], axis=1)

    def traced_states(self, rows: jax.Array) -> Any:
        """Returns the states of rows, in a program."""

        def read(column: jax.Array, dtype: np.dtype) -> jax.Array:
            if dtype.itemsize == 1:
                return column.astype(dtype)
            # A bitcast to a wider type takes the bytes of a number from the last axis.
            width = column.shape[1] // dtype.itemsize
            leaf_bytes = column.reshape(len(column), width, dtype.itemsize)
            return lax.bitcast_convert_type(leaf_bytes, dtype)

        columns = jnp.split(rows, self._ends, axis=1)
        return self._shaped(map(read, columns, self._types))

    def _shaped(self, leaves: Iterable[np.ndarray] | Iterable[jax.Array]) -> Any:
        """Returns states of leaves [R, numbers], which have the data of keys."""
        shaped_leaves = [
            leaf.reshape(len(leaf), *shape)
            for leaf, shape in zip(leaves, self._shapes, strict=True)
        ]
        return with_keys(jax.tree.unflatten(self._structure, shaped_leaves), self._like)


def _flat(leaf: PyTree) -> Any:
    """Returns a leaf as [R, numbers]."""
    return leaf.reshape(len(leaf), int(np.prod(leaf.shape[1:])))


def copied(state: RunState, sources: np.ndarray) -> RunState:
    """Returns states [R] of which each is that of its source [R], but for its own random keys."""
    new_state = jax.tree.map(lambda leaf: leaf[sources], state)
    train_states = dataclasses.replace(new_state.train_states, key=state.train_states.key)
    return dataclasses.replace(new_state, train_states=train_states, eval_keys=state.eval_keys)


class Best(struct.PyTreeNode, kw_only=True):
    """The best policies so far.

    actor: [S, ...] each seed's
    eval_return: [S] what its evaluation returned; -inf before the first
    num_updates: [S, 2] how many updates the seed had made then, as ``counts`` has it
    """

    actor: Actor
    eval_return: Any
    num_updates: Any


def first_best(train_states: TrainState) -> Best:
    """Returns the state before the first evaluation, in memory of its own."""
    actor, num_updates = jax.tree.map(np.array, (train_states.actor, train_states.num_updates))
    # Any return is better, also -inf: of equals the later counts. In JAX's type of floats, which
    # is that of evaluations.
    worst_return = np.full(len(num_updates), -np.inf, jnp.result_type(float))
    return Best(actor=actor, eval_return=worst_return, num_updates=num_updates)


def keep_best(best: Best, present_best: Best) -> Best:
    """Returns the better policy of each seed; of two that are equal, the later is the better.

    Args:
      best: so far.
      present_best: those of an evaluation; a return that is not a number is never the best.
    """
    # A NaN is no better than anything.
    is_better = present_best.eval_return >= best.eval_return

    def choose(new_leaf: np.ndarray, old_leaf: np.ndarray) -> np.ndarray:
        return np.where(is_better.reshape(-1, *[1] * (new_leaf.ndim - 1)), new_leaf, old_leaf)

    return jax.tree.map(choose, present_best, best)


def seed_keys(seed: Seed, seed_numbers: jax.Array | np.ndarray) -> jax.Array:
    """Returns the keys [R] that the seeds numbered so begin with: those of ``jax.random.split``."""
    return _for_each_seed(_root_key(seed, key_domain=0), seed_numbers)


def eval_keys(seed_numbers: jax.Array | np.ndarray) -> jax.Array:
    """Returns the keys of every evaluation but the last test, of the seeds [R] numbered so."""
    return _for_each_seed(_root_key(_EVALUATION_ROOT, key_domain=1), seed_numbers)


def last_test_keys(seed_numbers: jax.Array | np.ndarray, config: Config) -> jax.Array:
    """Returns the keys [K, R] of the last test, which plays the episodes of K evaluations."""
    # The programs play ``eval_episodes`` at once, and no others are compiled for the test.
    num_rounds = -(-(config.test_episodes or config.eval_episodes) // config.eval_episodes)
    keys = jax.random.split(_root_key(_EVALUATION_ROOT, key_domain=2), num_rounds)
    return jax.vmap(_for_each_seed, in_axes=(0, None))(keys, seed_numbers)


#: Policies of all runs are evaluated from the same starts, whatever their root is.
_EVALUATION_ROOT = 0


def _root_key(seed: Seed, key_domain: int) -> jax.Array:
    """Returns the root of the keys of training (domain 0), evaluation (1), or the last test (2).

    The domains share no key, whatever seeds the user chooses.
    """
    return jax.random.fold_in(jax.random.key(seed), key_domain)


def _for_each_seed(key: jax.Array, seed_numbers: jax.Array | np.ndarray) -> jax.Array:
    """Returns keys [R], each by the seed's number alone, however many seeds there are.

    Start states shared by all seeds would be a chance that no interval over seeds knows of.
    """
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.asarray(seed_numbers))


#: Settings of a policy that only say how its first parameters were drawn.
_INIT_SETTINGS = ("initial_std", "initializer", "env")


def last_actors(config: Config, policy: Mapping[str, Any]) -> Actor:
    """Returns the actors [S, ...] with which the seeds of a run begin.

    Args:
      config: its settings, with ``init_from``.
      policy: what ``build.policy_settings`` returns.

    Raises:
      ValueError: there is no such run, it has no policies, or they are of another form.
    """
    from mjx_reinforce.export.policy_files import read_policy
    from mjx_reinforce.export.run_files import policy_folder, read_run

    assert config.init_from is not None
    directory = Path(config.init_from)
    run = read_run(directory)
    saved_policy = read_policy(policy_folder(run, "last"), trusted_code=config.policy)
    # Parameters fit only the network, the family and the spaces for which they were trained.
    for name, value in policy.items():
        saved_value = saved_policy.settings.get(name, value)
        if name not in _INIT_SETTINGS and saved_value != value:
            raise ValueError(
                f"the policies in {directory}, trained on {run.env}, have {name} {saved_value}, "
                f"and this run {value}; make them agree, or leave --init-from out"
            )
    # A run with more seeds than that one begins with some of its policies several times.
    seeds = (config.first_seed + np.arange(config.num_seeds)) % saved_policy.num_seeds
    seeds = np.repeat(seeds, config.race)
    return jax.tree.map(lambda x: x[seeds], saved_policy.actor)


def begin_with(state: RunState, actors: Actor) -> RunState:
    """Returns the state of a run before its first update, with actors [S, ...] of another."""
    init_actor = state.train_states.actor
    actor = jax.tree.map(lambda leaf, first: np.asarray(leaf, first.dtype), actors, init_actor)
    return dataclasses.replace(
        state, train_states=dataclasses.replace(state.train_states, actor=actor)
    )

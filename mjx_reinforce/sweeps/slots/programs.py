"""The compiled programs of a group: those of a run, for slots of runs on all devices."""

import dataclasses
import functools
import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.learners import counts
from mjx_reinforce.learners.learner import Host
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.settings.memory import num_cores
from mjx_reinforce.sweeps.history import Measured
from mjx_reinforce.sweeps.slots.ahead import Stopwatch, started
from mjx_reinforce.sweeps.slots.devices import NONE, RUNS, Devices
from mjx_reinforce.sweeps.slots.layout import StateRows
from mjx_reinforce.sweeps.slots.packing import pack_slots
from mjx_reinforce.training.state import (
    Arrays,
    Budget,
    BuildLearner,
    RunState,
    beginning,
    block_of_updates,
    budget_of,
    eval_keys,
    evaluation,
    evaluation_guests,
    seed_keys,
)
from mjx_reinforce.types import Environment, PyTree, plain, with_keys

#: What ``history.Measured`` has of a run's counts since the start.
_COUNTS = ("updates", "env_steps")
#: And of an evaluation.
_LOOKED = ("eval_return", "eval_steps")


class Movers(NamedTuple):
    """What moves the runs of one slot on. States are rows of bytes, see ``layout.StateRows``.

    block: (states [W, B], which lanes have a run [W], budget) -> (states [W, B], which runs made an
      update [W], and what ``history.Measured`` has of updates [W], and of evaluations where these
      ride), as ``state.block_of_updates``
    look: (states [W, B], which [W]) -> what ``history.Measured`` has of evaluations [W]
    rides: whether ``block`` evaluates; else ``look`` does, before it
    """

    block: Callable[..., tuple[jax.Array, jax.Array, dict[str, jax.Array]]]
    look: Callable[[jax.Array, jax.Array], dict[str, jax.Array]]
    rides: bool


class SlotPrograms(NamedTuple):
    """The compiled programs of a group. States of runs [R, B] are on the host between them.

    begin: (data of keys [R, 2] and of those of evaluations [R, 2], settings [R] each) -> the first
      states
    movers: by the width of a slot, the widest first; the narrower ones may still be compiling
    keys: [S, 2], the data of the keys that the seeds begin with
    eval_keys: [S, 2], the data of the keys of evaluations, the same in all configurations
    limits: the budget of each run, on all devices
    whole: the settings of all that a run is to do, in one or more parts
    devices: among which a slot is divided
    shape_of: the shapes of the states of so many runs
    layout: of their bytes
    clock: which counts the time that passes until a narrower slot's are there
    """

    begin: Callable[..., np.ndarray]
    movers: dict[int, "Future[Movers]"]
    keys: np.ndarray
    eval_keys: np.ndarray
    limits: Budget
    whole: Config
    devices: Devices
    shape_of: Callable[[int], RunState]
    layout: StateRows
    clock: Stopwatch

    def of(self, config: Config) -> "SlotPrograms":
        """Returns the same programs for settings with a part of the budget, or another seed."""
        return self._replace(**_inputs(config, self.whole, self.devices))

    def advance(
        self, states: np.ndarray, training: np.ndarray, lengths: np.ndarray, blocks: int
    ) -> list[Measured]:
        """Evaluates the runs that still train and makes a block of updates, several times.

        Args:
          states: [R, B] of all runs; changed.
          training: [R] which of them still train; at least one does.
          lengths: [R] about how long their episodes are, see ``packing.pack_slots``.
          blocks: how many, where one of the narrowest slots holds these runs. Else they are packed
            again after one.

        Returns:
          What each block measured, of the runs that made an update; none without any.
        """
        lanes, movers = self._pack(training, lengths)
        count = blocks if lanes.shape == (1, min(self.movers)) else 1

        def move(runs: np.ndarray) -> Any:
            measured = []
            slot, which = self._put((states[runs], runs >= 0))
            for _ in range(count):  # the host does not wait for any
                looked = {} if movers.rides else movers.look(slot, which)
                slot, moved, used = movers.block(slot, which, self.limits)
                measured.append((moved, looked | used))
            return jax.device_get((slot, measured))

        rows, measured = zip(*_side_by_side(move, lanes), strict=True)
        states[lanes[lanes >= 0]] = np.stack(rows)[lanes >= 0]
        measured = [_joined(lanes, block) for block in zip(*measured, strict=True)]
        return [block for block in measured if len(block.runs)]

    def evaluate(self, states: np.ndarray) -> Measured:
        """Evaluates the present policies of all runs [R, B]."""
        lanes, movers = self._pack(np.ones(len(states), bool), np.zeros(len(states)))

        def look(runs: np.ndarray) -> Any:
            slot, which = self._put((states[runs], runs >= 0))
            return runs >= 0, jax.device_get(movers.look(slot, which))

        return _joined(lanes, _side_by_side(look, lanes))

    def _pack(self, chosen: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, Movers]:
        """Returns the runs of each slot, and what moves them."""
        lanes = pack_slots(chosen, lengths, list(self.movers), self.devices.count)
        return lanes, self.clock.wait(self.movers[lanes.shape[1]])

    def _put(self, slot: PyTree) -> Any:
        return self.devices.put(slot, RUNS)


def _side_by_side(move: Callable[[np.ndarray], Any], lanes: np.ndarray) -> list[Any]:
    """Returns the results for all slots [slots, width], as many at once as there are cores.

    A slot alone leaves a part of the cores waiting for each other, and its results are fetched
    while the next one is moved.
    """
    return [move(lanes[0])] if len(lanes) == 1 else list(_threads().map(move, lanes))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Returns one thread a core; to start them takes milliseconds."""
    return ThreadPoolExecutor(num_cores())


def _joined(lanes: np.ndarray, slots: Sequence[Any]) -> Measured:
    """Returns what was measured in slots, each of which has (which lanes count [W], values [W])."""
    which, values = zip(*slots, strict=True)
    kept = np.concatenate(which)
    joined = {name: np.concatenate([slot[name] for slot in values])[kept] for name in values[0]}
    totals = {name: counts.to_int(joined[name]) for name in _COUNTS if name in joined}
    return Measured(lanes.reshape(-1)[kept], joined | totals)


def compile_programs(
    env: Environment,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    traced: Collection[str],
    widths: Sequence[int],
    devices: Devices,
    clock: Stopwatch,
) -> SlotPrograms:
    """Compiles the programs of a group for the widest slot, and begins with the narrower ones.

    These are traced while the widest are compiled: a sweep of some seconds soon needs them.

    Args:
      env: what is trained on.
      build_learner: from the traced settings of a run to its learner.
      horizon: T, the time limit of an episode in steps.
      config: the settings, in which those that are traced stand for any value.
      traced: the names of the settings that are traced.
      widths: how many runs a slot may have, the most first; multiples of the number of devices.
      devices: where.
      clock: of the sweep.
    """
    layout = StateRows(shape_of_states(build_learner, traced, 1))
    compile_for = functools.partial(_movers, env, build_learner, horizon, config, traced, devices)
    compile_for = functools.partial(compile_for, layout, threading.Lock())
    movers = {width: started(functools.partial(compile_for, width)) for width in widths}
    begin = started(functools.partial(_begin, build_learner, traced, widths[0], devices, layout))
    inputs = started(functools.partial(_inputs, config, config, devices))
    movers[widths[0]].result()
    return SlotPrograms(
        begin=begin.result(),
        movers=movers,
        whole=config,
        devices=devices,
        shape_of=functools.partial(shape_of_states, build_learner, traced),
        layout=layout,
        clock=clock,
        **inputs.result(),
    )


def _inputs(config: Config, whole: Config, devices: Devices) -> dict[str, Any]:
    """Returns what is no part of a program, as ``SlotPrograms`` has it."""
    part, all_of_it = budget_of(config), budget_of(whole)
    budget = Budget(part.env_steps, part.updates, all_of_it.env_steps, all_of_it.updates)
    keys = jax.device_get(plain({"keys": seed_keys(config), "eval_keys": eval_keys(config)}))
    return keys | {"limits": devices.put(budget, NONE)}


def shape_of_states(
    build_learner: BuildLearner, traced: Collection[str], num_runs: int
) -> RunState:
    """Returns the shapes of the states of so many runs, with the data of keys in their place."""
    return jax.eval_shape(
        lambda *arguments: plain(beginning(build_learner)(*arguments)),
        *_arguments(traced, num_runs),
    )


def _arguments(traced: Collection[str], width: int) -> tuple[Any, Any, dict[str, jax.Array]]:
    """Returns the shapes of the arguments of ``beginning``."""
    zeros = {name: jnp.zeros(width) for name in traced}
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), width))
    return keys, keys, jax.eval_shape(lambda: zeros)


def _begin(
    build_learner: BuildLearner,
    traced: Collection[str],
    width: int,
    devices: Devices,
    layout: StateRows,
) -> Callable[..., np.ndarray]:
    """Compiles ``SlotPrograms.begin``, which begins ``width`` runs at once."""

    def first(keys: jax.Array, eval_keys: jax.Array, settings: dict[str, jax.Array]) -> jax.Array:
        typed = map(jax.random.wrap_key_data, (keys, eval_keys))
        return layout.traced_rows(plain(beginning(build_learner)(*typed, settings)))

    shapes = devices.shapes(jax.eval_shape(plain, _arguments(traced, width)), RUNS)
    compiled = devices.jit(first, (RUNS, RUNS, RUNS), RUNS).lower(*shapes).compile()

    def begin(keys: np.ndarray, eval_keys: np.ndarray, settings: Arrays) -> np.ndarray:
        count = len(keys)
        slots = []
        for start in range(0, count, width):
            index = np.minimum(np.arange(start, start + width), count - 1)
            values = {
                name: np.asarray(x[index], shapes[2][name].dtype) for name, x in settings.items()
            }
            slots.append(compiled(*devices.put((keys[index], eval_keys[index], values), RUNS)))
        return np.concatenate(jax.device_get(slots))[:count]

    return begin


def _movers(
    env: Environment,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    traced: Collection[str],
    devices: Devices,
    layout: StateRows,
    tracing: threading.Lock,
    width: int,
) -> Movers:
    """Compiles what moves slots of ``width`` runs; the arguments are ``compile_programs``'.

    Programs are traced one after the other; the lock ``tracing`` is held meanwhile.
    """
    with ThreadPoolExecutor() as pool, tracing:  # the first compiles while the second is traced
        like = jax.eval_shape(beginning(build_learner), *_arguments(traced, width))
        learner = build_learner({})  # policies and engines are those of any
        rides = isinstance(learner.play, Host)
        visit = evaluation_guests(config, sampled=False) if rides else None
        updates = block_of_updates(build_learner, config.block_length, visit)

        def block(rows: jax.Array, which: jax.Array, budget: Budget) -> Any:
            before = with_keys(layout.traced_states(rows), like)
            # A lane without a run has no budget.
            played = before.train_states.env_steps
            played = jnp.where(which[:, None], played, counts.from_int(MAX_COUNT))
            train_states = dataclasses.replace(before.train_states, env_steps=played)
            before = dataclasses.replace(before, train_states=train_states)
            after, measured = updates(before, budget, which)
            moved = jnp.any(measured.metrics["active"], axis=0)
            counted = _counts(after, measured.metrics)
            return layout.traced_rows(plain(after)), moved, counted | seen(measured.looked)

        def seen(measured: dict[str, jax.Array]) -> dict[str, jax.Array]:
            return {name: measured[name] for name in _LOOKED if name in measured}

        evaluate = evaluation(env, learner, horizon, config, sampled=False)

        def look(rows: jax.Array, which: jax.Array) -> dict[str, jax.Array]:
            states = with_keys(layout.traced_states(rows), like)
            return seen(evaluate(states.train_states.actor, states.eval_keys, which))

        budget = devices.put(budget_of(config), NONE)
        rows = jax.eval_shape(layout.traced_rows, jax.eval_shape(plain, like))
        which = jax.ShapeDtypeStruct((width,), bool)
        rows, which = devices.shapes((rows, which), RUNS)
        advance = devices.jit(block, (RUNS, RUNS, NONE), (RUNS, RUNS, RUNS))
        looking = pool.submit(devices.jit(look, (RUNS, RUNS), RUNS).lower(rows, which).compile)
        advancing = pool.submit(advance.lower(rows, which, budget).compile)
    looked, advanced = looking.result(), advancing.result()
    # No run: a GPU's driver translates the kernels of a program when it first runs.
    none = devices.put((np.zeros(rows.shape, rows.dtype), np.zeros(width, bool)), RUNS)
    jax.block_until_ready(advanced(*none, budget))
    return Movers(advanced, looked, rides)


def _counts(after: RunState, metrics: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns what a block of updates counted, as ``history.Measured`` has it."""
    broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
    return {
        "updates": after.train_states.num_updates,
        "env_steps": after.train_states.env_steps,
        "nonfinite": jnp.sum(broken & metrics["active"], axis=0, dtype=jnp.int32),
    }

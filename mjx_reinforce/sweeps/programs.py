"""The compiled programs of a group: those of a run, for slots of runs on all devices."""

import dataclasses
import functools
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Environment, PyTree
from mjx_reinforce.engine.devices import NONE, RUNS, Devices
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning import counts
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.settings.defaults import num_cores
from mjx_reinforce.sweeps.layout import StateRows, pack_slots
from mjx_reinforce.training.block import BuildLearner
from mjx_reinforce.training.programs import Programs, compiling, programs_of
from mjx_reinforce.training.state import Budget, RunState, Seed, budget_of


@dataclasses.dataclass
class Stopwatch:
    """Where the time of a sweep goes (s).

    compiling: with nothing trained beside it
    running: training and evaluating
    """

    compiling: float = 0.0
    running: float = 0.0

    def wait(self, compiled: Future) -> Any:
        """Returns a program, once it is compiled."""
        began = time.perf_counter()
        program = compiled.result()
        self.compiling += time.perf_counter() - began
        return program


def one_ahead(tasks: Sequence[Callable[[], Any]], clock: Stopwatch) -> Iterator[Any]:
    """Yields the results of tasks in order; each begins when the one before is handed out."""
    if not tasks:
        return
    ahead = started(tasks[0])
    for task in tasks[1:]:
        result = clock.wait(ahead)
        ahead = started(task)
        yield result
    yield clock.wait(ahead)


def started(task: Callable[[], Any]) -> Future:
    """Returns the result to come of a task, which begins in a thread of its own.

    Python waits for it before it exits: a compiler that is cut off there ends the process.
    """
    return ThreadPoolExecutor(1).submit(task)


class Measured(NamedTuple):
    """One evaluation of some runs, and the block of updates after it.

    runs: [n] their numbers
    values: [n] each: ``eval_return``, and ``eval_steps``, those of all its episodes; of runs that
      then made updates also ``updates`` and ``env_steps`` since the start, and ``nonfinite``, how
      many updates of the block met numbers that are not finite
    """

    runs: np.ndarray
    values: Arrays


#: What ``Measured`` has of a run's counts since the start.
_COUNTS = ("updates", "env_steps")
#: And of an evaluation.
_LOOKED = ("eval_return", "eval_steps")


class Slot(NamedTuple):
    """The compiled programs of one slot. States are rows of bytes, see ``layout.StateRows``.

    advance: (states [W, B], budget, which lanes have a run [W]) -> (states [W, B], which runs made
      an update [W], and what ``Measured`` has of updates [W], and of evaluations where
      these ride), as ``Programs.advance``
    evaluate: (states [W, B], which [W]) -> what ``Measured`` has of evaluations [W]
    """

    advance: Callable[..., tuple[jax.Array, jax.Array, dict[str, jax.Array]]]
    evaluate: Callable[[jax.Array, jax.Array], dict[str, jax.Array]]


class SlotPrograms(NamedTuple):
    """The compiled programs of a group. States of runs [R, B] are on the host between them.

    first: (seed, the numbers [W] of the runs' seeds, settings [W] each) -> the first
      states [W, B], where W is the greatest width
    slots: by their width, the widest first; the narrower ones may still be compiling
    rides: as ``Programs.rides``
    config: the settings of the group
    limits: the budget of each run, on all devices
    devices: among which a slot is divided
    layout: of the bytes of states
    clock: which counts the time that passes until a narrower slot's are there
    """

    first: Callable[..., jax.Array]
    slots: dict[int, "Future[Slot]"]
    rides: bool
    config: Config
    limits: Budget
    devices: Devices
    layout: StateRows
    clock: Stopwatch

    def begin(self, numbers: np.ndarray, settings: Arrays) -> np.ndarray:
        """Returns the first states [R, B] of runs, from the numbers [R] of their seeds.

        ``settings`` [R] each are those that are traced.
        """
        width, count, slots = max(self.slots), len(numbers), []
        given = {"numbers": numbers.astype(np.uint32)}
        given |= {name: x.astype(jnp.result_type(float)) for name, x in settings.items()}
        for start in range(0, count, width):
            index = np.minimum(np.arange(start, start + width), count - 1)
            put = self._put({name: x[index] for name, x in given.items()})
            seed = self.devices.put(np.uint32(self.config.seed), NONE)
            slots.append(self.first(seed, put.pop("numbers"), put))
        return np.concatenate(jax.device_get(slots))[:count]

    def advance(
        self, states: np.ndarray, training: np.ndarray, lengths: np.ndarray, blocks: int
    ) -> list[Measured]:
        """Evaluates the runs that still train and makes a block of updates, several times.

        Args:
          states: [R, B] of all runs; changed.
          training: [R] which of them still train; at least one does.
          lengths: [R] about how long their episodes are, see ``layout.pack_slots``.
          blocks: how many, where one of the narrowest slots holds these runs. Else they are packed
            again after one.

        Returns:
          What each block measured, of the runs that made an update; none without any.
        """
        lanes, programs = self._pack(training, lengths)
        count = blocks if lanes.shape == (1, min(self.slots)) else 1

        def move(runs: np.ndarray) -> Any:
            measured = []
            slot, which = self._put((states[runs], runs >= 0))
            for _ in range(count):  # the host does not wait for any
                looked = {} if self.rides else programs.evaluate(slot, which)
                slot, moved, used = programs.advance(slot, self.limits, which)
                measured.append((moved, looked | used))
            return jax.device_get((slot, measured))

        rows, measured = zip(*_side_by_side(move, lanes), strict=True)
        states[lanes[lanes >= 0]] = np.stack(rows)[lanes >= 0]
        measured = [_of_slots(lanes, block) for block in zip(*measured, strict=True)]
        return [block for block in measured if len(block.runs)]

    def evaluate(self, states: np.ndarray) -> Measured:
        """Evaluates the present policies of all runs [R, B]."""
        lanes, programs = self._pack(np.ones(len(states), bool), np.zeros(len(states)))

        def look(runs: np.ndarray) -> Any:
            slot, which = self._put((states[runs], runs >= 0))
            return runs >= 0, jax.device_get(programs.evaluate(slot, which))

        return _of_slots(lanes, _side_by_side(look, lanes))

    def _pack(self, chosen: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, Slot]:
        """Returns the runs of each slot, and what moves them."""
        lanes = pack_slots(chosen, lengths, list(self.slots), self.devices.count)
        return lanes, self.clock.wait(self.slots[lanes.shape[1]])

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


def _of_slots(lanes: np.ndarray, slots: Sequence[Any]) -> Measured:
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
    programs = programs_of(env, build_learner, horizon, config, 1, traced, sampled=False)
    layout, widest = StateRows(programs.like), widths[0]
    compile_for = functools.partial(_compile_slot, programs, layout, devices, threading.Lock())
    slots = {width: started(functools.partial(compile_for, width)) for width in widths}
    first = started(functools.partial(_compile_first, programs, layout, devices, widest))
    slots[widest].result()
    limits = devices.put(budget_of(config), NONE)
    return SlotPrograms(
        first.result(), slots, programs.rides, config, limits, devices, layout, clock
    )


def _compile_first(
    programs: Programs, layout: StateRows, devices: Devices, width: int
) -> Callable[..., jax.Array]:
    """Compiles ``SlotPrograms.first``."""

    def first(seed: Seed, numbers: jax.Array, settings: dict[str, jax.Array]) -> jax.Array:
        return layout.traced_rows(programs.begin(seed, numbers, settings)[0])

    seed = devices.shapes(jax.ShapeDtypeStruct((), np.uint32), NONE)
    numbers = jax.ShapeDtypeStruct((width,), np.uint32)
    given = devices.shapes((numbers, layout.shapes(width).settings), RUNS)
    return devices.jit(first, (NONE, RUNS, RUNS), RUNS).lower(seed, *given).compile()


def _compile_slot(
    programs: Programs, layout: StateRows, devices: Devices, tracing: threading.Lock, width: int
) -> Slot:
    """Compiles what moves slots of ``width`` runs.

    Programs are traced one after the other; the lock ``tracing`` is held meanwhile.
    """

    def advance(rows: jax.Array, budget: Budget, which: jax.Array) -> Any:
        before = layout.traced_states(rows)
        # A lane without a run has no budget.
        played = before.train_states.env_steps
        played = jnp.where(which[:, None], played, counts.from_int(MAX_COUNT))
        train_states = dataclasses.replace(before.train_states, env_steps=played)
        before = dataclasses.replace(before, train_states=train_states)
        after, block = programs.advance(before, budget, which)
        moved = jnp.any(block.metrics["active"], axis=0)
        measured = _counts(after, block.metrics) | _seen(block.looked)
        return layout.traced_rows(after), moved, measured

    def evaluate(rows: jax.Array, which: jax.Array) -> dict[str, jax.Array]:
        states = layout.traced_states(rows)
        return _seen(programs.evaluate(states.train_states.actor, states.eval_keys, which))

    no_run = np.zeros((width, layout.size), np.uint8), np.zeros(width, bool)
    rows, which = devices.put(no_run, RUNS)
    nothing = devices.put(Budget.of(0, 0), NONE)
    with ThreadPoolExecutor() as pool, tracing:
        evaluating, advancing = compiling(
            pool,
            (devices.jit(evaluate, (RUNS, RUNS), RUNS), (rows, which)),
            (devices.jit(advance, (RUNS, NONE, RUNS), (RUNS,) * 3), (rows, nothing, which)),
        )
    slot = Slot(advancing.result(), evaluating.result())
    # No run: a GPU's driver translates the kernels of a program when it first runs.
    jax.block_until_ready(slot.advance(rows, nothing, which))
    return slot


def _seen(measured: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns what ``Measured`` has of an evaluation."""
    return {name: measured[name] for name in _LOOKED if name in measured}


def _counts(after: RunState, metrics: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Returns what a block of updates counted, as ``Measured`` has it."""
    broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
    return {
        "updates": after.train_states.num_updates,
        "env_steps": after.train_states.env_steps,
        "nonfinite": jnp.sum(broken & metrics["active"], axis=0, dtype=jnp.int32),
    }

"""Programs compiled for slots of runs, and runs that move on in them.

A compiled program moves a fixed number of runs at once, a slot, and takes about as long as the
longest episode in it, whether the others still train or not. The seeds of a run share one slot. A
sweep has many: before a block of updates the runs that still train are sorted by the length of
their episodes and packed into slots again, and runs whose budget is used lie aside. The packing
follows from what a checkpoint holds, so that a resumed run packs as it would have.

What goes between the host and its devices is one array: a state has dozens of leaves, and each
costs as much to choose, to send and to fetch as all of them in one array.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.devices import NONE, RUNS, SECOND, executable
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import num_cores
from mjx_reinforce.training.memory import check_fits, check_room
from mjx_reinforce.training.programs import Programs
from mjx_reinforce.training.state import Budget, RunState, StateRows, budget_of, shape_of_all


def pack_slots(
    chosen: np.ndarray, lengths: np.ndarray, widths: Sequence[int], num_devices: int
) -> np.ndarray:
    """Returns the runs of each slot.

    Args:
      chosen: [R] which runs are packed, at least one.
      lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      widths: that slots may have, multiples of the number of devices, the most first. The first of
        which these runs fill more than a quarter of a slot is taken, or else the last: on an H200
        the wider slot takes as long as two of an eighth of its width.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [slots, width], the number of the run in each lane, -1 where there is none.
    """
    runs = np.flatnonzero(chosen)
    runs = runs[np.argsort(lengths[runs], kind="stable")]
    width = next((width for width in widths if len(runs) > width // 4), widths[-1])
    lanes = np.full((-(-len(runs) // width), width), -1)
    lanes.flat[: len(runs)] = runs
    dealt = lanes.reshape(len(lanes), width // num_devices, num_devices)
    return dealt.swapaxes(1, 2).reshape(lanes.shape)


@dataclasses.dataclass
class Stopwatch:
    """Where the time goes (s).

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


def started(task: Callable[[], Any]) -> Future:
    """Returns the result to come of a task, which begins in a thread of its own.

    Python waits for it before it exits: a compiler that is cut off there ends the process.
    """
    return ThreadPoolExecutor(1).submit(task)


class Measured(NamedTuple):
    """What an evaluation of runs measured, and the updates that followed it.

    runs: [n] their numbers, the least first
    metrics: [K, n] each, what ``block_of_updates`` measured in at most K updates; empty without any
    looked: [n] each, what ``block.evaluate`` returns of the policies before; empty without any
    """

    runs: np.ndarray
    metrics: Arrays
    looked: Arrays


class Slot(NamedTuple):
    """The compiled programs of one slot. States are rows of bytes, see ``StateRows``.

    advance: (states [W, B], budget, which lanes have a run [W], whether to evaluate []) -> (states
      [W, B], metrics [K, W] each, what was evaluated [W] each, if that rides), as in ``Measured``
    evaluate: (states [W, B], which [W]) -> what ``block.evaluate`` returns [W] each
    """

    advance: jax.stages.Compiled
    evaluate: jax.stages.Compiled


class Compiled(NamedTuple):
    """Programs that are compiled for slots of some widths.

    begin: (seed, the numbers [W] of the runs' seeds, settings [W] each) -> the first states [W, B],
      and the data of the keys [K, W] of the last test, where W is the greatest width
    slots: by their width, the widest first; the narrower ones may still be compiling
    programs: that were compiled
    config: the settings of the runs; one of those that differ stands for any value
    clock: counts the time that passes until a narrower slot's are there
    """

    begin: Callable[..., tuple[jax.Array, jax.Array]]
    slots: dict[int, "Future[Slot]"]
    programs: Programs
    config: Config
    clock: Stopwatch


class Slots:
    """Runs that move on in slots.

    Between blocks of updates their states are on the host. Those of a slot alone, such as the seeds
    of a run, are also where they were computed.

    budget: of each run
    layout: what is in a row of its states
    """

    def __init__(self, compiled: Compiled, numbers: np.ndarray, settings: Arrays | None = None):
        """Begins with the first states.

        Args:
          compiled: the programs.
          numbers: [R] of the runs' seeds.
          settings: [R] each, those that differ from run to run, if any do.
        """
        self._compiled, self._rides = compiled, compiled.programs.rides
        self._division, self.layout = compiled.programs.division, StateRows(compiled.programs.like)
        self.budget = budget_of(compiled.config)
        width, count = max(compiled.slots), len(numbers)
        kind = jnp.result_type(float)
        given = {name: x.astype(kind) for name, x in (settings or {}).items()}
        seed = self._division.put(np.uint32(compiled.config.seed), NONE)
        begun = []
        for start in range(0, count, width):
            lanes = np.minimum(np.arange(start, start + width), count - 1)
            own = self._division.put({name: x[lanes] for name, x in given.items()})
            placed = self._division.put(numbers[lanes].astype(np.uint32))
            begun.append(compiled.begin(seed, placed, own))
        rows, keys = zip(*jax.device_get(begun), strict=True)
        self._rows = np.concatenate(rows)[:count]
        #: The lanes of a slot alone, and its states after the last block.
        self._placed: tuple[np.ndarray, jax.Array] | None = None
        self._test_keys = np.concatenate(keys, axis=1)[:, :count]

    def states(self) -> RunState:
        """Returns the states of all runs, on the host in memory of their own."""
        return self.layout.states(self._rows)

    def rows(self) -> np.ndarray:
        """Returns the states as rows, in memory of their own."""
        return self._rows.copy()

    def restore(self, states: RunState | np.ndarray) -> None:
        """Takes other states of these runs, or rows of them."""
        rows = states.copy() if isinstance(states, np.ndarray) else self.layout.rows(states)
        self._rows, self._placed = rows, None

    def advance(
        self,
        chosen: np.ndarray | None = None,
        lengths: np.ndarray | None = None,
        *,
        look: bool = True,
        most: int = 1,
    ) -> list[Measured]:
        """Evaluates runs and makes a block of updates, several times.

        Args:
          chosen: [R] which of them, at least one; all by default.
          lengths: [R] about how long their episodes are, see ``pack_slots``.
          look: whether to evaluate before the first block.
          most: how many blocks, where one of the narrowest slots holds these runs. Else they are
            packed again after one.

        Returns:
          What was measured in each block in which a run made an update.
        """
        lanes, programs = self._pack(chosen, lengths)
        count = most if lanes.shape == (1, min(self._compiled.slots)) else 1
        budget = self._division.put(tuple(self.budget), NONE)

        def move(runs: np.ndarray) -> Any:
            slot, which = self._put(runs), self._division.put(runs >= 0)
            blocks, looks = [], look
            for _ in range(count):  # the host does not wait for any
                alone = programs.evaluate(slot, which) if looks and not self._rides else {}
                asked = self._division.put(np.bool_(looks), NONE)
                slot, metrics, riding = programs.advance(slot, budget, which, asked)
                blocks.append((metrics, alone | (riding if looks else {})))
                looks = True
            return slot, *jax.device_get((slot, blocks))

        placed, rows, blocks = zip(*_side_by_side(move, lanes), strict=True)
        for runs, moved in zip(lanes, rows, strict=True):
            self._rows[runs[runs >= 0]] = moved[runs >= 0]
        self._placed = (lanes[0], placed[0]) if len(lanes) == 1 else None
        every = [_of_slots(lanes, slots) for slots in zip(*blocks, strict=True)]
        return [measured for measured in every if measured.metrics["active"].any()]

    def seconds_to_evaluate(self) -> float:
        """Returns how long an evaluation takes (s) that does not ride with the updates."""
        began = time.perf_counter()
        return 0.0 if self._rides or not self.evaluate() else time.perf_counter() - began

    def evaluate(self) -> Measured:
        """Evaluates the present policies of all runs."""
        lanes, programs = self._pack()

        def look(runs: np.ndarray) -> Any:
            which = self._division.put(runs >= 0)
            return {}, jax.device_get(programs.evaluate(self._put(runs), which))

        return _of_slots(lanes, _side_by_side(look, lanes))

    def test(self, actor: Actor) -> Arrays:
        """Returns what ``block.evaluate`` does of policies [R, ...], on starts of their own.

        There are ``test_episodes`` of them, rounded up to whole evaluations.
        """
        kept, every = self._rows, []
        states = self.states()
        tested = dataclasses.replace(states.train_states, actor=actor)
        for keys in map(jax.random.wrap_key_data, self._test_keys):
            self.restore(dataclasses.replace(states, train_states=tested, eval_keys=keys))
            every.append(self.evaluate().looked)
        self._rows, self._placed = kept, None
        return {
            name: (np.sum if name.endswith("steps") else np.mean)([x[name] for x in every], axis=0)
            for name in every[0]
        }

    def _put(self, runs: np.ndarray) -> jax.Array:
        """Returns the states of a slot's runs, on the device."""
        if self._placed is not None and np.array_equal(self._placed[0], runs):
            return self._placed[1]
        return self._division.put(self._rows[runs])

    def _pack(
        self, chosen: np.ndarray | None = None, lengths: np.ndarray | None = None
    ) -> tuple[np.ndarray, Slot]:
        """Returns the runs of each slot, and what moves them."""
        slots, num_runs = self._compiled.slots, len(self._rows)
        chosen = np.ones(num_runs, bool) if chosen is None else chosen
        lengths = np.zeros(num_runs) if lengths is None else lengths
        lanes = pack_slots(chosen, lengths, list(slots), self._division.seeds)
        return lanes, self._compiled.clock.wait(slots[lanes.shape[1]])


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


def _of_slots(lanes: np.ndarray, slots: Sequence[tuple[Arrays, Arrays]]) -> Measured:
    """Returns a block, its runs in order, from the metrics and the evaluations of its slots."""
    runs = lanes.reshape(-1)
    order = np.argsort(runs, kind="stable")[np.sum(runs < 0) :]
    metrics, looked = (
        {name: np.concatenate([x[name] for x in each], axis=-1)[..., order] for name in each[0]}
        for each in zip(*slots, strict=True)
    )
    return Measured(runs[order], metrics, looked)


def compile_slots(
    programs: Programs,
    config: Config,
    widths: Sequence[int],
    clock: Stopwatch | None = None,
) -> Compiled:
    """Compiles programs for the widest slot, and begins with the narrower ones.

    These are traced while the widest are compiled: a sweep of some seconds soon needs them.

    Args:
      programs: of the runs.
      config: see ``Compiled``.
      widths: how many runs a slot may have, the most first; multiples of the devices that have
        runs of their own.
      clock: see ``Compiled``.

    Raises:
      ValueError: the widest slot does not fit into memory.
    """
    layout = StateRows(programs.like)
    begin = started(functools.partial(_compile_begin, programs, widths[0]))
    widest = started(_trace_slot(programs, layout, widths[0]))
    slots = {widths[0]: widest}
    for width in widths[1:]:
        slots[width] = started(lambda width=width: _trace_slot(programs, layout, width)())
    widest.result()
    return Compiled(begin.result(), slots, programs, config, clock or Stopwatch())


def compile_run(programs: Programs, config: Config) -> Slots:
    """Returns the seeds of a run before the first update, in one slot.

    Args:
      programs: of the run.
      config: its settings.
    """
    widths = [programs.division.lanes(config.num_seeds)]
    compiled = compile_slots(programs, config, widths)
    return Slots(compiled, config.first_seed + np.arange(config.num_seeds))


def _compile_begin(programs: Programs, width: int) -> Callable[..., Any]:
    """Compiles ``Compiled.begin``."""
    division = programs.division
    seed = division.shapes(jax.ShapeDtypeStruct((), np.uint32), NONE)
    numbers = jax.ShapeDtypeStruct((width,), np.uint32)
    given = division.shapes((numbers, shape_of_all(programs.like, width).settings), RUNS)
    program = division.jit(programs.begin, (NONE, RUNS, RUNS), (RUNS, SECOND))
    return executable(program.lower(seed, *given))


def _trace_slot(programs: Programs, layout: StateRows, width: int) -> Callable[[], Slot]:
    """Traces what moves slots of ``width`` runs; returns what waits until it is compiled."""
    division = programs.division
    check_room(2.0 * width * layout.size)
    rows, which = division.put((np.zeros((width, layout.size), np.uint8), np.zeros(width, bool)))
    nothing, no_look = division.put((tuple(Budget.of(0, 0)), np.bool_(False)), NONE)
    given = rows, nothing, which, no_look
    specs = (RUNS, NONE, RUNS, NONE), (RUNS, SECOND, RUNS)
    looking = division.jit(programs.evaluate, (RUNS, RUNS), RUNS).lower(rows, which)
    evaluating = started(functools.partial(executable, looking))
    updating = division.jit(programs.advance, *specs, by_episodes=True).lower(*given)
    advancing = started(functools.partial(executable, updating))

    def wait() -> Slot:
        slot = Slot(advancing.result(), evaluating.result())
        check_fits(slot.advance)
        check_fits(slot.evaluate)
        # No run: a GPU's driver translates the kernels of a program when it first runs.
        jax.block_until_ready(slot.advance(*given))
        return slot

    return wait

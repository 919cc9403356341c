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

from mjx_reinforce.engine.devices import NONE, RUNS, SECOND, check_room, executable
from mjx_reinforce.engine.gpu import seam as gpu_seam
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import num_cores
from mjx_reinforce.training.programs import Programs
from mjx_reinforce.training.record import Measured
from mjx_reinforce.training.state import Budget, RunState, StateRows, shape_of_all


def pack_slots(
    is_packed: np.ndarray, episode_lengths: np.ndarray, width: int, num_devices: int
) -> np.ndarray:
    """Returns the runs of each slot.

    Args:
      is_packed: [R] which runs are packed, at least one.
      episode_lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      width: of a slot, a multiple of the number of devices.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [slots, width], the number of the run in each place, -1 where there is none.
    """
    runs = np.flatnonzero(is_packed)
    # A slot takes as long as its longest episode: runs of about equal lengths share one.
    runs = runs[np.argsort(episode_lengths[runs], kind="stable")]
    slots = np.full((-(-len(runs) // width), width), -1)
    slots.flat[: len(runs)] = runs
    # A device has a contiguous share of a slot. Runs are dealt to the devices in turn, so that the
    # empty places of the last slot are not all of one device.
    runs_of_devices = slots.reshape(len(slots), width // num_devices, num_devices)
    return runs_of_devices.swapaxes(1, 2).reshape(slots.shape)


@dataclasses.dataclass
class Stopwatch:
    """Where the time goes (s).

    began: when
    computed: by all threads of this process before that
    compiling: with nothing trained beside it
    """

    began: float = dataclasses.field(default_factory=time.perf_counter)
    computed: float = dataclasses.field(default_factory=time.process_time)
    compiling: float = 0.0

    def running(self) -> float:
        """Returns the rest of the time: training and evaluating."""
        return time.perf_counter() - self.began - self.compiling

    def wait(self, compile: Callable[[], Any]) -> Any:
        """Returns a program, compiled here or elsewhere."""
        start = time.perf_counter()
        program = compile()
        self.compiling += time.perf_counter() - start
        return program


def started(task: Callable[[], Any]) -> Future:
    """Returns the result to come of a task, which begins in a thread of its own.

    Python waits for it before it exits: a compiler that is cut off there ends the process.
    """
    return ThreadPoolExecutor(1).submit(task)


class Compiled(NamedTuple):
    """Programs that are compiled for slots of W runs. States are rows of bytes, see ``StateRows``.

    begin: (seed, the numbers [W] of the runs' seeds, settings [W] each) -> the first states [W, B],
      and the data of the keys [K, W] of the last test
    advance: (states [W, B], budget, which places have a run [W], whether to evaluate []) -> (states
      [W, B], metrics [K, W] each, what was evaluated [W] each, if it evaluates), as in
      ``Measured``
    evaluate: (states [W, B], which [W]) -> what ``programs.evaluate`` returns [W] each
    width: W, the runs of a slot
    programs: that were compiled
    config: the settings of the runs; one of those that differ stands for any value
    """

    begin: Callable[..., tuple[jax.Array, jax.Array]]
    advance: jax.stages.Compiled
    evaluate: jax.stages.Compiled
    width: int
    programs: Programs
    config: Config


class Slots:
    """Runs that move on in slots.

    Between blocks of updates their states are on the host. Those of a slot alone, such as the seeds
    of a run, are also where they were computed.

    budget: of each run
    layout: what is in a row of its states
    """

    def __init__(
        self, compiled: Compiled, seed_numbers: np.ndarray, settings: Arrays | None = None
    ):
        """Begins with the first states.

        Args:
          compiled: the programs.
          seed_numbers: [R] of the runs' seeds.
          settings: [R] each, those that differ from run to run, if any do.
        """
        programs = compiled.programs
        division = programs.division
        self._compiled = compiled
        self._advance_evaluates = programs.advance_evaluates
        self._division = division
        self.layout = StateRows(programs.like)
        self.budget = Budget.of(compiled.config.env_steps, compiled.config.max_updates)
        slot_width = compiled.width
        num_runs = len(seed_numbers)
        dtype = jnp.result_type(float)
        settings = {name: values.astype(dtype) for name, values in (settings or {}).items()}
        seed = division.put(np.uint32(compiled.config.seed), NONE)
        first_slots = []
        # The last slot may be wider than what is left of the runs: its last run fills it up, and
        # is cut off again below. The order of runs changes nothing: each has its number's keys.
        for start in range(0, num_runs, slot_width):
            runs = np.minimum(np.arange(start, start + slot_width), num_runs - 1)
            slot_settings = division.put({name: values[runs] for name, values in settings.items()})
            slot_numbers = division.put(seed_numbers[runs].astype(np.uint32))
            first_slots.append(compiled.begin(seed, slot_numbers, slot_settings))
        rows, keys = zip(*jax.device_get(first_slots), strict=True)
        self._rows = np.concatenate(rows)[:num_runs]
        #: The runs of a slot alone, and its states after the last block.
        self._placed: tuple[np.ndarray, jax.Array] | None = None
        self._test_keys = np.concatenate(keys, axis=1)[:, :num_runs]

    def states(self) -> RunState:
        """Returns the states of all runs, on the host in memory of their own."""
        return self.layout.states(self._rows)

    def rows(self) -> np.ndarray:
        """Returns the states as rows, in memory of their own."""
        return self._rows.copy()

    def restore(self, states: RunState | np.ndarray) -> None:
        """Takes other states of these runs, or rows of them."""
        if isinstance(states, np.ndarray):
            self._rows = states.copy()
        else:
            self._rows = self.layout.rows(states)
        self._placed = None  # what is on the device is of the old states

    def advance(
        self,
        is_advanced: np.ndarray | None = None,
        episode_lengths: np.ndarray | None = None,
        *,
        evaluate: bool = True,
        max_blocks: int = 1,
    ) -> list[Measured]:
        """Evaluates runs and makes a block of updates, several times.

        Args:
          is_advanced: [R] which of them, at least one; all by default.
          episode_lengths: [R] about how long their episodes are, see ``pack_slots``.
          evaluate: whether to evaluate before the first block.
          max_blocks: how many blocks, where a slot holds these runs. Else they are packed again
            after one.

        Returns:
          What was measured in each block in which a run made an update.
        """
        slots = self._pack(is_advanced, episode_lengths)
        programs = self._compiled
        num_blocks = max_blocks if len(slots) == 1 else 1
        budget = self._division.put(tuple(self.budget), NONE)

        def advance_slot(runs: np.ndarray) -> Any:
            """Moves one slot; returns its states on the device, on the host, and its blocks."""
            states = self._put(runs)
            occupied = self._division.put(runs >= 0)
            blocks = []
            evaluation_due = evaluate
            # Calls return before the device is done, and nothing here reads a result: the device
            # goes from block to block without waiting for the host, which fetches all at the end.
            for _ in range(num_blocks):
                eval_metrics = {}
                if evaluation_due and not self._advance_evaluates:
                    eval_metrics = programs.evaluate(states, occupied)
                flag = self._division.put(np.bool_(evaluation_due), NONE)
                states, metrics, launch_metrics = programs.advance(states, budget, occupied, flag)
                # Without an evaluation a program returns its arrays all the same, and they say
                # nothing.
                if evaluation_due:
                    eval_metrics |= launch_metrics
                blocks.append((metrics, eval_metrics))
                evaluation_due = True  # the block has changed the policies
            return states, *jax.device_get((states, blocks))

        device_states, rows, blocks = zip(*_side_by_side(advance_slot, slots), strict=True)
        for runs, slot_rows in zip(slots, rows, strict=True):
            self._rows[runs[runs >= 0]] = slot_rows[runs >= 0]
        # The states of a slot alone stay on the device: the next block has the same runs.
        self._placed = (slots[0], device_states[0]) if len(slots) == 1 else None
        # A slot has its blocks one after the other; a block is joined over its slots. Blocks after
        # the end of all runs made no update.
        joined_blocks = [_of_slots(slots, block) for block in zip(*blocks, strict=True)]
        return [measured for measured in joined_blocks if measured.metrics["active"].any()]

    def seconds_to_evaluate(self) -> float:
        """Returns how long an evaluation takes (s) that shares no launch with the updates."""
        if self._advance_evaluates:
            return 0.0
        start = time.perf_counter()
        self.evaluate()
        return time.perf_counter() - start

    def evaluate(self) -> Measured:
        """Evaluates the present policies of all runs."""
        slots = self._pack()
        programs = self._compiled

        def evaluate_slot(runs: np.ndarray) -> Any:
            occupied = self._division.put(runs >= 0)
            return {}, jax.device_get(programs.evaluate(self._put(runs), occupied))

        return _of_slots(slots, _side_by_side(evaluate_slot, slots))

    def test(self, actor: Actor) -> Arrays:
        """Returns what ``programs.evaluate`` does of policies [R, ...], on starts of their own.

        There are ``test_episodes`` of them, rounded up to a multiple of ``eval_episodes``.
        """
        rows = self._rows
        states = self.states()
        train_states = dataclasses.replace(states.train_states, actor=actor)
        evaluations = []
        # The compiled evaluation reads its policies and keys from the states: for the test they
        # have these, and are put back afterwards.
        for keys in map(jax.random.wrap_key_data, self._test_keys):
            self.restore(dataclasses.replace(states, train_states=train_states, eval_keys=keys))
            evaluations.append(self.evaluate().eval_metrics)
        self._rows = rows
        self._placed = None
        test_metrics = {}
        for name in evaluations[0]:
            reduction = np.sum if name.endswith("steps") else np.mean
            test_metrics[name] = reduction([evaluation[name] for evaluation in evaluations], axis=0)
        return test_metrics

    def _put(self, runs: np.ndarray) -> jax.Array:
        """Returns the states of a slot's runs, on the device."""
        if self._placed is not None:
            placed_runs, placed_states = self._placed
            if np.array_equal(placed_runs, runs):
                return placed_states
        # An empty place, -1, has the states of the last run: some that are valid. Programs are told
        # which places have a run, and what comes out of the others is left out.
        return self._division.put(self._rows[runs])

    def _pack(
        self, is_packed: np.ndarray | None = None, episode_lengths: np.ndarray | None = None
    ) -> np.ndarray:
        """Returns the runs of each slot."""
        num_runs = len(self._rows)
        if is_packed is None:
            is_packed = np.ones(num_runs, bool)
        if episode_lengths is None:
            episode_lengths = np.zeros(num_runs)
        return pack_slots(is_packed, episode_lengths, self._compiled.width, self._division.seeds)


def _side_by_side(advance_slot: Callable[[np.ndarray], Any], slots: np.ndarray) -> list[Any]:
    """Returns the results for all slots [slots, width], as many at once as there are cores.

    A slot alone leaves some of the cores waiting for each other, and its results are fetched
    while the next one is moved.
    """
    if len(slots) == 1:
        return [advance_slot(slots[0])]
    return list(_threads().map(advance_slot, slots))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Returns one thread a core; to start them takes milliseconds."""
    return ThreadPoolExecutor(num_cores())


def _of_slots(slots: np.ndarray, measured: Sequence[tuple[Arrays, Arrays]]) -> Measured:
    """Returns a block, its runs in order, from the metrics and the evaluations of its slots.

    Args:
      slots: [slots, width] the runs of each, -1 where there is none.
      measured: for each slot its metrics and its evaluation, [..., width] each.
    """
    runs = slots.reshape(-1)
    # Empty places, -1, are sorted to the front and cut off.
    order = np.argsort(runs, kind="stable")[np.sum(runs < 0) :]
    metrics, eval_metrics = (
        {name: np.concatenate([x[name] for x in group], axis=-1)[..., order] for name in group[0]}
        for group in zip(*measured, strict=True)
    )
    return Measured(runs[order], metrics, eval_metrics)


def compile_slots(programs: Programs, config: Config, width: int) -> Compiled:
    """Compiles programs for slots.

    Args:
      programs: of the runs.
      config: see ``Compiled``.
      width: how many runs a slot has; a multiple of the devices that have runs of their own.

    Raises:
      ValueError: a slot does not fit into memory.
    """
    division = programs.division
    row_bytes = StateRows(programs.like).size
    check_room(2.0 * width * row_bytes)  # the states before a block of updates, and after it
    rows, occupied = division.put((np.zeros((width, row_bytes), np.uint8), np.zeros(width, bool)))
    no_budget, no_evaluation = division.put((tuple(Budget.of(0, 0)), np.bool_(False)), NONE)
    # C MuJoCo takes nearly all the time of its programs, however well XLA compiles the rest. At
    # XLA's own level a quadruped's took 28 s on two cores, not 7 s, and played no faster.
    cpu_level = 0 if programs.calls_c else None
    # XLA compiles without Python's lock: while one program compiles in a thread, the next one is
    # traced here. Updates compile the longest, and so come first.
    advance_jit = division.jit(
        programs.kept("advance"), (RUNS, NONE, RUNS, NONE), (RUNS, SECOND, RUNS), by_episodes=True
    )
    advance_lowered = advance_jit.lower(rows, no_budget, occupied, no_evaluation)
    advance_task = started(functools.partial(executable, advance_lowered, cpu_level))
    evaluate_jit = division.jit(programs.kept("evaluate"), (RUNS, RUNS), RUNS)
    evaluate_lowered = evaluate_jit.lower(rows, occupied)
    evaluate_task = started(functools.partial(executable, evaluate_lowered, cpu_level))
    begin = _compile_begin(programs, width, cpu_level)
    advance = advance_task.result()
    evaluate = evaluate_task.result()
    check_fits(advance)
    check_fits(evaluate)
    gpu_seam.wait_for_kernels()
    # Without a run: a GPU's driver translates the kernels of a program when it first runs.
    jax.block_until_ready(advance(rows, no_budget, occupied, no_evaluation))
    return Compiled(begin, advance, evaluate, width, programs, config)


def _compile_begin(programs: Programs, width: int, cpu_level: int | None) -> Callable[..., Any]:
    """Compiles ``Compiled.begin``; ``cpu_level`` is that of ``executable``."""
    division = programs.division
    seed = division.shapes(jax.ShapeDtypeStruct((), np.uint32), NONE)
    seed_numbers = division.shapes(jax.ShapeDtypeStruct((width,), np.uint32), RUNS)
    settings = division.shapes(shape_of_all(programs.like, width).settings, RUNS)
    program = division.jit(programs.kept("begin"), (NONE, RUNS, RUNS), (RUNS, SECOND))
    return executable(program.lower(seed, seed_numbers, settings), cpu_level)


def check_fits(program: jax.stages.Compiled) -> None:
    """Raises ValueError if a program's arrays need more memory than there is."""
    memory = program.memory_analysis()
    if memory is None:  # not every backend knows
        return
    array_bytes = memory.argument_size_in_bytes + memory.output_size_in_bytes
    check_room(array_bytes + memory.temp_size_in_bytes - memory.alias_size_in_bytes)

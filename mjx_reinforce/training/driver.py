"""Runs as they go on: their programs move them, and observers see what they measure."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np

from mjx_reinforce.engine import counts
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training import race
from mjx_reinforce.training.failures import HOPELESS
from mjx_reinforce.training.minutes import Deadline, env_steps_in
from mjx_reinforce.training.record import Measured, Record
from mjx_reinforce.training.resume import Checkpoint, check_arrays, decisive
from mjx_reinforce.training.run_record import RunRecord
from mjx_reinforce.training.slots import Slots, Stopwatch
from mjx_reinforce.training.state import (
    Best,
    Budget,
    StateRows,
    begin_with,
    copied,
    first_best,
    keep_best,
)


class Evaluation(NamedTuple):
    """What an evaluation of the policies of S seeds measured.

    Attributes:
      updates: [S] int64, how many updates had made the policies
      env_steps: [S] int64, how many env steps these had played
      seconds: wall time since the end of compilation (s)
      measured: [S] each, what ``mjx_reinforce.evaluate`` returns, such as ``eval_return``
      actor: [S, ...] the policies that were evaluated, on the host
      train_states: [S, ...] the newest states of training, on the host; at most one block of
        updates further than ``actor``

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> seen = []
      >>> results = mr.run(config, observers=[seen.append], quiet=True)
      >>> seen[-1].measured["eval_return"].shape
      (2,)
    """

    updates: np.ndarray
    env_steps: np.ndarray
    seconds: float
    measured: Arrays
    actor: Actor
    train_states: TrainState


#: What an observer sees: any runs, or a run by itself.
DriverT = TypeVar("DriverT", bound="Driver")


class Observer(Generic[DriverT]):
    """Sees runs go on, and changes nothing of them; what a subclass leaves out does nothing."""

    def began(self, driver: DriverT) -> None:
        """Called before the first update, also of runs that go on."""

    def updated(self, driver: DriverT, num_nonfinite: np.ndarray) -> None:
        """Called after each block of updates.

        Args:
          driver: of the runs, after the block.
          num_nonfinite: [S] how many updates of the last block met numbers which are not finite.
        """

    def evaluated(self, driver: DriverT, evaluation: Evaluation, rows: Arrays) -> None:
        """Called after each evaluation, with what it measured and its rows in metrics.csv."""

    def ended(self, driver: DriverT) -> None:
        """Called after the last block of updates and its evaluation, before the last test."""

    def finished(self, driver: DriverT, summary: dict[str, Any]) -> None:
        """Called after the last test, with the contents of summary.json, or of sweep.json."""


#: The host need not look at runs more often than this (s). Between short blocks the devices would
#: wait for it.
_CALL_SECONDS = 0.25


def check_layout(checkpoint: Checkpoint, slots: Slots) -> None:
    """Raises ValueError for a checkpoint of another program."""
    rows, own_rows = checkpoint.states, slots.rows()
    is_other = rows.shape != own_rows.shape or rows.dtype != own_rows.dtype
    if is_other or checkpoint.layout != slots.layout.layout:
        raise ValueError(
            "the states in the checkpoint do not fit this version of the program; resume with "
            "the version that wrote it"
        )


class Runs(NamedTuple):
    """Runs of a sweep that move on together; those of a run are its seeds.

    name: of these, for their files
    member: [R] the configuration of each run, counted within its group
    configuration: [R] the same, counted in the sweep
    seed: [R]
    """

    name: str
    member: np.ndarray
    configuration: np.ndarray
    seed: np.ndarray


class Driver:
    """Trains runs, such as a chunk of a sweep's.

    config: the settings; one of those that differ from run to run stands for any value
    slots: what moves the runs
    record: what they have measured
    runs: which they are
    observers: who sees them, in this order
    ended: whether an observer asked for the end
    """

    def __init__(
        self,
        config: Config,
        slots: Slots,
        record: Record,
        runs: Runs,
        observers: Sequence[Observer[Any]] = (),
    ):
        """Begins before the first update, where the slots are."""
        self.config = config
        self.slots = slots
        self.record = record
        self.runs = runs
        self.observers = list(observers)
        self.ended = False
        self._began = time.perf_counter()
        #: Wall time at which the present policies were there (s).
        self._reached = 0.0

    def restore(self, checkpoint: Checkpoint) -> None:
        """Goes back to a checkpoint, or raises ValueError if it is another program's."""
        check_layout(checkpoint, self.slots)
        check_arrays(checkpoint, self.checkpoint())
        self.slots.restore(checkpoint.states)
        self.record.restore(checkpoint.record)
        # As if the run had not stopped: its clock goes on from the time in the checkpoint.
        self._began = time.perf_counter() - checkpoint.seconds
        self._reached = checkpoint.seconds

    def checkpoint(self) -> Checkpoint:
        """Returns what ``restore`` takes."""
        config = self.config
        # Best policies and metrics.csv are a run's, which fills them in; a sweep has neither.
        return Checkpoint(
            layout=self.slots.layout.layout,
            states=self.slots.rows(),
            best=np.zeros((0, 0), np.uint8),
            record=self.record.arrays(),
            seconds=self.seconds(),
            metrics_bytes=0,
            env_steps=config.env_steps,
            max_updates=config.max_updates,
            settings=decisive(config),
        )

    def seconds(self) -> float:
        """Returns the wall time since the beginning, without that of compiling."""
        return time.perf_counter() - self._began

    def updates(self) -> int:
        """Returns how many updates the run with the most has made."""
        return int(self.record.updates.max())

    def drive(self, interrupted: Callable[[], bool]) -> None:
        """Trains until the budget is used, nothing is finite, or someone asks for the end.

        Policies are evaluated with the updates that follow, and the last ones alone. A block that
        was interrupted is not evaluated, which may take minutes: the resumed runs do that.

        Args:
          interrupted: whether the runs are to end soon.
        """
        num_blocks = 1
        max_blocks = self._max_blocks()
        while not (self.ended or interrupted()):
            self._renew()
            evaluate = not self.record.is_evaluated()
            if self.record.over():
                # No updates follow with which the last policies could be evaluated.
                if evaluate:
                    self._take([self.slots.evaluate()])
                break
            self._cut()
            start = time.perf_counter()
            active, lengths = self.record.moved()
            blocks = self.slots.advance(active, lengths, evaluate=evaluate, max_blocks=num_blocks)
            # As many blocks at once as take ``_CALL_SECONDS`` at this speed. At most twice as many
            # as now: while a policy learns, episodes may become longer.
            timely_blocks = len(blocks) * _CALL_SECONDS / (time.perf_counter() - start)
            num_blocks = max(1, min(int(timely_blocks), 2 * len(blocks), max_blocks))
            self._take(blocks)

    def _renew(self) -> None:
        """Sets the budget of what follows; that of a sweep is one for all its time."""

    def _cut(self) -> None:
        """Drops policies of races where that is due; those of a sweep do not race."""

    def _max_blocks(self) -> int:
        """Returns how many blocks of updates are made before the host sees any of them."""
        return (self.config.checkpoint_every or MAX_COUNT) // self.config.eval_every

    def _take(self, blocks: list[Measured]) -> None:
        """Takes in evaluations and the updates that followed them."""
        num_nonfinite = np.zeros(0, int)
        for block in blocks:
            # The evaluation is of the policies before the block, so it is recorded before.
            if block.eval_metrics:
                self._take_evaluation(block)
            if block.metrics:
                num_nonfinite = self.record.add_updates(block)
        # All blocks came at once: observers see the last one alone.
        if blocks[0].metrics:
            self._reached = self.seconds()
            for observer in self.observers:
                observer.updated(self, num_nonfinite)

    def _take_evaluation(self, measured: Measured) -> None:
        """Takes in what the policies before a block return."""
        self.record.add_evaluation(measured, self._reached)


class RunDriver(Driver):
    """Trains the seeds of a run by itself, which has evaluations to show and best policies.

    config: the settings of the run, its horizon among them
    states: of training, on the host, of the R policies, see ``RunRecord``
    best: the best of each of these so far
    deadline: when it is to end, if its budget is in time
    """

    record: RunRecord
    deadline: Deadline | None = None

    def __init__(
        self,
        config: Config,
        slots: Slots,
        record: RunRecord,
        runs: Runs,
        observers: Sequence[Observer[Any]] = (),
    ):
        """Begins before the first update, where the slots are."""
        super().__init__(config, slots, record, runs, observers)
        self.states = self.slots.states()
        #: The states before the last block; its evaluation is of these.
        self._before = self.states
        self.best = first_best(self.states.train_states)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Goes back to a checkpoint, which has the best policies too."""
        super().restore(checkpoint)
        self.states = self.slots.states()
        self.best = StateRows(self.best).states(checkpoint.best)

    def checkpoint(self) -> Checkpoint:
        """Returns what ``restore`` takes."""
        return super().checkpoint()._replace(best=StateRows(self.best).rows(self.best))

    def drive(self, interrupted: Callable[[], bool]) -> None:
        """Trains as any runs; first, and where an observer ends them, they are evaluated alone.

        So that the first line is seen at once, where a block of updates takes half a minute.
        """
        if not self.record.begun():
            self._take([self.slots.evaluate()])
        super().drive(interrupted)
        # An observer that ends a run leaves the last block of updates without its evaluation.
        if self.ended and not self.record.is_evaluated():
            self._take([self.slots.evaluate()])

    def _renew(self) -> None:
        """Sets the budget of what follows: found anew if it is in time, or as it was recorded."""
        record = self.record
        num_updates = self.updates()
        env_steps = self.config.env_steps_at(num_updates)
        if self.deadline is not None and env_steps is not None:
            new_budget = self.deadline.budget(self.seconds(), record.env_steps, env_steps)
            if new_budget is not None:
                self.config = self.config.with_budget(num_updates, new_budget)
                env_steps = new_budget
        record.config = dataclasses.replace(self.config, env_steps=env_steps)
        self.slots.budget = Budget.of(env_steps, self.config.max_updates)

    def _cut(self) -> None:
        # Before a block, and so decided by what a checkpoint holds: a run that goes on cuts too.
        policy_sources = self.record.cut()
        if policy_sources is not None:
            self.slots.restore(copied(self.states, policy_sources))
            self.states = self.slots.states()

    def last_actors(self) -> Actor:
        """Returns the newest policy of each seed [S, ...]."""
        return _entries(self.states.train_states.actor, self.record.leaders())

    def best_actors(self) -> Actor:
        """Returns the policies of the seeds [S, ...] with the best evaluations."""
        return _entries(self.best.actor, self._best_rows())

    def _best_rows(self) -> np.ndarray:
        """Returns the number of the policy with the best evaluation of each seed [S]."""
        return race.leaders(self.best.eval_return, self.config.race)

    def _max_blocks(self) -> int:
        """Returns 1: ``_take`` has the states before one block and after it, none between."""
        return 1

    def _take(self, blocks: list[Measured]) -> None:
        self._before = self.states
        self.states = self.slots.states()
        super()._take(blocks)

    def _take_evaluation(self, measured: Measured) -> None:
        """Takes in what the policies before a block return, and keeps the best."""
        eval_metrics = measured.eval_metrics
        # It is of the policies with which the block began.
        actor = self._before.train_states.actor
        num_updates = self._before.train_states.num_updates
        present_best = Best(
            actor=actor, eval_return=eval_metrics["eval_return"], num_updates=num_updates
        )
        self.best = keep_best(self.best, present_best)
        rows = self.record.add_evaluation(measured, self._reached)
        leaders = self.record.leaders()
        evaluation = Evaluation(
            updates=counts.to_int(num_updates[leaders]),
            env_steps=self.record.played_steps(),
            seconds=self._reached,
            measured=_entries(eval_metrics, leaders),
            actor=_entries(actor, leaders),
            train_states=_entries(self.states.train_states, leaders),
        )
        for observer in self.observers:
            observer.evaluated(self, evaluation, rows)

    def test(self, interrupted: Callable[[], bool]) -> dict[str, Any]:
        """Plays the last and the best policies on starts used nowhere else, for summary.json.

        Choosing the best by its evaluations flatters these evaluations, but not the test.

        Args:
          interrupted: whether the run is to end soon; it is tested when it has been resumed.

        Returns:
          The returns of both, or nothing if it was interrupted.
        """
        returns = {}
        tested_policies = (
            ("final", self.states.train_states.actor, self.record.leaders()),
            ("best", self.best.actor, self._best_rows()),
        )
        for name, actor, rows in tested_policies:
            # Half a test is none: summary.json has both returns or neither.
            if interrupted():
                return {}
            eval_metrics = self.slots.test(actor)
            self.record.count_steps(eval_metrics)
            returns[f"{name}_test_returns"] = eval_metrics["eval_return"][rows].tolist()
        return returns

    def summary(self, engine: str, compile_seconds: float, test: dict[str, Any]) -> dict[str, Any]:
        """Returns the contents of summary.json, at the end of the run.

        Args:
          engine: the name of the engine that played.
          compile_seconds: wall time of compiling.
          test: from ``test``, empty if the run was interrupted.
        """
        # A run that was interrupted goes on when it is resumed, also one without hope: there it
        # is tested and stopped.
        status = {"status": "finished" if test else "interrupted"}
        if test and self.record.hopeless():
            status = {"status": "stopped", "reason": HOPELESS}
        return {
            **status,
            **self.record.summary(engine, compile_seconds, self.seconds()),
            "best_updates": counts.to_int(self.best.num_updates[self._best_rows()]).tolist(),
            **test,
        }


def _entries(leaves: Any, places: np.ndarray) -> Any:
    """Returns a pytree of some entries [S, ...] of leaves [R, ...]."""
    return jax.tree.map(lambda leaf: leaf[places], leaves)


def sweep_summary(
    contents: Mapping[str, Any], driver: Driver | None, clock: Stopwatch
) -> dict[str, Any]:
    """Returns the contents of sweep.json at the end.

    Args:
      contents: of sweep.json so far.
      driver: of the chunk that was trained last; None if nothing was left to train.
      clock: of this process.
    """
    is_done = driver is None or driver.record.done()
    return {
        **contents,
        "status": "finished" if is_done else "interrupted",
        # A sweep that was resumed has spent time before, which its sweep.json says.
        "compile_seconds": contents["compile_seconds"] + clock.compiling,
        "run_seconds": contents["run_seconds"] + clock.running(),
    }


def begin_run(
    config: Config,
    threshold: float | None,
    slots: Slots,
    runs: Runs,
    checkpoint: Checkpoint | None = None,
    actors: Actor | None = None,
    say: Callable[[str], None] = lambda text: None,
    observers: Sequence[Observer[Any]] = (),
    interrupted: Callable[[], bool] = lambda: False,
) -> RunDriver:
    """Returns a run before its first update.

    Args:
      config: its settings.
      threshold: the return that counts as solved, if any.
      slots: its seeds.
      runs: the same, by their numbers.
      checkpoint: from which it goes on, if any; an observer takes it back there.
      actors: [S, ...] with which it begins, if not with its own.
      say: shows a line to the user.
      observers: who sees it.
      interrupted: whether it is to end soon.
    """
    if checkpoint is not None:
        check_layout(checkpoint, slots)  # before a file is touched
    if actors is not None:
        slots.restore(begin_with(slots.states(), actors))
    deadline = None
    if config.minutes is not None:
        # From here on the budget is in env steps, so that a run that is resumed, or repeated with
        # its config.json, ends where this one does. The speed is that of the states from which it
        # goes on; what is trained to measure it is undone.
        start_time = time.perf_counter()
        first_rows = slots.rows()
        past = 0.0, 0.0, 0
        if checkpoint is not None:
            slots.restore(checkpoint.states)
            record = checkpoint.record
            past = checkpoint.seconds, record["env_steps"].mean(), int(record["updates"].max())
        seconds, past_steps, num_updates = past
        env_steps = env_steps_in(60 * config.minutes, slots, config, interrupted)
        slots.restore(first_rows)
        say(f"{config.minutes:g} min are at first about {env_steps:,} env steps per seed here")
        end = seconds + 60 * config.minutes - (time.perf_counter() - start_time)
        deadline = Deadline(seconds, end, past_steps)
        config = config.with_budget(num_updates, env_steps)
    slots.budget = Budget.of(config.env_steps_at(0), config.max_updates)
    driver = RunDriver(config, slots, RunRecord(config, threshold), runs, observers)
    driver.deadline = deadline
    return driver

"""Runs as they go on: their programs move them, and observers see what they measure."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training.checkpoint import Checkpoint
from mjx_reinforce.training.record import Cells, Record, RunRecord
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.slots import Measured, Slots
from mjx_reinforce.training.state import Best, StateRows, first_best, keep_best


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


#: The runs that an observer sees.
Seen = TypeVar("Seen", bound="Training")


class Observer(Generic[Seen]):
    """Sees runs go on, and changes nothing of them; what a subclass leaves out does nothing."""

    def began(self, driver: Seen) -> None:
        """Called before the first update, also of runs that go on."""

    def updated(self, driver: Seen, met: np.ndarray) -> None:
        """Called after each block of updates.

        Args:
          driver: of the runs.
          met: [S] how many of them met numbers which are not finite, of each seed; none in a sweep.
        """

    def evaluated(self, driver: Seen, evaluation: Evaluation, rows: Cells) -> None:
        """Called after each evaluation, with what it measured and its rows in metrics.csv."""

    def ended(self, driver: Seen) -> None:
        """Called after the last block of updates and its evaluation, before the last test."""

    def finished(self, driver: Seen, summary: dict[str, Any]) -> None:
        """Called after the last test, with the contents of summary.json, or of sweep.json."""


#: The host need not look at runs more often than this (s). Between short blocks the devices would
#: wait for it.
_SECONDS = 0.25


def drive(
    slots: Slots, record: Record, interrupted: Callable[[], bool], most: int = 1
) -> Iterator[list[Measured]]:
    """Moves runs on until they are over; yields what was measured, for the record to take in.

    Policies are evaluated with the updates that follow, and the last ones alone. A block that was
    interrupted is not evaluated, which may take minutes: the resumed runs do that.

    Args:
      slots: the runs.
      record: of what they measure. It takes in what is yielded before the next is asked for.
      interrupted: whether the end is to be soon.
      most: so many blocks of updates may be made at once, where they take no time.
    """
    blocks = 1
    while not interrupted():
        if record.over():
            if not record.is_evaluated():
                yield [slots.evaluate()]
            return
        began = time.perf_counter()
        measured = slots.advance(*record.moved(), look=not record.is_evaluated(), most=blocks)
        yield measured
        enough = len(measured) * _SECONDS / (time.perf_counter() - began)
        blocks = max(1, min(int(enough), 2 * len(measured), most))


def check_layout(found: Checkpoint, slots: Slots) -> None:
    """Raises ValueError for a checkpoint of another program."""
    if found.layout != slots.layout.layout:
        raise ValueError(
            "the states in the checkpoint do not fit this version of the program; resume with "
            "the version that wrote it"
        )


class Training:
    """Runs as they go on, such as a part of a sweep's.

    config: the settings; one of those that differ from run to run stands for any value
    slots: what moves the runs
    record: what they have measured
    observers: who sees them, in this order
    ended: whether an observer asked for the end
    """

    def __init__(
        self, config: Config, slots: Slots, record: Record, observers: Sequence[Observer[Any]] = ()
    ):
        """Begins before the first update, where the slots are."""
        self.config, self.slots, self.record = config, slots, record
        self.observers, self.ended = list(observers), False
        self._began = time.perf_counter()

    def restore(self, found: Checkpoint) -> None:
        """Goes back to a checkpoint, or raises ValueError if it is another program's."""
        check_layout(found, self.slots)
        self.slots.restore(found.states)
        self.record.restore(found.record)
        self._began = time.perf_counter() - found.seconds

    def checkpoint(self) -> Checkpoint:
        """Returns what ``restore`` takes."""
        config = self.config
        return Checkpoint(
            layout=self.slots.layout.layout,
            states=self.slots.rows(),
            best=np.zeros((0, 0), np.uint8),
            record=self.record.arrays(),
            seconds=self.seconds(),
            metrics_bytes=0,
            env_steps=config.env_steps,
            max_updates=config.max_updates,
        )

    def seconds(self) -> float:
        """Returns the wall time since the beginning, without that of compiling."""
        return time.perf_counter() - self._began

    def updates(self) -> int:
        """Returns how many updates the run with the most has made."""
        return int(self.record.updates.max())

    def drive(self, interrupted: Callable[[], bool]) -> None:
        """Trains until the budget is used, nothing is finite, or someone asks for the end.

        Args:
          interrupted: whether the runs are to end soon.
        """
        for blocks in drive(
            self.slots, self.record, lambda: self.ended or interrupted(), self._most()
        ):
            self._take(blocks)

    def _most(self) -> int:
        """Returns how many blocks of updates may be made before anyone looks."""
        return (self.config.checkpoint_every or MAX_COUNT) // self.config.eval_every

    def _take(self, blocks: list[Measured]) -> None:
        """Takes in evaluations and the updates after them."""
        self.record.add(blocks, self.seconds())
        if blocks[0].metrics:
            self._updated(np.zeros(0, int))

    def _updated(self, met: np.ndarray) -> None:
        for observer in self.observers:
            observer.updated(self, met)


class Driver(Training):
    """The seeds of a run as they go on.

    config: the settings of the run, its horizon among them
    states: of training, on the host
    best: the best policies so far
    """

    record: RunRecord

    def __init__(
        self,
        config: Config,
        slots: Slots,
        record: RunRecord,
        observers: Sequence[Observer[Any]] = (),
    ):
        """Begins before the first update, where the slots are."""
        super().__init__(config, slots, record, observers)
        self.states = slots.states()
        self.best = first_best(self.states.train_states)
        #: Wall time at which the present policies were there (s).
        self._reached = 0.0

    def restore(self, found: Checkpoint) -> None:
        """Goes back to a checkpoint, which has the best policies too."""
        super().restore(found)
        self.states, self.best = self.slots.states(), StateRows(self.best).states(found.best)
        self._reached = found.seconds

    def checkpoint(self) -> Checkpoint:
        """Returns what ``restore`` takes."""
        whole, settings = super().checkpoint(), recordable(self.config)
        return whole._replace(best=StateRows(self.best).rows(self.best), settings=settings)

    def drive(self, interrupted: Callable[[], bool]) -> None:
        """Trains as any runs; what was made before an observer's end is evaluated."""
        super().drive(interrupted)
        if not self.record.is_evaluated() and (self.ended or not self.record.begun()):
            self._take([self.slots.evaluate()])

    def _most(self) -> int:
        return 1

    def _take(self, blocks: list[Measured]) -> None:
        """Takes in an evaluation and the updates that followed it."""
        [measured] = blocks
        before, self.states = self.states.train_states, self.slots.states()
        if measured.looked:
            self._take_evaluation(before, measured.looked)
        if measured.metrics:
            met = self.record.add_updates(measured.metrics)
            self._reached = self.seconds()
            self._updated(met)

    def _take_evaluation(self, evaluated: TrainState, measured: Arrays) -> None:
        """Takes in what the policies of these states return, and keeps the best."""
        actor, num_updates = evaluated.actor, evaluated.num_updates
        returns = measured["eval_return"]
        present = Best(actor=actor, eval_return=returns, num_updates=num_updates)
        self.best = keep_best(self.best, present)
        rows = self.record.add_evaluation(measured, self._reached)
        evaluation = Evaluation(
            updates=counts.to_int(num_updates),
            env_steps=self.record.env_steps,
            seconds=self._reached,
            measured=measured,
            actor=actor,
            train_states=self.states.train_states,
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
        for name, actor in (("final", self.states.train_states.actor), ("best", self.best.actor)):
            if interrupted():
                return {}
            result = self.slots.test(actor)
            self.record.add_test(result)
            returns[f"{name}_test_returns"] = result["eval_return"].tolist()
        return returns

"""A run as it goes on: its programs move its state on, and observers see what it measures."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_reinforce.files import Arrays
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training.checkpoint import Checkpoint
from mjx_reinforce.training.programs import Looked, RunPrograms
from mjx_reinforce.training.record import Cells, RunRecord
from mjx_reinforce.training.state import RunState, budget_of


class Best(struct.PyTreeNode, kw_only=True):
    """The best policies so far.

    actor: [S, ...] each seed's
    eval_return: [S] what its evaluation returned; -inf before the first
    num_updates: [S, 2] how many updates the seed had made then, as ``counts`` has it
    """

    actor: Actor
    eval_return: Any
    num_updates: Any


def shape_of_best(train_states: TrainState) -> Best:
    """Returns the shapes of the best policies of states, or of their shapes."""
    num_updates = train_states.num_updates
    returns = jax.ShapeDtypeStruct(num_updates.shape[:1], jnp.result_type(float))
    return Best(actor=train_states.actor, eval_return=returns, num_updates=num_updates)


def first_best(train_states: TrainState) -> Best:
    """Returns the state before the first evaluation, in memory of its own."""
    returns = shape_of_best(train_states).eval_return
    actor, num_updates = jax.tree.map(np.array, (train_states.actor, train_states.num_updates))
    worst = np.full(returns.shape, -np.inf, returns.dtype)
    return Best(actor=actor, eval_return=worst, num_updates=num_updates)


def keep_best(best: Best, looked: Looked) -> Best:
    """Takes in an evaluation; of two that are equal, the later is the better.

    Args:
      best: so far.
      looked: the evaluation; a return that is not a number is never the best.
    """
    eval_return = looked.measured["eval_return"]
    present = Best(
        actor=looked.actor, eval_return=eval_return, num_updates=np.asarray(looked.num_updates)
    )
    better = eval_return >= np.asarray(best.eval_return)

    def choose(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, present, best)


class Evaluation(NamedTuple):
    """What an evaluation of the policies of S seeds measured.

    Attributes:
      updates: [S] int64, how many updates had made the policies
      env_steps: [S] int64, how many env steps these had played
      seconds: wall time since the end of compilation (s)
      measured: [S] each, what ``mjx_reinforce.evaluate`` returns, such as ``eval_return``
      actor: [S, ...] the policies that were evaluated, on the host
      train_states: [S, ...] the newest states of training, on the device; at most one block of
        updates further than ``actor``. The next block uses their memory again: copy what stays.

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


class Observer:
    """Sees a run go on, and changes nothing of it; what a subclass leaves out does nothing."""

    def updated(self, driver: "Driver", met: Arrays) -> None:
        """Called after each block of updates.

        Args:
          driver: of the run.
          met: the updates in it that met numbers which are not finite, as
            ``Record.add_updates`` returns them.
        """

    def evaluated(self, driver: "Driver", evaluation: Evaluation, rows: Cells) -> None:
        """Called after each evaluation, with what it measured and its rows in metrics.csv."""

    def ended(self, driver: "Driver") -> None:
        """Called after the last block of updates and its evaluation, before the last test."""

    def finished(self, driver: "Driver", summary: dict[str, Any]) -> None:
        """Called after the last test, with the contents of summary.json."""


class Training(Protocol):
    """What goes on block by block: a run, or a chunk of a sweep."""

    def over(self) -> bool:
        """Returns whether nothing is left to train."""
        ...

    def advance(self) -> None:
        """Makes a block of updates."""
        ...


def drive(training: Training, interrupted: Callable[[], bool]) -> bool:
    """Trains block by block; returns whether that ended, or was interrupted."""
    while not interrupted():
        if training.over():
            return True
        training.advance()
    return False


class Driver:
    """Moves a run on, block by block.

    config: the settings of the run, its horizon among them
    record: what it has measured
    state: of training
    best: the best policies so far
    ended: whether an observer asked for the end
    """

    def __init__(
        self,
        config: Config,
        programs: RunPrograms,
        record: RunRecord,
        state: RunState,
        best: Best,
        observers: Sequence[Observer] = (),
    ):
        """Takes what a run is made of, before its first update.

        Args:
          config: its settings.
          programs: what moves it on.
          record: what it measures.
          state: of training.
          best: the best policies so far.
          observers: who sees it go on, in this order.
        """
        self.config, self.programs, self.record = config, programs, record
        self.state, self.best, self.observers = state, best, list(observers)
        self.ended = False
        self._began = time.perf_counter()
        self._budget = budget_of(config)
        #: Wall time at which the present policies were there (s).
        self._reached = 0.0

    def restore(self, found: Checkpoint) -> None:
        """Goes back to a checkpoint."""
        self.state, self.best = found.state
        self.record.restore(found.record)
        self._began = time.perf_counter() - found.seconds
        self._reached = found.seconds

    def seconds(self) -> float:
        """Returns the wall time since the run began, without that of compiling."""
        return time.perf_counter() - self._began

    def updates(self) -> int:
        """Returns how many updates the seed with the most has made."""
        return int(self.record.updates.max())

    def drive(self, interrupted: Callable[[], bool]) -> None:
        """Trains until the budget is used, nothing is finite, or someone asks for the end.

        Policies are evaluated with the updates that follow. A block that was interrupted is not
        evaluated, which may take minutes: the resumed run does that.

        Args:
          interrupted: whether the run is to end soon.
        """
        ended = drive(self, interrupted)
        if not self.record.evaluated() and (ended or not self.record.begun()):
            self.evaluate()

    def over(self) -> bool:
        """Returns whether the budget is used, nothing is finite, or an observer wants the end."""
        return self.ended or self.record.finished() or self.record.hopeless()

    def advance(self) -> None:
        """Evaluates the present policies unless they were, and makes a block of updates."""
        look = not self.record.evaluated()
        self.state, metrics, looked = self.programs.advance(self.state, look, self._budget)
        if looked is not None:
            self._take(looked)
        met = self.record.add_updates(metrics)
        self._reached = self.seconds()
        for observer in self.observers:
            observer.updated(self, met)

    def evaluate(self) -> None:
        """Evaluates the present policies."""
        self._take(self.programs.evaluate(self.state))

    def _take(self, looked: Looked) -> None:
        """Takes in an evaluation, and keeps the best policies."""
        self.best = keep_best(self.best, looked)
        rows = self.record.add_evaluation(looked.measured, self._reached)
        evaluation = Evaluation(
            updates=counts.to_int(looked.num_updates),
            env_steps=self.record.env_steps,
            seconds=self._reached,
            measured=looked.measured,
            actor=looked.actor,
            train_states=self.state.train_states,
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
        for name, actor in (("final", self.state.train_states.actor), ("best", self.best.actor)):
            if interrupted():
                return {}
            result = self.programs.test(actor)
            self.record.add_test(result)
            returns[f"{name}_test_returns"] = result["eval_return"].tolist()
        return returns

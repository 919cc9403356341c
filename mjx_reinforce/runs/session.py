"""A run as it goes on: its programs, its measurements, its screen and its files."""

import functools
import time
from collections.abc import Callable
from typing import Any

from mjx_reinforce.runs.best import Best, keep_best
from mjx_reinforce.runs.checkpoint import Checkpoint
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.log import RunLog
from mjx_reinforce.runs.record import Record
from mjx_reinforce.runs.resume import recordable
from mjx_reinforce.runs.sinks.sink import Queue
from mjx_reinforce.runs.state import Looked, Programs, RunState, budget_of

#: Between checkpoints, where the user has not said how many updates.
_CHECKPOINT_SECONDS = 60.0
#: Once so much of the budget is used, the time that is left can be trusted: before, episodes may be
#: much shorter than later, so that each takes longer for its steps.
_TRUSTED = 0.25


class Session:
    """Moves a run on, block by block.

    A file that cannot be written while the run goes on is a warning, and is tried again.
    """

    def __init__(
        self,
        config: Config,
        policy: dict[str, Any],
        programs: Programs,
        record: Record,
        log: RunLog,
        display: Display,
        state: RunState,
        best: Best,
    ):
        """Takes what a run is made of, before its first update.

        Args:
          config: its settings.
          policy: how to rebuild its policy, see ``policy_files.save_policy``.
          programs: what moves it on.
          record: what it measures.
          log: its files.
          display: its screen.
          state: of training.
          best: the best policies so far.
        """
        self.config, self.policy, self.programs = config, policy, programs
        self.record, self.log, self.display = record, log, display
        self.state, self.best = state, best
        self._began = self._saved_at = time.perf_counter()
        self._saved_updates = 0
        self._budget = budget_of(config)
        #: Wall time at which the present policies were there (s).
        self._reached = 0.0
        #: Whether the newest checkpoint is of the present state.
        self.saved = False
        self._failing: set[str] = set()
        #: What is said of the time that training takes in all (s), if anything is; see ``plan``.
        self.correction: Callable[[float], str | None] = lambda seconds: None
        #: Where rows go besides metrics.csv.
        self.sinks: list[Queue] = []

    def restore(self, found: Checkpoint) -> None:
        """Goes back to a checkpoint."""
        self.state, self.best = found.state
        self.record.restore(found.record)
        self._began = time.perf_counter() - found.seconds
        self._saved_updates, self.saved = self._updates(), True
        self._reached = found.seconds

    def seconds(self) -> float:
        """Returns the wall time since the run began, without that of compiling."""
        return time.perf_counter() - self._began

    def advance(self) -> None:
        """Evaluates the present policies unless they were, and makes a block of updates."""
        look = not self.record.evaluated()
        self.state, metrics, looked = self.programs.advance(self.state, look, self._budget)
        if looked is not None:
            self._take(looked)
        self.saved = False
        met = self.record.add_updates(metrics)
        self._reached = self.seconds()
        self.display.show_nonfinite(met, self.config.num_seeds)

    def evaluate(self) -> None:
        """Evaluates the present policies."""
        self._take(self.programs.evaluate(self.state))

    def _take(self, looked: Looked) -> None:
        """Writes the rows of an evaluation of the policies at hand, and keeps the best."""
        self.best = keep_best(self.best, looked)
        rows = self.record.add_evaluation(looked.measured, self._reached)
        self._attempt("metrics.csv", lambda: self.log.add_rows(rows))
        for sink in self.sinks:
            self._attempt(sink.name, functools.partial(sink.write, rows))
        progress = self.record.progress()
        self.display.show_progress(progress)
        if progress.fraction >= _TRUSTED:
            self._look_at_time(progress.seconds_left)

    def _look_at_time(self, left: float) -> None:
        """Says, once, if training takes quite another time than was said."""
        if said := self.correction(self.record.seconds + left):
            self.display.say(said, "yellow")
            self.correction = lambda seconds: None

    def save_if_due(self) -> None:
        """Saves a checkpoint once there were enough updates, or about a minute, since the last."""
        every, now = self.config.checkpoint_every, time.perf_counter()
        if every is None:
            due = now - self._saved_at >= _CHECKPOINT_SECONDS
        else:
            due = self._updates() - self._saved_updates >= every
        if due:
            self.save()

    def save(self) -> None:
        """Writes a checkpoint, the policies, and how far the run is."""
        self._saved_at, self._saved_updates = time.perf_counter(), self._updates()
        self.saved = self._attempt("a checkpoint", self._save_checkpoint)
        self._attempt("the policies", self.save_policies)
        reached = {
            "env": self.config.env,
            "num_seeds": self.config.num_seeds,
            "updates": self._updates(),
            "env_steps": int(self.record.env_steps.sum()),
        }
        self._attempt("summary.json", lambda: self.log.say_running(reached))

    def save_policies(self) -> None:
        """Writes the last and the best policies, or raises OSError."""
        self.log.save_policies(self.state.train_states.actor, self.best.actor, self.policy)

    def close_sinks(self) -> None:
        """Ends the sinks."""
        for sink in self.sinks:
            self._attempt(sink.name, sink.close)

    def _save_checkpoint(self) -> None:
        content = Checkpoint(
            state=(self.state, self.best),
            record=self.record.arrays(),
            seconds=self.seconds(),
            metrics_bytes=self.log.metrics_bytes(),
            env_steps=self.config.env_steps,
            max_updates=self.config.max_updates,
            settings=recordable(self.config),
        )
        self.log.save_checkpoint(content, even=content.is_even(self.config.eval_every))

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

    def _updates(self) -> int:
        return int(self.record.updates.max())

    def _attempt(self, what: str, write: Callable[[], None]) -> bool:
        """Returns whether something could be written; the first failure in a row is shown."""
        try:
            write()
            self._failing.discard(what)
            return True
        except OSError as error:
            if what in self._failing:
                return False
            self._failing.add(what)
            warning = f"cannot write {what} ({error.strerror or error})"
            self.display.say(f"warning: {warning}; training goes on and tries again")
            return False

"""Who sees a run go on: its files and sinks, the screen, and what a user adds."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

from mjx_reinforce.files import Arrays
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.log import RunLog
from mjx_reinforce.runs.sinks import Queue, open_sinks
from mjx_reinforce.training import resume
from mjx_reinforce.training.checkpoint import Attempts, Checkpoint, SaveDue
from mjx_reinforce.training.driver import Driver, Evaluation
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.rows import Cells

#: Once so much of the budget is used, the time that is left can be trusted: before, episodes may be
#: much shorter than later, so that each takes longer for its steps.
_TRUSTED = 0.25


class RunFiles:
    """Writes the files of a run, and the rows of its sinks.

    A file that cannot be written while the run goes on is a warning, and is tried again.
    """

    def __init__(self, log: RunLog, policy: dict[str, Any], say: Callable[[str], None]):
        """Takes the files of a run, before they are there.

        Args:
          log: writes them.
          policy: how to rebuild the run's policy, see ``policy_files.save_policy``.
          say: shows a line to the user.
        """
        self._log, self._policy, self._say = log, policy, say
        self._attempt = Attempts(say).attempt
        self._due = SaveDue(None)
        #: Whether the newest checkpoint is of the present state.
        self._saved = False
        #: Where rows go besides metrics.csv.
        self._sinks: list[Queue] = []

    def begin(self, driver: Driver, found: Checkpoint | None) -> None:
        """Writes the first files, or takes the run and its files back to where it goes on."""
        config, log = driver.config, self._log
        self._due = SaveDue(config.checkpoint_every)
        if config.resume is None:
            settings = dataclasses.asdict(config) | {"output": str(log.directory)}
            del settings["resume"]
            log.begin(settings)
            self._sinks = open_sinks(config, log.directory, None)
            return
        budget = {name: getattr(config, name) for name in resume.BUDGETS}
        log.resume(resume.read_record(config.resume), budget, found)
        if found is not None:
            driver.restore(found)
            self._due.saved(driver.updates())
            self._saved = True
        updates = driver.updates()
        self._sinks = open_sinks(config, log.directory, None if found is None else updates)
        again = "" if updates else ": there is no checkpoint yet, so it begins again"
        self._say(f"going on after {updates} updates{again}")

    def updated(self, driver: Driver, met: Arrays) -> None:
        """Saves if that is due; the last block is saved with its evaluation, by ``end``."""
        self._saved = False
        if not driver.record.finished():
            self.save_if_due(driver)

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Writes the rows of an evaluation."""
        self._attempt("metrics.csv", lambda: self._log.add_rows(rows))
        for sink in self._sinks:
            self._attempt(sink.name, functools.partial(sink.write, rows))

    def save_if_due(self, driver: Driver) -> None:
        """Saves once there were enough updates, or about a minute, since the last time."""
        if self._due.is_due(driver.updates()):
            self._save(driver)

    def end(self, driver: Driver) -> None:
        """Saves the last state, unless it is saved; tries twice."""
        self.save_if_due(driver)
        if not self._saved:
            self._save(driver)

    def _save(self, driver: Driver) -> None:
        """Writes a checkpoint, the policies, and how far the run is."""
        self._due.saved(driver.updates())
        content = functools.partial(self._save_checkpoint, driver)
        self._saved = self._attempt("a checkpoint", content)
        self._attempt("the policies", lambda: self.save_policies(driver))
        reached = {
            "env": driver.config.env,
            "num_seeds": driver.config.num_seeds,
            "updates": driver.updates(),
            "env_steps": int(driver.record.env_steps.sum()),
        }
        self._attempt("summary.json", lambda: self._log.say_running(reached))

    def save_policies(self, driver: Driver) -> None:
        """Writes the last and the best policies, or raises OSError."""
        last = driver.state.train_states.actor
        self._log.save_policies(last, driver.best.actor, self._policy)

    def _save_checkpoint(self, driver: Driver) -> None:
        config = driver.config
        content = Checkpoint(
            state=(driver.state, driver.best),
            record=driver.record.arrays(),
            seconds=driver.seconds(),
            metrics_bytes=self._log.metrics_bytes(),
            env_steps=config.env_steps,
            max_updates=config.max_updates,
            settings=recordable(config),
        )
        self._log.save_checkpoint(content, even=content.is_even(config.eval_every))

    def finish(self, driver: Driver, picture: bytes, summary: dict[str, Any]) -> None:
        """Writes the last files, or raises OSError.

        Args:
          driver: of the run.
          picture: the contents of learning_curve.png.
          summary: the contents of summary.json.
        """
        self.save_policies(driver)
        self._log.finish(driver.record.training(), picture, summary)
        for sink in self._sinks:
            self._attempt(sink.name, sink.close)


class Screen:
    """Shows a run on a display, and once, if training takes quite another time than was said."""

    def __init__(self, display: Display, correction: Callable[[float], str | None]):
        """Takes the display, and what is said of the time that training takes in all (s)."""
        self._display, self._correction = display, correction

    def updated(self, driver: Driver, met: Arrays) -> None:
        """Says which updates met numbers that are not finite."""
        self._display.show_nonfinite(met, driver.config.num_seeds)

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Shows how far the run is and how well it does."""
        progress = driver.record.progress()
        self._display.show_progress(progress)
        if progress.fraction < _TRUSTED:
            return
        if said := self._correction(driver.record.seconds + progress.seconds_left):
            self._display.say(said, "yellow")
            self._correction = lambda seconds: None


class Callbacks:
    """A user's own functions, called with each ``Evaluation``; one that returns true ends it."""

    def __init__(self, functions: Sequence[Callable[[Evaluation], Any]]):
        """Takes the functions."""
        self._functions = functions

    def updated(self, driver: Driver, met: Arrays) -> None:
        """Does nothing: between evaluations the host would wait for the device."""

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Calls the functions."""
        for function in self._functions:
            if function(evaluation):
                driver.ended = True

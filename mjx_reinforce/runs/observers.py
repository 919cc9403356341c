"""Who sees a run go on: its files and sinks, the screen, and what a user adds."""

import dataclasses
import datetime
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.files import Arrays, write_arrays, write_bytes, write_json
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.runs import sinks
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.sinks import Sink, open_sinks
from mjx_reinforce.store.provenance import provenance
from mjx_reinforce.training import checkpoint, resume, rows
from mjx_reinforce.training.checkpoint import Attempts, Checkpoint, SaveDue
from mjx_reinforce.training.driver import Driver, Evaluation
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.rows import Cells

#: The files of a run, besides those in ``checkpoint/``.
_POLICY = ("policy/actor.npz", "policy/policy.json")
_BEST = ("policy/best/actor.npz", "policy/best/policy.json")
_RESULTS = ("summary.json", "learning_curve.png", "returns.npz", *_POLICY, *_BEST)
_FILES = ("config.json", "metrics.csv", *_RESULTS)


class RunLog:
    """Writes the files of a run into its directory; each raises OSError where that fails."""

    def __init__(self, directory: Path):
        self.directory = directory
        self._metrics = directory / "metrics.csv"
        #: Rows that could not be written yet.
        self._waiting = b""

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet; removes an older run.

        Args:
          settings: of the run; what else its results depend on is added.
        """
        self._remove_parts()
        for name in _RESULTS:
            (self.directory / name).unlink(missing_ok=True)
        checkpoint.remove_checkpoints(self.directory / "checkpoint")
        sinks.remove_outputs(self.directory)
        write_json(self.directory / "config.json", {**settings, **provenance()})
        files.create_csv(self._metrics, rows.COLUMNS)

    def resume(
        self, recorded: dict[str, Any], budget: Mapping[str, Any], found: Checkpoint | None
    ) -> None:
        """Takes the files back to a checkpoint, and says in config.json that the run goes on.

        A crash in between leaves a run that can be resumed: config.json is first, so that the
        budget in it chooses the same checkpoint.

        Args:
          recorded: what config.json says.
          budget: settings that may have changed.
          found: the checkpoint, or None to start again.
        """
        self._remove_parts()
        moment = {
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "updates": 0 if found is None else int(found.record["updates"].max()),
            "env_steps": 0 if found is None else int(found.record["env_steps"].sum()),
        }
        resumed = [*recorded.get("resumed", []), moment]
        write_json(self.directory / "config.json", {**recorded, **budget, "resumed": resumed})
        self.say_running(moment)
        checkpoint.remove_checkpoints(
            self.directory / "checkpoint", after=found.number if found else 0
        )
        if found is None:
            files.create_csv(self._metrics, rows.COLUMNS)
        else:
            files.cut(self._metrics, found.metrics_bytes)

    def _remove_parts(self) -> None:
        """Removes what a crash left of writing files."""
        for path in (self.directory / name for name in (*_FILES, sinks.WANDB_RUN)):
            for part in path.parent.glob(f".{path.name}.*"):
                part.unlink()

    def say_running(self, reached: Mapping[str, Any]) -> None:
        """Writes a summary.json that says how far the run is, in case the run is killed."""
        write_json(self.directory / "summary.json", {"status": "running", **reached})

    def add_rows(self, new: rows.Cells) -> None:
        """Appends rows to metrics.csv, after those that could not be written before."""
        self._waiting += rows.lines(new)
        self._write_waiting()

    def _write_waiting(self) -> None:
        files.append(self._metrics, self._waiting)
        self._waiting = b""

    def metrics_bytes(self) -> int:
        """Returns the length of metrics.csv with all rows in it."""
        self._write_waiting()
        return self._metrics.stat().st_size

    def save_policies(self, last: Actor, best: Actor, settings: dict[str, Any]) -> None:
        """Writes the folders ``policy`` and ``policy/best``, see ``policy_files.save_policy``."""
        save_policy(self.directory / "policy", last, settings)
        save_policy(self.directory / "policy" / "best", best, settings)

    def save_checkpoint(self, content: Checkpoint, *, even: bool) -> None:
        """Writes a checkpoint, see ``checkpoint.save``."""
        checkpoint.save(self.directory / "checkpoint", content, even=even)

    def finish(
        self, training: dict[str, np.ndarray], picture: bytes, summary: Mapping[str, Any]
    ) -> None:
        """Writes the last rows, returns.npz, learning_curve.png and, last of all, summary.json.

        Args:
          training: the arrays of returns.npz.
          picture: the contents of learning_curve.png.
          summary: the contents of summary.json.
        """
        self._write_waiting()
        write_arrays(self.directory / "returns.npz", training, compressed=True)
        write_bytes(self.directory / "learning_curve.png", picture)
        write_json(self.directory / "summary.json", summary)


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
        self._sinks: list[Sink] = []

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
    """Shows a run on a display."""

    def __init__(self, display: Display):
        """Takes the display."""
        self._display = display

    def updated(self, driver: Driver, met: Arrays) -> None:
        """Says which updates met numbers that are not finite."""
        self._display.show_nonfinite(met, driver.config.num_seeds)

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Shows how far the run is and how well it does."""
        self._display.show_progress(driver.record.progress())


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

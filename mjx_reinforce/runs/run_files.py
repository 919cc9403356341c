"""Who sees a run go on, besides the screen: its files and sinks, and what a user adds."""

import dataclasses
import datetime
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce import files
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.files import write_arrays, write_bytes
from mjx_reinforce.reports.charts import curves
from mjx_reinforce.runs.plan import Prepared
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.runs.sinks import Sink, open_sinks
from mjx_reinforce.settings.config import Config
from mjx_reinforce.store.provenance import provenance
from mjx_reinforce.training import checkpoint, resume
from mjx_reinforce.training.checkpoint import Checkpoint
from mjx_reinforce.training.driver import Driver, Evaluation, Observer
from mjx_reinforce.training.record import HEADER, Cells, lines


class RunFiles(Files[Driver]):
    """Writes the files of a run into its directory, and the rows of its sinks."""

    _folders = ("policy", "policy/best", "wandb")

    def __init__(self, directory: Path, prepared: Prepared, say: Callable[[str], None]):
        """Takes the files of a run, before they are there.

        Args:
          directory: where they are.
          prepared: what the run is made of.
          say: shows a line to the user.
        """
        super().__init__(directory, dict(prepared.known), say)
        self._found, self._policy = prepared.found, prepared.parts[0].ready.policy
        self._metrics, self._checkpoints = directory / "metrics.csv", directory / "checkpoint"
        #: Rows that could not be written yet.
        self._waiting = b""
        #: Where rows go besides metrics.csv.
        self._sinks: list[Sink] = []

    def began(self, driver: Driver) -> None:
        """Writes the first files, or takes the run and its files back to where it goes on.

        Raises:
          OSError: a file cannot be written.
        """
        found, reached = self._found, None
        if driver.config.resume is None:
            self._write_first(driver.config)
        else:
            self._take_back(driver.config, found)
        self._go_on(driver, found)
        if driver.config.resume is not None:
            reached = None if found is None else driver.updates()
            again = "" if reached else ": there is no checkpoint yet, so it begins again"
            self._say(f"going on after {reached or 0} updates{again}")
        self._sinks = open_sinks(driver.config, self._directory, reached)

    def _write_first(self, config: Config) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet."""
        settings = dataclasses.asdict(config) | {"output": str(self._directory)}
        del settings["resume"]
        self._write_json("config.json", settings | provenance())
        write_bytes(self._metrics, HEADER)

    def _take_back(self, config: Config, found: Checkpoint | None) -> None:
        """Takes the files back to a checkpoint, and says in config.json that the run goes on.

        A crash in between leaves a run that can be resumed: config.json is first, so that the
        budget in it chooses the same checkpoint.
        """
        moment = {
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "updates": 0 if found is None else int(found.record["updates"].max()),
            "env_steps": 0 if found is None else int(found.record["env_steps"].sum()),
        }
        budgets = {name: getattr(config, name) for name in resume.BUDGETS}
        resumed = [*self.contents.get("resumed", []), moment]
        self._write_json("config.json", self.contents | budgets | {"resumed": resumed})
        self._write_json("summary.json", {"status": "running", **moment})
        checkpoint.remove_checkpoints(self._checkpoints, after=found.number if found else 0)
        if found is None:
            write_bytes(self._metrics, HEADER)
        else:
            files.cut(self._metrics, found.metrics_bytes)

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Writes the rows of an evaluation."""
        self._waiting += lines(rows)
        self._attempt("metrics.csv", self._write_rows)
        for sink in self._sinks:
            self._attempt(sink.name, functools.partial(sink.write, rows))

    def finished(self, driver: Driver, summary: dict[str, Any]) -> None:
        """Writes the last files, summary.json last of all, or raises OSError."""
        self._save_policies(driver)
        self._write_rows()
        write_arrays(self._directory / "returns.npz", driver.record.training(), compressed=True)
        record = driver.record
        picture = curves.picture(driver.config.env, record.threshold, record.history())
        write_bytes(self._directory / "learning_curve.png", picture)
        self._write_json("summary.json", summary)
        for sink in self._sinks:
            self._attempt(sink.name, sink.close)

    def _save(self, driver: Driver) -> None:
        """Writes a checkpoint, the policies, and how far the run is, in case it is killed."""
        super()._save(driver)
        self._attempt("the policies", lambda: self._save_policies(driver))
        reached = {
            "status": "running",
            "env": driver.config.env,
            "num_seeds": driver.config.num_seeds,
            "updates": driver.updates(),
            "env_steps": int(driver.record.env_steps.sum()),
        }
        self._attempt("summary.json", lambda: self._write_json("summary.json", reached))

    def _save_checkpoint(self, driver: Driver) -> None:
        """Writes a checkpoint, which says how long metrics.csv is with all rows in it."""
        self._write_rows()
        content = driver.checkpoint()._replace(metrics_bytes=self._metrics.stat().st_size)
        checkpoint.save(self._checkpoints, content, even=content.is_even(driver.config.eval_every))

    def _save_policies(self, driver: Driver) -> None:
        """Writes the last and the best policies."""
        last = driver.states.train_states.actor
        save_policy(self._directory / "policy", last, self._policy)
        save_policy(self._directory / "policy" / "best", driver.best.actor, self._policy)

    def _write_rows(self) -> None:
        """Appends to metrics.csv the rows that it lacks."""
        files.append(self._metrics, self._waiting)
        self._waiting = b""


class Callbacks(Observer[Driver]):
    """A user's own functions, called with each ``Evaluation``; one that returns true ends it."""

    def __init__(self, functions: Sequence[Callable[[Evaluation], Any]]):
        """Takes the functions."""
        self._functions = functions

    def evaluated(self, driver: Driver, evaluation: Evaluation, rows: Cells) -> None:
        """Calls the functions."""
        for function in self._functions:
            if function(evaluation):
                driver.ended = True

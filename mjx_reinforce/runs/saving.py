"""The files of a run or a sweep in its directory: first, while it goes on, and last.

A run has config.json, metrics.csv, checkpoint/, policy/ and what its sinks write. For a sweep, see
``sweep_saving``.
"""

import dataclasses
import datetime
import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.export.policy_files import save_policy
from mjx_reinforce.files import Arrays, check_place, write_arrays, write_bytes, write_json
from mjx_reinforce.reports.charts import curves
from mjx_reinforce.runs.plan import GroupPlan, Plan
from mjx_reinforce.runs.sinks import Sink, open_sinks
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.provenance import provenance
from mjx_reinforce.training import resume
from mjx_reinforce.training.driver import DriverT, Evaluation, Observer, RunDriver
from mjx_reinforce.training.resume import Checkpoint
from mjx_reinforce.training.rows import header, lines

#: Between checkpoints (s), where the user has not said how many updates.
_CHECKPOINT_SECONDS = 60.0


class Files(Observer[DriverT]):
    """The files of a run or a sweep, all but the first and the last of which may fail.

    What cannot be written while runs go on is a warning, and is tried again. A directory that was
    moved or removed ends them by ``files.MovedError``: its files would begin another.

    contents: what the first file says
    """

    #: Folders in which files are written, beside the directory itself.
    _folders: tuple[str, ...] = ()

    def __init__(self, directory: Path, plan: Plan, say: Callable[[str], None]):
        """Takes the files before they are there.

        Args:
          directory: where they are.
          plan: what the run or the sweep is made of.
          say: shows a line to the user.
        """
        self._directory = directory
        self._plan = plan
        self._say = say
        self._place = directory.stat()
        self.contents = dict(plan.saved_record)
        #: What could not be written when it was last tried.
        self._failing: set[str] = set()
        #: The end of a warning that something could not be written.
        self._prospect = "; training goes on and tries again"
        #: Whether the newest checkpoint is of the present state.
        self._saved = False
        #: When a checkpoint was last tried (s), and of how many updates.
        self._saved_at = time.perf_counter()
        self._saved_updates = 0

    def open(self) -> None:
        """Removes what a crash left of writing files."""
        # Compiling took its time, in which the directory may have been moved.
        self._check_place()
        files.remove_leftovers(self._directory, *(self._directory / name for name in self._folders))

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of this name have ended."""
        return False

    def stages(self) -> Iterator[list[GroupPlan]]:
        """Yields the groups with the chunks of each stage, once those before have ended."""
        yield self._plan.group_plans

    def outcome(self) -> dict[str, Any]:
        """Returns what the last file says beside what is said of every run and sweep."""
        return {}

    def updated(self, driver: DriverT, num_nonfinite: np.ndarray) -> None:
        """Saves if that is due; the last block is saved with its evaluation, by ``ended``."""
        self._check_place()
        self._saved = False
        num_updates = driver.config.checkpoint_every
        if num_updates is None:
            is_due = time.perf_counter() - self._saved_at >= _CHECKPOINT_SECONDS
        else:
            is_due = driver.updates() - self._saved_updates >= num_updates
        if is_due and not driver.record.finished():
            self._save(driver)

    def ended(self, driver: DriverT) -> None:
        """Saves the last state, unless it is saved; nobody tries again."""
        self._prospect = ""
        # Without what has failed before, so that a failure now is shown, too.
        self._failing = set()
        if not self._saved:
            self._save(driver)

    def _go_on(self, driver: DriverT, checkpoint: Checkpoint | None) -> None:
        """Takes runs to a checkpoint, if there is one, from where the next is due."""
        if checkpoint is not None:
            driver.restore(checkpoint)
        self._saved = checkpoint is not None
        self._mark_saved(driver)

    def _mark_saved(self, driver: DriverT) -> None:
        """Counts from now, and from these updates, to the next checkpoint."""
        self._saved_at = time.perf_counter()
        self._saved_updates = driver.updates()

    def _save(self, driver: DriverT) -> None:
        """Writes a checkpoint, in case the runs are killed."""
        # Also where it fails: the next is tried no sooner than if it had not.
        self._mark_saved(driver)
        self._saved = self._attempt("a checkpoint", lambda: self._save_checkpoint(driver))

    def _save_checkpoint(self, driver: DriverT) -> None:
        """Writes a checkpoint, or raises OSError."""
        raise NotImplementedError

    def _attempt(self, name: str, write_file: Callable[[], None]) -> bool:
        """Returns whether something could be written; the first failure in a row is shown.

        Args:
          name: of what is written, for the warning.
          write_file: writes it, or raises OSError.
        """
        self._check_place()
        try:
            write_file()
        except OSError as error:
            # Where the directory is gone, that is the error, and it ends the run.
            self._check_place()
            if name not in self._failing:
                problem = error.strerror or error
                self._say(f"warning: cannot write {name} ({problem}){self._prospect}")
            self._failing.add(name)
            return False
        self._failing.discard(name)
        return True

    def _folder(self, *folder_names: str) -> Path:
        """Returns a folder in the directory, which is made if it is not there."""
        folder = self._directory
        # One after the other, and not by ``parents=True``: that would make a directory anew that
        # was moved meanwhile.
        for name in folder_names:
            folder /= name
            folder.mkdir(exist_ok=True)
        return folder

    def _check_place(self) -> None:
        """Raises MovedError if the directory is not where it was."""
        check_place(self._directory, self._place)

    def _write_json(self, name: str, json_content: dict[str, Any]) -> None:
        write_json(self._directory / name, json_content)


class RunFiles(Files[RunDriver]):
    """Writes the files of a run, and the rows of its sinks."""

    _folders = ("policy", "policy/best", "wandb")

    def __init__(self, directory: Path, plan: Plan, say: Callable[[str], None]):
        """Takes the files of a run, before they are there; arguments as of ``Files``."""
        super().__init__(directory, plan, say)
        self._metrics = directory / "metrics.csv"
        self._checkpoints = directory / "checkpoint"
        self._columns: list[str] = []
        #: Rows that could not be written yet.
        self._waiting = b""
        #: Where rows go besides metrics.csv.
        self._sinks: list[Sink] = []

    def began(self, driver: RunDriver) -> None:
        """Writes the first files, or takes the run and its files back to where it goes on.

        Raises:
          OSError: a file cannot be written.
        """
        checkpoint = self._plan.checkpoint
        self._go_on(driver, checkpoint)
        if driver.config.resume is None:
            self._write_first(driver.config)
        else:
            self._take_back(driver, checkpoint)
            num_updates = driver.updates() if checkpoint is not None else 0
            reason = "" if num_updates else ": there is no checkpoint yet, so it begins again"
            self._say(f"going on after {num_updates} updates{reason}")
        # A run that an older version began goes on with the columns that its file has.
        with self._metrics.open(encoding="utf-8") as file:
            self._columns = file.readline().strip().split(",")
        last_update = None
        if checkpoint is not None:
            # The evaluation of the present policies is made again, unless the record has it.
            last_update = driver.updates() - (not driver.record.is_evaluated())
        self._sinks = open_sinks(driver.config, self._directory, last_update)

    def _write_first(self, config: Config) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet."""
        settings = dataclasses.asdict(config) | {"output": str(self._directory)}
        del settings["resume"]
        played_by = {"played_by": self._plan.group_plans[0].ready.engine}
        self.contents = settings | played_by | provenance()
        self._write_config(config)
        write_bytes(self._metrics, header(self._plan.group_plans[0].ready.terms))

    def _write_config(self, config: Config) -> None:
        """Writes config.json with the present budgets."""
        self.contents |= {name: getattr(config, name) for name in resume.BUDGETS}
        self._write_json("config.json", self.contents)

    def _write_budgets(self, config: Config) -> None:
        """Writes config.json again if it has other budgets."""
        if tuple(self.contents["budgets"]) != config.budgets:
            self._write_config(config)

    def _take_back(self, driver: RunDriver, checkpoint: Checkpoint | None) -> None:
        """Takes the files back to a checkpoint, and says in config.json that the run goes on.

        A crash in between leaves a run that can be resumed: config.json is first, so that the
        budget in it chooses the same checkpoint.
        """
        run_progress = {
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "updates": driver.updates(),
            "env_steps": int(driver.record.played_steps().sum()),
        }
        self.contents["resumed"] = [*self.contents.get("resumed", []), run_progress]
        self._write_config(driver.config)
        self._write_json("summary.json", {"status": "running", **run_progress})
        if checkpoint is None:
            resume.remove_checkpoints(self._checkpoints, last_number=0)
            write_bytes(self._metrics, header(self._plan.group_plans[0].ready.terms))
        else:
            resume.remove_checkpoints(self._checkpoints, last_number=checkpoint.number)
            files.cut(self._metrics, checkpoint.metrics_bytes)

    def evaluated(self, driver: RunDriver, evaluation: Evaluation, rows: Arrays) -> None:
        """Writes the rows of an evaluation."""
        # Together with what a full disk did not take before, so that no row is lost.
        self._waiting += lines(rows, self._columns)
        self._attempt("metrics.csv", self._write_rows)
        for sink in self._sinks:
            self._attempt(sink.name, functools.partial(sink.write, rows))

    def finished(self, driver: RunDriver, summary: dict[str, Any]) -> None:
        """Writes the last files, summary.json last of all, or raises OSError."""
        self._check_place()
        # A late run is ended by a budget that is found after its last checkpoint.
        self._write_budgets(driver.config)
        self._save_policies(driver)
        self._write_rows()
        write_arrays(self._directory / "returns.npz", driver.record.training(), compressed=True)
        record = driver.record
        picture = curves.picture(driver.config.env, record.threshold, record.history())
        write_bytes(self._directory / "learning_curve.png", picture)
        self._write_json("summary.json", summary)
        for sink in self._sinks:
            self._attempt(sink.name, sink.close)

    def _save(self, driver: RunDriver) -> None:
        """Writes a checkpoint, the policies, and how far the run is, in case it is killed."""
        super()._save(driver)
        self._attempt("the policies", lambda: self._save_policies(driver))
        run_progress = {
            "status": "running",
            "env": driver.config.env,
            "num_seeds": driver.config.num_seeds,
            "updates": driver.updates(),
            "env_steps": int(driver.record.played_steps().sum()),
        }
        self._attempt("summary.json", lambda: self._write_json("summary.json", run_progress))

    def _save_checkpoint(self, driver: RunDriver) -> None:
        """Writes a checkpoint, which says how long metrics.csv is with all rows in it."""
        self._write_rows()
        # First, as it chooses the checkpoint.
        self._write_budgets(driver.config)
        checkpoint = driver.checkpoint()._replace(metrics_bytes=self._metrics.stat().st_size)
        resume.save(
            self._checkpoints, checkpoint, is_even=checkpoint.is_even(driver.config.eval_every)
        )

    def _save_policies(self, driver: RunDriver) -> None:
        """Writes the last and the best policies."""
        settings = self._plan.group_plans[0].ready.policy
        save_policy(self._folder("policy"), driver.last_actors(), settings)
        save_policy(self._folder("policy", "best"), driver.best_actors(), settings)

    def _write_rows(self) -> None:
        """Appends to metrics.csv the rows that it lacks."""
        files.append(self._metrics, self._waiting)
        self._waiting = b""

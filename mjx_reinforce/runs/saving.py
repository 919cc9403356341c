"""The files of a run or a sweep in its directory: first, while it goes on, and last.

A run has config.json, metrics.csv, checkpoint/, policy/ and what its sinks write; a sweep has
sweep.json, and parts/ of what a chunk of runs measured and learned. A part is written whole, when
the chunk ends, and is all that curves.npz and policies/ are made of: all else that a crash leaves
is written again.
"""

import dataclasses
import datetime
import functools
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.console.commands import typed
from mjx_reinforce.export.policy_files import actor_of, arrays_of, save_policy
from mjx_reinforce.files import (
    Arrays,
    check_place,
    read_arrays,
    remove_parts,
    write_arrays,
    write_bytes,
    write_json,
)
from mjx_reinforce.reports.charts import curves
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs.design import as_record
from mjx_reinforce.runs.plan import Part, Plan
from mjx_reinforce.runs.sinks import Sink, open_sinks
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.provenance import provenance
from mjx_reinforce.training import resume
from mjx_reinforce.training.driver import Driver, DriverT, Evaluation, Observer, RunDriver
from mjx_reinforce.training.record import HEADER, lines
from mjx_reinforce.training.resume import Checkpoint

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
        self._directory, self._plan, self._say = directory, plan, say
        self._place = directory.stat()
        self.contents = dict(plan.known)
        #: What could not be written when it was last tried, and what is said of it.
        self._failing: set[str] = set()
        self._hope = "; training goes on and tries again"
        #: Whether the newest checkpoint is of the present state; when it was tried, and of which.
        self._saved, self._at, self._updates = False, time.perf_counter(), 0

    def open(self) -> None:
        """Removes what a crash left of writing files."""
        self._check_place()  # compiling took its time
        remove_parts(self._directory, *(self._directory / name for name in self._folders))

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of this name have ended."""
        return False

    def updated(self, driver: DriverT, met: np.ndarray) -> None:
        """Saves if that is due; the last block is saved with its evaluation, by ``ended``."""
        self._check_place()
        self._saved, every = False, driver.config.checkpoint_every
        due = time.perf_counter() - self._at >= _CHECKPOINT_SECONDS
        if every is not None:
            due = driver.updates() - self._updates >= every
        if due and not driver.record.finished():
            self._save(driver)

    def ended(self, driver: DriverT) -> None:
        """Saves the last state, unless it is saved; nobody tries again."""
        self._hope, self._failing = "", set()
        if not self._saved:
            self._save(driver)

    def _go_on(self, driver: DriverT, found: Checkpoint | None) -> None:
        """Takes runs to a checkpoint, if there is one, from where the next is due."""
        if found is not None:
            driver.restore(found)
        self._saved = found is not None
        self._at, self._updates = time.perf_counter(), driver.updates()

    def _save(self, driver: DriverT) -> None:
        """Writes a checkpoint, in case the runs are killed."""
        self._at, self._updates = time.perf_counter(), driver.updates()
        self._saved = self._attempt("a checkpoint", lambda: self._save_checkpoint(driver))

    def _save_checkpoint(self, driver: DriverT) -> None:
        """Writes a checkpoint, or raises OSError."""
        raise NotImplementedError

    def _attempt(self, what: str, write: Callable[[], None]) -> bool:
        """Returns whether something could be written; the first failure in a row is shown.

        Args:
          what: is written, for the warning.
          write: writes it, or raises OSError.
        """
        self._check_place()
        try:
            write()
        except OSError as error:
            self._check_place()
            if what not in self._failing:
                problem = error.strerror or error
                self._say(f"warning: cannot write {what} ({problem}){self._hope}")
            self._failing.add(what)
            return False
        self._failing.discard(what)
        return True

    def _folder(self, *names: str) -> Path:
        """Returns a folder in the directory, which is made if it is not there."""
        folder = self._directory
        for name in names:
            folder /= name
            folder.mkdir(exist_ok=True)  # not its parents: the directory is never made anew
        return folder

    def _check_place(self) -> None:
        """Raises MovedError if the directory is not where it was."""
        check_place(self._directory, self._place)

    def _write_json(self, name: str, content: dict[str, Any]) -> None:
        write_json(self._directory / name, content)


class RunFiles(Files[RunDriver]):
    """Writes the files of a run, and the rows of its sinks."""

    _folders = ("policy", "policy/best", "wandb")

    def __init__(self, directory: Path, plan: Plan, say: Callable[[str], None]):
        """Takes the files of a run, before they are there; arguments as of ``Files``."""
        super().__init__(directory, plan, say)
        self._metrics, self._checkpoints = directory / "metrics.csv", directory / "checkpoint"
        #: Rows that could not be written yet.
        self._waiting = b""
        #: Where rows go besides metrics.csv.
        self._sinks: list[Sink] = []

    def began(self, driver: RunDriver) -> None:
        """Writes the first files, or takes the run and its files back to where it goes on.

        Raises:
          OSError: a file cannot be written.
        """
        found, reached = self._plan.found, None
        self._go_on(driver, found)
        if driver.config.resume is None:
            self._write_first(driver.config)
        else:
            self._take_back(driver, found)
            reached = None if found is None else driver.updates()
            again = "" if reached else ": there is no checkpoint yet, so it begins again"
            self._say(f"going on after {reached or 0} updates{again}")
        # The evaluation of the present policies is made again, unless the record has it.
        kept = reached if reached is None or driver.record.is_evaluated() else reached - 1
        self._sinks = open_sinks(driver.config, self._directory, kept)

    def _write_first(self, config: Config) -> None:
        """Writes config.json, and a metrics.csv that has no rows yet."""
        settings = dataclasses.asdict(config) | {"output": str(self._directory)}
        del settings["resume"]
        self._write_json("config.json", settings | provenance())
        write_bytes(self._metrics, HEADER)

    def _take_back(self, driver: RunDriver, found: Checkpoint | None) -> None:
        """Takes the files back to a checkpoint, and says in config.json that the run goes on.

        A crash in between leaves a run that can be resumed: config.json is first, so that the
        budget in it chooses the same checkpoint.
        """
        moment = {
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "updates": driver.updates(),
            "env_steps": int(driver.record.env_steps.sum()),
        }
        budgets = {name: getattr(driver.config, name) for name in resume.BUDGETS}
        resumed = [*self.contents.get("resumed", []), moment]
        self._write_json("config.json", self.contents | budgets | {"resumed": resumed})
        self._write_json("summary.json", {"status": "running", **moment})
        resume.remove_checkpoints(self._checkpoints, after=found.number if found else 0)
        if found is None:
            write_bytes(self._metrics, HEADER)
        else:
            files.cut(self._metrics, found.metrics_bytes)

    def evaluated(self, driver: RunDriver, evaluation: Evaluation, rows: Arrays) -> None:
        """Writes the rows of an evaluation."""
        self._waiting += lines(rows)
        self._attempt("metrics.csv", self._write_rows)
        for sink in self._sinks:
            self._attempt(sink.name, functools.partial(sink.write, rows))

    def finished(self, driver: RunDriver, summary: dict[str, Any]) -> None:
        """Writes the last files, summary.json last of all, or raises OSError."""
        self._check_place()
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
        reached = {
            "status": "running",
            "env": driver.config.env,
            "num_seeds": driver.config.num_seeds,
            "updates": driver.updates(),
            "env_steps": int(driver.record.env_steps.sum()),
        }
        self._attempt("summary.json", lambda: self._write_json("summary.json", reached))

    def _save_checkpoint(self, driver: RunDriver) -> None:
        """Writes a checkpoint, which says how long metrics.csv is with all rows in it."""
        self._write_rows()
        content = driver.checkpoint()._replace(metrics_bytes=self._metrics.stat().st_size)
        resume.save(self._checkpoints, content, even=content.is_even(driver.config.eval_every))

    def _save_policies(self, driver: RunDriver) -> None:
        """Writes the last and the best policies."""
        settings = self._plan.parts[0].ready.policy
        save_policy(self._folder("policy"), driver.states.train_states.actor, settings)
        save_policy(self._folder("policy", "best"), driver.best.actor, settings)

    def _write_rows(self) -> None:
        """Appends to metrics.csv the rows that it lacks."""
        files.append(self._metrics, self._waiting)
        self._waiting = b""


#: The arrays of curves.npz, and their types.
_CURVES = {
    "configuration": np.int32,
    "seed": np.int32,
    "eval_return": np.float32,
    "env_steps": np.int64,
    "nonfinite": np.int32,
}


class SweepFiles(Files[Driver]):
    """Writes the files of a sweep into its directory; raises OSError if one that lasts fails."""

    _folders = ("parts",)

    def __init__(self, directory: Path, plan: Plan, say: Callable[[str], None]):
        """Takes the files of a sweep, before they are there; arguments as of ``Files``."""
        super().__init__(directory, plan, say)
        self._parts = directory / "parts"
        self.contents = self._contents()

    def _contents(self) -> dict[str, Any]:
        """Returns what sweep.json says while the sweep goes on."""
        design, parts, known = self._plan.design, self._plan.parts, self._plan.known
        return {
            "status": "running",
            "env": design.base.env,
            "threshold": parts[0].ready.threshold,
            **as_record(design),
            "num_seeds": design.base.num_seeds,
            "configurations": [
                {"configuration": number, **values}
                for number, values in enumerate(design.configurations)
            ],
            "chunk_runs": [part.limit for part in parts],
            "local_devices": self._plan.division.count,
            "engine": parts[0].ready.engine,
            "compile_seconds": known.get("compile_seconds", 0.0),
            "run_seconds": known.get("run_seconds", 0.0),
            "command": known.get("command", typed("sweep")),
            **provenance(),
        }

    def open(self) -> None:
        """Begins, with sweep.json first: where that cannot be written, nothing was begun."""
        self._check_place()
        self._write_json("sweep.json", self.contents)
        super().open()
        self._parts.mkdir(exist_ok=True)
        remove_parts(*self._parts.glob("*/"))  # of checkpoints

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of a chunk have ended."""
        return (self._parts / f"{chunk}.npz").exists()

    def began(self, driver: Driver) -> None:
        """Takes a chunk to its newest checkpoint, if there is one."""
        found = resume.read_checkpoints(self._checkpoints(driver), self._say)
        self._go_on(driver, next(found, None))

    def ended(self, driver: Driver) -> None:
        """Writes the part of a chunk, or a checkpoint of one that was interrupted."""
        if not driver.record.done():
            super().ended(driver)
            return
        self._check_place()
        self._write_part(driver)
        resume.remove_checkpoints(self._checkpoints(driver))

    def finished(self, driver: Driver, summary: dict[str, Any]) -> None:
        """Joins the parts so far, sorted; those of a sweep that ended go after sweep.json."""
        self._check_place()
        paths = sorted(self._parts.glob("*.npz"))
        parts = {path.stem: read_arrays(path, stored=True) for path in paths}
        if parts:
            curves = join_parts([{name: part[name] for name in _CURVES} for part in parts.values()])
            write_arrays(self._directory / "curves.npz", curves)
        if summary["status"] == "finished":
            shutil.rmtree(self._directory / "policies", ignore_errors=True)
            for part in self._plan.parts:
                self._write_policies(part, [parts[runs.name] for runs in part.chunks])
        self._write_json("sweep.json", summary)
        if summary["status"] == "finished":
            shutil.rmtree(self._parts)

    def _save_checkpoint(self, driver: Driver) -> None:
        resume.save(self._checkpoints(driver), driver.checkpoint(), even=False)

    def _checkpoints(self, driver: Driver) -> Path:
        """Returns the folder of a chunk's checkpoints."""
        return self._parts / driver.runs.name

    def _write_part(self, driver: Driver) -> None:
        """Writes what a chunk measured, and the last policies of each configuration's ends."""
        record, runs = driver.record, driver.runs
        found = since_their_end(record.history()) | runs._asdict() | {"nonfinite": record.nonfinite}
        curves = {name: found[name].astype(kind) for name, kind in _CURVES.items()}
        last = {name: curves[name] for name in ("configuration", "seed")}
        last["eval_return"] = curves["eval_return"][-1]
        kept = np.concatenate([_ends(last, n) for n in np.unique(runs.configuration)])
        last |= arrays_of(driver.slots.states().train_states.actor)
        ends = {f"ends/{name}": np.asarray(x)[kept] for name, x in last.items()}
        write_arrays(self._parts / f"{runs.name}.npz", curves | ends)

    def _write_policies(self, part: Part, chunks: Sequence[Arrays]) -> None:
        """Writes the policies of the worst and the best seed of each configuration of a group.

        Each folder is as the directory of a run.

        Args:
          part: the group.
          chunks: what its parts have.
        """
        last = {
            name.removeprefix("ends/"): np.concatenate([chunk[name] for chunk in chunks])
            for name in chunks[0]
            if name not in _CURVES
        }
        policy = part.ready.policy
        for number in part.group.members.tolist():
            kept = _ends(last, number)
            ends = {name: values[kept] for name, values in last.items()}
            seeds, returns = ends.pop("seed"), ends.pop("eval_return").astype(np.float64)
            del ends["configuration"]
            place = self._folder("policies", f"{number:03d}")
            config = self._plan.design.configs[number]
            traced = {k: getattr(config, k) for k in part.group.settings if k in policy}
            folder = self._folder("policies", place.name, "policy")
            save_policy(folder, actor_of(ends), policy | traced)
            ranked = {"status": "finished", "final_returns": returns.tolist()}
            write_json(place / "summary.json", ranked)
            run = {"env": config.env, "horizon": part.ready.horizon}
            if config.env_set:
                run["env_set"] = list(config.env_set)
            write_json(place / "config.json", run | {"seeds": seeds.tolist()})


def _ends(last: Arrays, number: int) -> np.ndarray:
    """Returns which runs are the worst and the best seed of a configuration, or which is both.

    Args:
      last: [R] each, ``configuration``, ``seed`` and the last ``eval_return``.
      number: of the configuration.
    """
    runs = np.flatnonzero(last["configuration"] == number)
    runs = runs[np.argsort(last["seed"][runs])]
    values = np.nan_to_num(last["eval_return"][runs], nan=-np.inf)
    return runs[sorted({int(values.argmin()), int(values.argmax())})]


def since_their_end(history: Arrays) -> Arrays:
    """Returns rows [E, R] of a chunk in which runs that ended have their last evaluation at once.

    It is made when all have ended; until then their rows repeat the one before. So a run has the
    same rows whatever is beside it.
    """
    steps = history["env_steps"]
    ended = np.cumsum(steps[1:] == steps[:-1], axis=0) > 0
    return {n: np.concatenate([x[:1], np.where(ended, x[-1], x[1:])]) for n, x in history.items()}


def join_parts(parts: Sequence[Mapping[str, np.ndarray]]) -> Arrays:
    """Returns several parts as one, sorted by configuration and seed.

    A run whose evaluations ended earlier repeats its last.
    """
    length = max(len(part["eval_return"]) for part in parts)

    def joined(name: str) -> np.ndarray:
        each = [part[name] for part in parts]
        return np.concatenate([lengthened(x, length) if x.ndim > 1 else x for x in each], axis=-1)

    order = np.lexsort((joined("seed"), joined("configuration")))
    return {name: joined(name)[..., order] for name in parts[0]}

"""The files of a run or a sweep in its directory: first, while it goes on, and last.

A run has config.json, metrics.csv, checkpoint/, policy/ and what its sinks write; a sweep has
sweep.json, and parts/ of what a chunk of runs measured and learned. A part is written whole, when
the chunk ends, and is all that curves.npz and policies/ are made of: all else that a crash leaves
is written again.
"""

import dataclasses
import datetime
import functools
import itertools
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.console.commands import typed
from mjx_reinforce.export.policy_files import actor_of, arrays_of, check_arrays, save_policy
from mjx_reinforce.files import (
    Arrays,
    check_place,
    naming_damage,
    read_arrays,
    remove_leftovers,
    write_arrays,
    write_bytes,
    write_json,
)
from mjx_reinforce.reports.charts import curves
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs.design import as_record
from mjx_reinforce.runs.plan import GroupPlan, Plan
from mjx_reinforce.runs.sinks import Sink, open_sinks
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.provenance import provenance
from mjx_reinforce.statistics.sequential import Verdict, look_seeds, sequential_test
from mjx_reinforce.training import resume
from mjx_reinforce.training.driver import Driver, DriverT, Evaluation, Observer, RunDriver, Runs
from mjx_reinforce.training.record import header, lines
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
        remove_leftovers(self._directory, *(self._directory / name for name in self._folders))

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
        if tuple(self.contents["budgets"]) != driver.config.budgets:
            self._write_config(driver.config)
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


#: The arrays of curves.npz, and their types.
_CURVE_TYPES = {
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
        design = self._plan.design
        group_plans = self._plan.group_plans
        # Times and the command of a sweep that goes on are those of its beginning.
        saved_record = self._plan.saved_record
        return {
            "status": "running",
            "env": design.base.env,
            "threshold": group_plans[0].ready.threshold,
            **as_record(design),
            "num_seeds": design.base.num_seeds,
            "configurations": [
                {"configuration": configuration_number, **values}
                for configuration_number, values in enumerate(design.configurations)
            ],
            "chunk_runs": [group_plan.limit for group_plan in group_plans],
            "local_devices": self._plan.division.count,
            "engine": group_plans[0].ready.engine,
            "played_by": [group_plan.ready.engine for group_plan in group_plans],
            "compile_seconds": saved_record.get("compile_seconds", 0.0),
            "run_seconds": saved_record.get("run_seconds", 0.0),
            "command": saved_record.get("command", typed("sweep")),
            **provenance(),
        }

    def open(self) -> None:
        """Begins, with sweep.json first: where that cannot be written, nothing was begun."""
        self._check_place()
        self._write_json("sweep.json", self.contents)
        super().open()
        self._parts.mkdir(exist_ok=True)
        # The folders in parts/ are those of chunks' checkpoints.
        remove_leftovers(*self._parts.glob("*/"))
        # Before anything is trained: they are joined when all is.
        for group_plan in itertools.chain.from_iterable(self.stages()):
            for runs in group_plan.chunks:
                if self.has(runs.name):
                    _check_part(self._parts / f"{runs.name}.npz", runs, group_plan.ready.policy)

    def has(self, chunk: str) -> bool:
        """Returns whether the runs of a chunk have ended."""
        return (self._parts / f"{chunk}.npz").exists()

    def stages(self) -> Iterator[list[GroupPlan]]:
        """Yields the groups with the chunks of each stage, once those before have ended.

        In a sweep until the best is decided, a later stage has the contenders alone, and none
        follows the one that decides.
        """
        if not self._plan.design.until_decided:
            yield from super().stages()
            return
        for stage, _ in enumerate(look_seeds(self._plan.design.base.num_seeds)):
            contenders = self._verdict(stage).contenders
            if len(contenders) == 1:
                return
            yield [_of_contenders(x, stage, contenders) for x in self._plan.group_plans]

    def outcome(self) -> dict[str, Any]:
        """Returns which configuration is the best, or which may be, where a sweep looks at that."""
        if not self._plan.design.until_decided:
            return {}
        return {"decision": self._verdict()._asdict()}

    def _verdict(self, num_looks: int | None = None) -> Verdict:
        """Returns what so many looks at the parts say of the configurations; all by default."""
        design = self._plan.design
        budget = design.base.num_seeds
        # A seed that is not there yet ends the returns of its configuration.
        returns = np.zeros((design.count(), budget))
        is_there = np.zeros((design.count(), budget + 1), bool)
        for path in self._parts.glob("*.npz"):
            part = read_arrays(path, ("configuration", "seed", "eval_return"))
            with naming_damage(path):
                runs = part["configuration"], part["seed"]
                returns[runs] = part["eval_return"][-1]
                is_there[runs] = True
        num_seeds = np.argmin(is_there, axis=1)
        if num_looks is not None:
            num_seeds = np.minimum(num_seeds, [0, *look_seeds(budget)][num_looks])
        return sequential_test([x[:n] for x, n in zip(returns, num_seeds, strict=True)], budget)

    def began(self, driver: Driver) -> None:
        """Takes a chunk to its newest checkpoint, if there is one."""
        checkpoints = resume.read_checkpoints(self._checkpoints(driver), self._say)
        self._go_on(driver, next(checkpoints, None))

    def ended(self, driver: Driver) -> None:
        """Writes the part of a chunk, or a checkpoint of one that was interrupted."""
        if not driver.record.done():
            super().ended(driver)
            return
        self._check_place()
        # In this order: what a kill between the two leaves is a part, and checkpoints that nothing
        # reads any more.
        self._write_part(driver)
        resume.remove_checkpoints(self._checkpoints(driver))

    def finished(self, driver: Driver, summary: dict[str, Any]) -> None:
        """Joins the parts so far, sorted; those of a sweep that ended go after sweep.json."""
        self._check_place()
        paths = sorted(self._parts.glob("*.npz"))
        parts = {path.stem: read_arrays(path, stored=True) for path in paths}
        if parts:
            curves = join_parts(
                [{name: part[name] for name in _CURVE_TYPES} for part in parts.values()]
            )
            write_arrays(self._directory / "curves.npz", curves)
        if summary["status"] == "finished":
            # What a kill at this point left is written again, as a whole.
            shutil.rmtree(self._directory / "policies", ignore_errors=True)
            # The chunks of a group, stage by stage.
            for group_plans in zip(*self.stages(), strict=True):
                chunks = [runs for group_plan in group_plans for runs in group_plan.chunks]
                self._write_policies(group_plans[0], [parts[runs.name] for runs in chunks])
        # Before the parts go: they can make all the files again until this says that it is over.
        self._write_json("sweep.json", summary)
        if summary["status"] == "finished":
            shutil.rmtree(self._parts)

    def _save_checkpoint(self, driver: Driver) -> None:
        resume.save(self._checkpoints(driver), driver.checkpoint(), is_even=False)

    def _checkpoints(self, driver: Driver) -> Path:
        """Returns the folder of a chunk's checkpoints."""
        return self._parts / driver.runs.name

    def _write_part(self, driver: Driver) -> None:
        """Writes what a chunk measured, and the last policies of each configuration's ends."""
        runs = driver.runs
        run_arrays = since_their_end(driver.record.history()) | runs._asdict()
        run_arrays["nonfinite"] = driver.record.nonfinite
        curves = {name: run_arrays[name].astype(dtype) for name, dtype in _CURVE_TYPES.items()}
        finals = {name: curves[name] for name in ("configuration", "seed")}
        finals["eval_return"] = curves["eval_return"][-1]
        # The worst and the best seed of a configuration in the whole sweep are its ends in their
        # chunks, too, so the policies of other seeds need not be stored.
        rows = np.concatenate([_ends(finals, member) for member in np.unique(runs.configuration)])
        finals |= arrays_of(driver.slots.states().train_states.actor)
        end_arrays = {f"ends/{name}": np.asarray(x)[rows] for name, x in finals.items()}
        write_arrays(self._parts / f"{runs.name}.npz", curves | end_arrays)

    def _write_policies(self, group_plan: GroupPlan, chunks: Sequence[Arrays]) -> None:
        """Writes the policies of the worst and the best seed of each configuration of a group.

        Each folder is as the directory of a run.

        Args:
          group_plan: of the group.
          chunks: the arrays in the part of each of its chunks.
        """
        last_arrays = {
            name.removeprefix("ends/"): np.concatenate([chunk[name] for chunk in chunks])
            for name in chunks[0]
            if name not in _CURVE_TYPES
        }
        policy = group_plan.ready.policy
        for configuration_number in group_plan.group.members.tolist():
            rows = _ends(last_arrays, configuration_number)
            end_arrays = {name: values[rows] for name, values in last_arrays.items()}
            seeds = end_arrays.pop("seed")
            returns = end_arrays.pop("eval_return").astype(np.float64)
            # What is left over after this are the arrays of the policies.
            del end_arrays["configuration"]
            policy_folder = self._folder("policies", f"{configuration_number:03d}")
            config = self._plan.design.configs[configuration_number]
            # ``policy`` is that of the group's first configuration, but for these numbers.
            swept = {
                key: getattr(config, key) for key in group_plan.group.settings if key in policy
            }
            folder = self._folder("policies", policy_folder.name, "policy")
            save_policy(folder, actor_of(end_arrays), policy | swept)
            summary = {"status": "finished", "final_returns": returns.tolist()}
            write_json(policy_folder / "summary.json", summary)
            settings = {"env": config.env, "horizon": group_plan.ready.horizon}
            if config.env_set:
                settings["env_set"] = list(config.env_set)
            settings["seeds"] = seeds.tolist()
            write_json(policy_folder / "config.json", settings)


def _of_contenders(group_plan: GroupPlan, stage: int, contenders: Sequence[int]) -> GroupPlan:
    """Returns a group with the chunks of a stage, in which only contenders have runs."""
    chunks = []
    for runs in group_plan.stages[stage]:
        is_run = np.isin(runs.configuration, contenders)
        if is_run.any():
            columns = (runs.member, runs.configuration, runs.seed)
            chunks.append(Runs(runs.name, *(column[is_run] for column in columns)))
    return group_plan._replace(stages=[chunks])


def _check_part(path: Path, runs: Runs, policy: dict[str, Any]) -> None:
    """Raises ValueError for the part of a chunk that is not of its runs.

    Args:
      path: of the part.
      runs: of the chunk.
      policy: the settings of the policies in it.
    """
    part = read_arrays(path, stored=True)
    with naming_damage(path):
        table_shape = (len(part["eval_return"]), len(runs.seed))
        for name, dtype in _CURVE_TYPES.items():
            array = part.pop(name)
            shape = table_shape if name in ("eval_return", "env_steps") else table_shape[1:]
            if array.dtype != dtype or array.shape != shape:
                raise ValueError(
                    f"{name} is {array.dtype}{list(array.shape)}, not {np.dtype(dtype)}"
                    f"{list(shape)}; remove it, and its runs are trained again"
                )
            if name in runs._fields and not np.array_equal(array, getattr(runs, name)):
                raise ValueError(f"{name} is that of other runs; remove it, and these are trained")
        ends = {name.removeprefix("ends/"): array for name, array in part.items()}
        own_shapes = [ends.pop(name).shape for name in ("configuration", "seed", "eval_return")]
        check_arrays(ends, policy)
        if any(shape != ends["normalizer/count"].shape for shape in own_shapes):
            raise ValueError("its ends are not of as many runs as their policies")


def _ends(last_arrays: Arrays, configuration_number: int) -> np.ndarray:
    """Returns which runs are the worst and the best seed of a configuration, or which is both.

    Args:
      last_arrays: [R] each, ``configuration``, ``seed`` and the last ``eval_return``.
      configuration_number: of the configuration.
    """
    runs = np.flatnonzero(last_arrays["configuration"] == configuration_number)
    # By the seeds' numbers, so that equal returns choose the same seeds however chunks were cut.
    runs = runs[np.argsort(last_arrays["seed"][runs])]
    finite_returns = np.nan_to_num(last_arrays["eval_return"][runs], nan=-np.inf)
    return runs[sorted({int(finite_returns.argmin()), int(finite_returns.argmax())})]


def since_their_end(history: Arrays) -> Arrays:
    """Returns rows [E, R] of a chunk in which runs that ended have their last evaluation at once.

    It is made when all have ended; until then their rows repeat the one before. So a run has the
    same rows whatever is beside it.
    """
    # A run that has not ended plays in every block, so env steps that stay the same say that it
    # has; from there on ``cumsum`` keeps the mark.
    env_steps = history["env_steps"]
    ended = np.cumsum(env_steps[1:] == env_steps[:-1], axis=0) > 0
    return {
        name: np.concatenate([x[:1], np.where(ended, x[-1], x[1:])]) for name, x in history.items()
    }


def join_parts(parts: Sequence[Mapping[str, np.ndarray]]) -> Arrays:
    """Returns several parts as one, sorted by configuration and seed.

    A run whose evaluations ended earlier repeats its last.
    """
    num_evaluations = max(len(part["eval_return"]) for part in parts)

    def joined(name: str) -> np.ndarray:
        # Arrays [E, R] have a row an evaluation, arrays [R] have none.
        columns = [part[name] for part in parts]
        columns = [lengthened(x, num_evaluations) if x.ndim > 1 else x for x in columns]
        return np.concatenate(columns, axis=-1)

    # The last key counts first.
    run_order = np.lexsort((joined("seed"), joined("configuration")))
    return {name: joined(name)[..., run_order] for name in parts[0]}

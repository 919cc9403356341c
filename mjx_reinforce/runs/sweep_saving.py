"""The files of a sweep in its directory: sweep.json, and parts/ of what its chunks measured.

A part is what a chunk of runs measured and learned. It is written whole, when the chunk ends, and
is all that curves.npz and policies/ are made of: all else that a crash leaves is written again.
"""

import itertools
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce import files
from mjx_reinforce.console.commands import typed
from mjx_reinforce.export.policy_files import actor_of, arrays_of, check_arrays, save_policy
from mjx_reinforce.files import Arrays, naming_damage, read_arrays, write_arrays, write_json
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs.design import as_record
from mjx_reinforce.runs.plan import GroupPlan, Plan
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.setup.provenance import provenance
from mjx_reinforce.statistics.sequential import Verdict, look_seeds, sequential_test
from mjx_reinforce.training import resume
from mjx_reinforce.training.driver import Driver, Runs

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
        files.remove_leftovers(*self._parts.glob("*/"))
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

"""What a finished run says of itself, and what comes with the package in place of a run.

The package has a folder of NumPy files and JSON for each task with a trained policy, which
``python -m experiments.studies.results pretrained DIR`` writes.
"""

import os
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from mjx_reinforce.engine.checks import check_type, nearest
from mjx_reinforce.files import expanded, naming_damage, read_json
from mjx_reinforce.settings.config import read_seeds

#: A seed by its rank in the run's final evaluation, or by its number.
SeedChoice = Literal["best", "worst", "median"] | int
#: Each seed's policy at the end of training, or the one that did best on the way.
PolicyChoice = Literal["last", "best"]


class _Places(NamedTuple):
    """Where the policies are in the run directory, and their returns in summary.json."""

    folder: str
    returns: str


_PLACES = {
    "last": _Places("policy", "final_returns"),
    "best": _Places("policy/best", "best_test_returns"),
}
#: The entries of config.json that are read, and their types.
_KINDS = {"env": str, "horizon": int, "seeds": tuple[int, ...] | None, "env_set": tuple[str, ...]}
_NOT_YET = "its training is still running, or was killed: train --resume continues it"


class Run(NamedTuple):
    """A run directory, or a folder of the package with the policy of one seed.

    directory: where it is
    env: the id of its environment
    horizon: the time limit in env steps
    seeds: the numbers of the seeds whose policies are here, where these are not 0, 1, ...
    env_set: settings of the environment, NAME=VALUE each
    packaged: whether it comes with the package
    """

    directory: Path
    env: str
    horizon: int
    seeds: tuple[int, ...] | None = None
    env_set: tuple[str, ...] = ()
    packaged: bool = False

    def place(self, seed: int) -> int:
        """Returns where among the policies that of a seed is; ValueError if it was not kept."""
        if self.seeds is None:
            return seed
        if seed not in self.seeds:
            seeds = " and ".join(map(str, self.seeds))
            raise ValueError(f"{self.directory} has the policies of the seeds {seeds}, not {seed}")
        return self.seeds.index(seed)


def read_run(directory: str | Path) -> Run:
    """Reads the config.json of a run directory; the id of a task is its run of the package.

    Raises:
      ValueError: it is not a run directory, or it has no policy yet.
    """
    directory = expanded(directory)
    if str(directory) in pretrained() and not directory.exists():
        name = str(directory)
        facts = provenance_of(name)
        return Run(FOLDER / name, name, facts["horizon"], (facts["seed"],), packaged=True)
    path = directory / "config.json"
    if not path.is_file():
        if (directory / "sweep.json").is_file():
            raise ValueError(
                f"{directory} is a sweep: name the run of one of its configurations, such as "
                f"{directory / 'policies' / '000'}"
            )
        hint = run_hint(directory)
        # Who names a directory that does not exist may have meant a task.
        if not (hint or directory.is_dir()):
            hint = _packaged(directory.name)
        raise ValueError(f"{directory} is not a run directory: there is no {path}{hint}")
    config: dict[str, Any] = {"seeds": None, "env_set": []} | read_json(path)
    with naming_damage(path):
        # The text of --seeds, of a share of a run; a list where a sweep kept a few.
        if isinstance(config["seeds"], str):
            config["seeds"] = [*read_seeds(config["seeds"])]
        for name, kind in _KINDS.items():
            check_type(name, config.get(name), kind)
        if not 1 <= config["horizon"] < 2**31:
            raise ValueError(f"horizon must be from 1 to 2^31 - 1, got {config['horizon']}")
    # Policies are written when training ends.
    if not (directory / "policy").is_dir():
        raise ValueError(f"{directory} has no policy yet: {_NOT_YET}")
    # None is not (): without a list, the policies are those of the seeds 0, 1, ...
    seeds = config["seeds"]
    if seeds is not None:
        seeds = tuple(seeds)
    return Run(directory, config["env"], config["horizon"], seeds, tuple(config["env_set"]))


def run_hint(path: Path) -> str:
    """Returns what a message adds about a path in a run, such as RUN/policy/best; else nothing."""
    for run in path.parents[:2]:
        if os.path.isfile(run / "config.json") and os.path.isdir(run / "policy"):
            return f"; it is in the run {run}, so name that"
    return ""


def check_policies(folder: Path) -> None:
    """Raises ValueError for a run, a sweep, or a task where a folder of policies was to be named.

    Other folders pass, also those that hold no policies.
    """
    # Not by pathlib, which raises OSError for a folder that may not be entered: what reads
    # policy.json names that.
    is_run = any(os.path.isfile(folder / name) for name in ("config.json", "sweep.json"))
    if not os.path.exists(folder / "policy.json") and (is_run or str(folder) in pretrained()):
        policies = policy_folder(read_run(folder), "last")
        raise ValueError(
            f"{folder} stands for a run, and the folder of its policies is {policies}: name that, "
            f"or give {folder} to mjx_reinforce.load"
        )


def _packaged(name: str) -> str:
    """Returns which tasks the package has policies for, the one that was meant first."""
    tasks = sorted(pretrained())
    hint = "."
    closest_task = nearest(name, tasks)
    if closest_task:
        hint = f". Did you mean {closest_task!r}?"
    return f"{hint} Policies of the package: {', '.join(tasks)}"


def seeds_in(directory: Path) -> tuple[int, ...]:
    """Returns the seeds whose policies a sweep kept in a directory; none where there are none."""
    if not (directory / "config.json").is_file():
        return ()
    return read_run(directory).seeds or ()


def policy_folder(run: Run, choice: PolicyChoice) -> Path:
    """Returns the folder of a run's policies.

    Raises:
      ValueError: the choice is unknown, or the run kept no such policies.
    """
    if choice not in _PLACES:
        raise ValueError(f"which must be one of {', '.join(_PLACES)}, got {choice!r}")
    # The package has one policy of a task, without a folder around it.
    folder = run.directory if run.packaged else run.directory / _PLACES[choice].folder
    if not folder.is_dir():
        raise ValueError(
            f"{run.directory} has no {_PLACES[choice].folder}: it kept the last policies"
        )
    return folder


def choose_seed(run: Run, seed: SeedChoice, choice: PolicyChoice = "last") -> int:
    """Returns the number of a seed.

    Args:
      run: the run.
      seed: a number, which is returned as it is; or "best", "worst" or "median" (the lower one
        of two) by return in the run's final evaluation, where a return that is not finite is
        below all others.
      choice: of which policies the returns are.

    Raises:
      ValueError: the run has no such policies or no final evaluation, or ``seed`` is none of
        these.
    """
    policy_folder(run, choice)
    if run.packaged and run.seeds is not None:
        if (seed, choice) == ("best", "last"):
            return run.seeds[0]
        raise ValueError(
            f"the package has one policy for {run.env}, of the best seed; leave other choices out, "
            "or give a run directory"
        )
    if isinstance(seed, int | np.integer):
        return int(seed)
    if seed not in ("best", "worst", "median"):
        raise ValueError(f"seed must be best, worst, median or a number, got {seed!r}")
    returns = final_returns(run, choice)
    order = np.argsort(returns, kind="stable")
    # Not order[-1]: of equal returns, the best is that of the lowest seed.
    ranks = {"worst": order[0], "median": order[(len(order) - 1) // 2], "best": returns.argmax()}
    place = int(ranks[seed])
    return place if run.seeds is None else run.seeds[place]


def final_returns(run: Run, choice: PolicyChoice) -> np.ndarray:
    """Returns each seed's return [S] in the final evaluation, -inf where it was not finite.

    Raises:
      ValueError: the run has no final evaluation, or none of its returns is finite.
    """
    path = run.directory / "summary.json"
    name = _PLACES[choice].returns
    remedy = "choose a seed by its number"
    # A run that was killed early has no summary; later, one that still says "running".
    summary: dict[str, Any] = read_json(path) if path.exists() else {"status": "running"}
    if summary.get("status") == "running":
        raise ValueError(f"{run.directory} has no final evaluation: {_NOT_YET}; {remedy}")
    if name not in summary:
        raise ValueError(f"{path} has no {name}; {remedy}")
    with naming_damage(path):
        check_type(name, summary[name], tuple[float | None, ...])
        values = np.array(summary[name], float)  # None becomes nan
    if not np.any(np.isfinite(values)):
        raise ValueError(f"{path}: none of {name} is finite, so no seed is the best; {remedy}")
    return np.where(np.isfinite(values), values, -np.inf)


FOLDER = Path(__file__).parent / "trained"
PROVENANCE_FILE = "provenance.json"


def pretrained() -> dict[str, dict[str, Any]]:
    """Returns the tasks that ``load`` has a trained policy for, and where each policy comes from.

    Returns:
      By the id of the task: ``return``, the mean over ``episodes`` episodes without noise from
      starts that nothing else used; ``interval``, which covers the mean with 95%; ``command``,
      ``git_commit``, ``machine``, ``seconds`` (of training) and ``compile_seconds``; ``env_steps``
      and ``seed`` of the policy; ``seeds``, of how many it is the best; ``horizon`` (env steps).

    Examples:
      >>> import mjx_reinforce as mr
      >>> round(mr.pretrained()["HalfCheetah-v5"]["return"]) > 9000
      True
    """
    return {path.name: provenance_of(path.name) for path in sorted(FOLDER.glob("*-v*"))}


def provenance_of(name: str) -> dict[str, Any]:
    """Returns where the policy for a task comes from, as ``pretrained``."""
    return read_json(FOLDER / name / PROVENANCE_FILE)

"""The trained policies that come with the package: the best of each task, from runs.

The policy of the package is one of those that are compared, and stays where no run has a better
one. What it earned is measured again.
"""

import dataclasses
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import stats

from experiments.kit.episodes import own_simulation
from experiments.studies.results.runs import has_policies
from mjx_reinforce import envs
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.export.policy_files import Player, SavedPolicy, load_seed, save_policy
from mjx_reinforce.export.run_files import PROVENANCE_FILE, Run, read_run
from mjx_reinforce.files import read_json, write_json
from mjx_reinforce.settings.config import as_words, changed, is_read
from mjx_reinforce.settings.defaults import of_task

#: Roots of the starts on which policies are compared, and of those on which the best is measured.
_CHOICE, _MEASURE = 718281828, 314159265
#: What a run's command need not say.
_NOT_SAID = {"output", "minutes", "env", "engine", "log"}


class Candidate(NamedTuple):
    """The best seed of a run, by the run's own evaluation, or the package's policy until now."""

    run: Run
    which: str
    player: Player
    saved: SavedPolicy


def pack(directory: Path, folder: Path, num_episodes: int) -> list[str]:
    """Writes the best policy of every task that has a run.

    Args:
      directory: of run directories that ``mjx_reinforce.train`` left, at any depth.
      folder: of the policies, one folder for each task; those of other tasks stay.
      num_episodes: by which the best is chosen, and as many others that measure it.

    Returns:
      A line for each task: its return.

    Raises:
      ValueError: there is no run with policies.
    """
    configure_jax()
    runs = [read_run(path) for path in _runs(directory)]
    if not runs:
        raise ValueError(f"{directory} has no run of a task of this package with policies")
    said = []
    for task in sorted({run.env for run in runs}):
        found = [x for run in runs if run.env == task for x in _candidates(run)]
        # The first of equal ones is chosen.
        found = [*_packaged(folder / task), *found]
        play = _simulations(found, num_episodes)
        means = [float(np.mean(play(x, _CHOICE))) for x in found]
        for candidate, mean in zip(found, means, strict=True):
            print(f"{task}: {mean:.2f}, {_name(candidate)}", flush=True)
        best = found[int(np.argmax(means))]
        returns = play(best, _MEASURE)
        provenance = _origin(best) | _earned(returns)
        if not best.run.packaged:
            actor = jax.tree.map(lambda x: np.asarray(x)[None], best.player.actor)
            save_policy(folder / task, actor, best.saved.settings)
        write_json(folder / task / PROVENANCE_FILE, provenance)
        low, high = provenance["interval"]
        earned = f"{provenance['return']:.2f} ({low:.2f} to {high:.2f})"
        said.append(f"{task}: {earned} on other starts, {_name(best)}")
        print(said[-1], flush=True)
    return said


def _simulations(
    found: Sequence[Candidate], num_episodes: int
) -> Callable[[Candidate, int], np.ndarray]:
    """Returns a function from a candidate and a root of the starts to its returns [N].

    Candidates with equal policies share a program; their networks may differ.
    """
    programs: dict[Any, Any] = {}

    def play(candidate: Candidate, root: int) -> np.ndarray:
        saved = candidate.saved.settings
        key = json.dumps([saved, candidate.run.horizon], sort_keys=True)
        if key not in programs:
            programs[key] = own_simulation(candidate.run, candidate.player, num_episodes)
        return np.asarray(programs[key](candidate.player.actor, root), float)

    return play


def _runs(directory: Path) -> Iterator[Path]:
    for path in sorted(directory.rglob("config.json")):
        run = path.parent
        if envs.is_ours(read_json(path).get("env", "")) and has_policies(run):
            yield run


def _candidates(run: Run) -> Iterator[Candidate]:
    yield Candidate(run, "last", *load_seed(run, "best"))
    # A run that was interrupted has not tested its other policies.
    if "best_test_returns" in read_json(run.directory / "summary.json"):
        yield Candidate(run, "best", *load_seed(run, "best", "best"))


def _packaged(folder: Path) -> Iterator[Candidate]:
    """Returns the package's policy of a task, if there is one."""
    path = folder / PROVENANCE_FILE
    if path.exists():
        facts = read_json(path)
        run = Run(folder, facts["task"], facts["horizon"], (facts["seed"],), packaged=True)
        yield Candidate(run, facts["policy"], *load_seed(run, "best"))


def _name(candidate: Candidate) -> str:
    whose = "the package" if candidate.run.packaged else str(candidate.run.directory)
    return f"{whose}, seed {candidate.player.seed}, {candidate.which}"


def _earned(returns: np.ndarray) -> dict[str, Any]:
    """Returns what episodes say of a policy, see ``run_files.pretrained``."""
    mean, spread = float(np.mean(returns)), float(stats.sem(returns))
    half = spread * float(stats.t.ppf(0.975, len(returns) - 1))
    interval = [round(mean - half, 2), round(mean + half, 2)]
    return {"return": round(mean, 2), "interval": interval, "episodes": len(returns)}


def _origin(best: Candidate) -> dict[str, Any]:
    """Returns where a policy comes from, see ``run_files.pretrained``."""
    if best.run.packaged:
        return read_json(best.run.directory / PROVENANCE_FILE)
    written, summary = (read_json(best.run.directory / f"{x}.json") for x in ("config", "summary"))
    device = written["device"]
    if device == "cpu":
        device = written["cpu"].split(",")[0]
    return {
        "task": best.run.env,
        "command": command(written),
        "git_commit": written["git_commit"],
        "machine": f"{device}, {written['cpu_count']} CPU cores",
        "packages": {k: v for k, v in written["packages"].items() if k in ("jax", "mujoco-mjx")},
        "seconds": round(summary["run_seconds"], 1),
        "compile_seconds": round(summary["compile_seconds"], 1),
        "seeds": summary["num_seeds"],
        "seed": best.player.seed,
        "policy": best.which,
        "env_steps": int(summary["env_steps"][best.player.seed]),
        "horizon": best.run.horizon,
    }


def command(written: dict[str, Any]) -> str:
    """Returns the command line that trains a run again: what it reads and no default says.

    Args:
      written: of the run's config.json.
    """
    default = of_task(written["env"], written["env_steps"], written["num_seeds"])
    known = {k: tuple(v) if isinstance(v, list) else v for k, v in written.items()}
    config = dataclasses.replace(default, **{k: known[k] for k in vars(default) if k in known})
    words = ["python", "-m", "mjx_reinforce.train", "--env", config.env]
    for name in dict.fromkeys((*changed(config, default), "num_seeds", "seed", "env_steps")):
        if name not in _NOT_SAID and is_read(name, config):
            words += as_words(name, getattr(config, name))
    return shlex.join(words)

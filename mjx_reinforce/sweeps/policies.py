"""The policies that a sweep keeps: those of the best and the worst seed of every configuration.

Each chunk keeps its own in parts/; when the sweep ends, DIR/policies/NUMBER/ holds those of a
configuration as a run directory does, so that ``watch`` and ``load`` take it. Training a seed again
would not do: beside others it rounds in another way, and on chaotic tasks that is another run.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.export.policy_files import actor_of, arrays_of, save_policy
from mjx_reinforce.files import Arrays, read_arrays, write_arrays, write_json
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.sweeps.chunks import Runs

#: Arrays of a part beside those of the actors.
_FACTS = ("configuration", "seed", "final_return")


def write_part(parts: Path, runs: Runs, final: np.ndarray, actors: Actor) -> None:
    """Keeps the best and the worst policies of a chunk; raises OSError if that fails.

    Args:
      parts: the folder of the parts.
      runs: R of them, the chunk's.
      final: [R] their returns at the end.
      actors: [R, ...] their policies then.
    """
    facts = (runs.configuration, runs.seed, np.asarray(final, np.float64))
    known: Arrays = dict(zip(_FACTS, facts, strict=True))
    arrays = known | {f"actor/{k}": np.asarray(x) for k, x in arrays_of(actors).items()}
    write_arrays(_part_path(parts, runs.name), _ends(arrays))


def gather(
    directory: Path, parts: Path, settings: Callable[[int], tuple[dict[str, Any], dict[str, Any]]]
) -> None:
    """Writes DIR/policies from the parts; raises OSError if that fails.

    Args:
      directory: of the sweep.
      parts: the folder of its parts.
      settings: the number of a configuration -> those of its policy, and what config.json says
        beside its seeds.
    """
    shutil.rmtree(directory / "policies", ignore_errors=True)
    kept = [read_arrays(path) for path in sorted(parts.glob("policies-[0-9]*.npz"))]
    for number in np.unique(np.concatenate([part["configuration"] for part in kept])).tolist():
        place = directory / "policies" / f"{number:03d}"
        _write_policies(place, _ends(_parts_of(kept, number)), *settings(number))


def _write_policies(
    place: Path, arrays: Arrays, settings: dict[str, Any], run: dict[str, Any]
) -> None:
    """Writes the policies of one configuration, as a run directory."""
    actors = {k.removeprefix("actor/"): x for k, x in arrays.items() if k not in _FACTS}
    save_policy(place / "policy", actor_of(actors), settings)
    seeds, returns = arrays["seed"].tolist(), arrays["final_return"].tolist()
    write_json(place / "summary.json", {"status": "finished", "final_returns": returns})
    write_json(place / "config.json", run | {"seeds": seeds})


def _ends(arrays: Arrays) -> Arrays:
    """Returns the worst and the best run of each configuration, in the order of their seeds."""
    values = np.nan_to_num(arrays["final_return"], nan=-np.inf)
    chosen = set()
    for number in np.unique(arrays["configuration"]):
        runs = np.flatnonzero(arrays["configuration"] == number)
        runs = runs[np.argsort(arrays["seed"][runs])]
        chosen |= {int(runs[values[runs].argmin()]), int(runs[values[runs].argmax()])}
    index = sorted(chosen, key=lambda i: (arrays["configuration"][i], arrays["seed"][i]))
    return {name: x[index] for name, x in arrays.items()}


def _parts_of(parts: Sequence[Arrays], number: int) -> Arrays:
    """Returns what several parts have of one configuration."""
    parts = [part for part in parts if np.any(part["configuration"] == number)]
    return {
        name: np.concatenate([part[name][part["configuration"] == number] for part in parts])
        for name in parts[0]
    }


def _part_path(parts: Path, chunk: str) -> Path:
    return parts / f"policies-{chunk}.npz"

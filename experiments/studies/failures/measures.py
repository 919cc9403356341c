"""What is kept of the runs: a few numbers a seed, in small files from which the page is written."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.kit import rows as kit
from experiments.studies.failures.runs import SOLVED, Measured

Arrays = dict[str, np.ndarray]

#: What is compared between failing and other seeds: measure -> its words.
COMPARED = {
    "scale_position": "std by which the cart's position is divided (m)",
    "clipped_position": "share of steps whose scaled position is clipped",
    "saturated_units": "share of hidden units that are saturated (tanh beyond 0.99)",
    "force_out_of_range": "share of steps whose mean force is out of range",
    "kl": "KL of the update (nats)",
    "policy_std": "std of the actions",
}
#: Updates at which they are compared, counted from 1, with which nothing is scaled yet; after the
#: last of the points that are drawn, many seeds have used their budget.
LOOKS, SHOWN = (2, 3, 4, 6, 8), 14
#: A gradient below this norm has no direction to learn from: no episode did better than another.
NO_GRADIENT = 1e-2


class Kept(NamedTuple):
    """What the page is made of.

    seeds: arm -> [S] each: ``final_return``, ``steps_to_solve`` (NaN if never), ``evaluations``
      after the first solved one, ``fallen`` of these
    base: [S] each, of the first arm: the measures of ``COMPARED`` at ``LOOKS``
    updates: rows of the quartiles of failing and other seeds
    curves: rows of the failing seeds' learning curves
    falls: counts, and the record of how it was measured
    """

    seeds: dict[str, Arrays]
    base: Arrays
    updates: list[dict[str, Any]]
    curves: list[dict[str, Any]]
    falls: dict[str, Any]


def outcomes(run: Measured) -> Arrays:
    """Returns what became of every seed, [S] each."""
    returns, made, after = _returns(run)
    steps = np.cumsum(np.nan_to_num(run.updates["env_steps"]), axis=0)
    solved = (returns >= SOLVED) & made
    first = np.take_along_axis(steps, solved.argmax(axis=0)[None], axis=0)[0]
    return {
        "final_return": run.final_return,
        "final_sampled": run.final_sampled,
        "steps_to_solve": np.where(solved.any(axis=0), first, np.nan),
        "evaluations": after.sum(axis=0),
        "fallen": (after & (returns < SOLVED)).sum(axis=0),
    }


def falls(run: Measured) -> dict[str, float]:
    """Returns how solved policies fell again, counted over updates and episodes of all seeds."""
    returns, _, after = _returns(run)
    x = run.updates
    began = after & (returns < SOLVED)
    began[1:] &= returns[:-1] >= SOLVED
    quiet = x["gradient_norm"] < NO_GRADIENT
    following = np.full_like(x["falls_at_rail_end"], np.nan)
    following[:-1] = x["falls_at_rail_end"][1:]
    all_falls = np.full_like(following, np.nan)
    all_falls[:-1] = x["falls"][1:]
    some = began & (all_falls > 0)
    return {
        "began": int(began.sum()),
        "began_without_gradient": int((began & quiet).sum()),
        "quiet_updates": int((after & quiet).sum()),
        "updates_after": int(after.sum()),
        "kl_after": float(x["kl"][after].sum()),
        "kl_without_gradient": float(x["kl"][after & quiet].sum()),
        "falls_next": float(all_falls[some].sum()),
        "falls_next_at_rail_end": float(following[some].sum()),
        "saturated": float(np.nanmean(x["saturated_units"])),
    }


def _returns(run: Measured) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns evaluations [U, S], whether each was made, and whether it came after a solved one."""
    returns = run.updates["eval_return"]
    made = np.isfinite(returns)
    solved = np.logical_or.accumulate((returns >= SOLVED) & made, axis=0)
    after = np.zeros_like(made)
    after[1:] = solved[:-1] & made[1:]
    return returns, made, after


def compared(run: Measured) -> Arrays:
    """Returns the measures of every seed at ``LOOKS``, and at its last update (0), [S] each."""
    last = np.isfinite(run.updates["kl"]).cumsum(axis=0).argmax(axis=0)
    columns = {}
    for name in COMPARED:
        x = run.updates[name]
        columns |= {f"{name}_{look}": x[look - 1] for look in LOOKS}
        columns[f"{name}_0"] = np.take_along_axis(x, last[None], axis=0)[0]
    return columns


def quartiles(run: Measured) -> list[dict[str, Any]]:
    """Returns quartiles over failing and over other seeds, a row for each update and measure."""
    fails = run.final_return < SOLVED
    rows = []
    for name in COMPARED:
        for group, chosen in (("failing", fails), ("other", ~fails)):
            for update, x in enumerate(run.updates[name][1:SHOWN, chosen], start=2):
                low, middle, high = np.nanquantile(x, (0.25, 0.5, 0.75))
                rows.append(
                    {"measure": name, "group": group, "update": update}
                    | {"low": low, "median": middle, "high": high}
                )
    return rows


def curves(run: Measured) -> list[dict[str, Any]]:
    """Returns the learning curves of failing seeds, a row for each update."""
    steps = np.cumsum(run.updates["env_steps"], axis=0)
    returns = run.updates["eval_return"]
    return [
        {"seed": int(seed), "env_steps": int(steps[u, seed]), "return": returns[u, seed]}
        for seed in np.flatnonzero(run.final_return < SOLVED)
        for u in np.flatnonzero(np.isfinite(returns[:, seed]))
    ]


def joined(parts: list[Measured]) -> Measured:
    """Returns several runs of other seeds as one."""
    length = max(len(part.updates["kl"]) for part in parts)
    updates = {
        name: np.concatenate([_longer(part.updates[name], length) for part in parts], axis=1)
        for name in parts[0].updates
    }
    ends = (np.concatenate([getattr(p, k) for p in parts]) for k in Measured._fields[1:])
    return Measured(updates, *ends)


def _longer(x: np.ndarray, length: int) -> np.ndarray:
    return np.pad(x, ((0, length - len(x)), (0, 0)), constant_values=np.nan)


def save(kept: Kept, folder: Path) -> None:
    """Writes the files."""
    folder.mkdir(exist_ok=True)
    rows = [
        {"arm": arm, "seed": seed} | {name: x[seed] for name, x in columns.items()}
        for arm, columns in kept.seeds.items()
        for seed in range(len(columns["final_return"]))
    ]
    _write(folder / "seeds.csv", rows)
    count = len(next(iter(kept.base.values())))
    _write(folder / "base.csv", [{k: x[i] for k, x in kept.base.items()} for i in range(count)])
    _write(folder / "updates.csv", kept.updates)
    _write(folder / "curves.csv", kept.curves)
    text = json.dumps(kept.falls, indent=2)
    (folder / "falls.json").write_text(text + "\n", encoding="utf-8")


def load(folder: Path) -> Kept:
    """Reads the files."""
    seeds: dict[str, Arrays] = {}
    table = _read(folder / "seeds.csv")
    names = table.pop("arm")
    for arm in dict.fromkeys(names):
        chosen = names == arm
        seeds[arm] = {name: x[chosen].astype(float) for name, x in table.items() if name != "seed"}
    return Kept(
        seeds,
        {name: x.astype(float) for name, x in _read(folder / "base.csv").items()},
        kit.read(folder / "updates.csv"),
        kit.read(folder / "curves.csv"),
        json.loads((folder / "falls.json").read_text("utf-8")),
    )


def _write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    texts = [{k: v if isinstance(v, str) else f"{v:.5g}" for k, v in row.items()} for row in rows]
    kit.write(path, texts)


def _read(path: Path) -> Arrays:
    rows = kit.read(path)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}

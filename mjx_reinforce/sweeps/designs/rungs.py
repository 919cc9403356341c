"""What is trained one after the other: all configurations at once, or by successive halving.

Successive halving (Jamieson and Talwalkar 2016, arXiv:1502.07943): all configurations are trained
for a part of the budget, the better half goes on to twice that, and so on, up to all of it. What is
better is decided by the interquartile mean over seeds of the last returns, so the winner's own
figure is flattered by the choice. It is trained once more, on fresh seeds.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.files import Arrays
from mjx_reinforce.reports.statistics import iqm, iqm_interval
from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.designs.groups import Group

#: The part of a rung's budget that runs which go on have not used before.
_ADDED = 0.5
#: The name of the rung of fresh seeds.
FRESH = "fresh"


class Rung(NamedTuple):
    """Runs that are trained to one budget.

    name: "0" for the first, "1" for those that go on, and so on; or ``FRESH``
    groups: by their number in the sweep, with that budget
    """

    name: str
    groups: dict[int, Group]

    @property
    def before(self) -> str | None:
        """The rung at whose end the runs go on, or None where they begin."""
        return str(int(self.name) - 1) if self.name not in ("0", FRESH) else None

    @property
    def added(self) -> float:
        """The part of its budget for which the runs are trained."""
        return 1.0 if self.before is None else _ADDED


def _num_halvings(search: str, configurations: int) -> int:
    """Returns how often the configurations are halved: until one is left, or never."""
    return (configurations - 1).bit_length() if search == "halving" else 0


def num_rungs(search: str, configurations: int) -> int:
    """Returns how many rungs a sweep has."""
    return 1 + _num_halvings(search, configurations) + (search != "grid")


def part_trained(search: str, configurations: int) -> float:
    """Returns how many env steps a search trains, as a part of what training all of them takes."""
    halvings = _num_halvings(search, configurations)
    kept, steps = configurations, configurations / 2**halvings
    for number in range(1, halvings + 1):
        kept = -(-kept // 2)
        steps += kept * _ADDED * 2 ** (number - halvings)
    return (steps + (search != "grid")) / configurations


def plan_rungs(
    groups: Sequence[Group], search: str, measured: Callable[[str], Arrays]
) -> Iterator[Rung]:
    """Yields the rungs of a sweep; each must have been trained before the next is asked for.

    Args:
      groups: of all configurations.
      search: "grid", "random" or "halving".
      measured: returns what a rung measured, see ``best``.
    """
    kept = np.concatenate([group.members for group in groups]).tolist()
    halvings = _num_halvings(search, len(kept))
    for number in range(halvings + 1):
        yield Rung(str(number), _part_of(groups, kept, 2 ** (halvings - number), seed=None))
        if search != "grid":
            half = -(-len(kept) // 2) if number < halvings else 1
            kept = best(measured(str(number)), half)
    if search != "grid":
        yield Rung(FRESH, _part_of(groups, kept, 1, (groups[0].config.seed + 1) % 2**32))


def winner(measured: Callable[[str], Arrays]) -> dict[str, Any]:
    """Returns what sweep.json says of the configuration that a search chose.

    Args:
      measured: returns what a rung measured.
    """
    rungs, number = measured("0"), 0
    while later := measured(str(number + 1)):
        rungs, number = later, number + 1
    fresh = measured(FRESH)
    chosen = int(fresh["configuration"][0])
    search = rungs["eval_return"][-1, rungs["configuration"] == chosen].astype(float)
    final = fresh["eval_return"][-1].astype(float)
    low, high = iqm_interval(final)
    return {
        "configuration": chosen,
        "iqm_in_search": float(iqm(search)),
        "iqm": float(iqm(final)),
        "iqm_ci": [float(low), float(high)],
        "final_returns": final.tolist(),
    }


def _part_of(
    groups: Sequence[Group], kept: Sequence[int], divisor: int, seed: int | None
) -> dict[int, Group]:
    """Returns the groups with the configurations that are kept, and a part of the budget."""
    chosen = {}
    for number, group in enumerate(groups):
        mask = np.isin(group.members, kept)
        if mask.any():
            config = _with_part_of_budget(group.config, divisor)
            config = config if seed is None else dataclasses.replace(config, seed=seed)
            settings = {name: values[mask] for name, values in group.settings.items()}
            chosen[number] = Group(config, group.members[mask], settings)
    return chosen


def _with_part_of_budget(config: Config, divisor: int) -> Config:
    """Returns the settings with a part of their budgets, at least one update of each."""
    budgets = {
        name: -(-limit // divisor)
        for name in ("env_steps", "max_updates")
        if (limit := getattr(config, name)) is not None
    }
    return dataclasses.replace(config, **budgets)


def best(measured: Mapping[str, np.ndarray], count: int) -> list[int]:
    """Returns the best configurations by the interquartile mean of their last returns.

    Args:
      measured: ``configuration`` [R] and ``eval_return`` [E, R] of a rung.
      count: how many; of equal ones the first.
    """
    numbers = np.unique(measured["configuration"])
    last = measured["eval_return"][-1]
    means = np.array([iqm(last[measured["configuration"] == n].astype(float)) for n in numbers])
    order = np.argsort(-np.where(np.isfinite(means), means, -np.inf), kind="stable")
    return sorted(numbers[order[:count]].tolist())

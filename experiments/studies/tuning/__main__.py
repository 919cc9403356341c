"""The searches behind the default settings; data is what is kept of them.

    python -m experiments.studies.tuning list            # the searches
    python -m experiments.studies.tuning run NAME DIR    # trains one again, and writes DIR/NAME.csv
    python -m experiments.studies.tuning keep NAME DIR   # DIR/NAME.csv of the sweep in DIR/NAME

searches.json has their configurations, drawn at random or chosen after earlier ones, and the
settings that all share, where they differ from the plain ones. Names begin with the number of the
round. A CSV has a row for each configuration, best first; searches that were stopped for time
("stopped") have as many env steps as they reached. No seed of a search is among those of
docs/results.md.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np

from experiments.studies.results.measures import least_share_solved, solved_within
from mjx_reinforce.files import csv_bytes, read_json, write_bytes
from mjx_reinforce.reports.statistics import steps_to_solve
from mjx_reinforce.settings.config import Config
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.perform import perform
from mjx_reinforce.sweeps.run import SweepResults, read_results

KEPT = Path(__file__).parent / "data"
#: The env steps within which a pendulum should be solved, and from which on it should stay so.
_SOLVED, _STAYS = 100_000, 200_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Listed(Design):
    """A sweep of configurations that are listed."""

    listed: tuple[dict[str, Any], ...]

    def count(self) -> int:
        """Returns how many there are."""
        return len(self.listed)

    def configurations(self) -> list[dict[str, Any]]:
        """Returns them."""
        return list(self.listed)


def main() -> None:
    """Reads the command line and does what it says."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.tuning",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    searches = read_json(KEPT / "searches.json")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the searches")
    for name in ("run", "keep"):
        command = commands.add_parser(name)
        command.add_argument("name", choices=searches)
        command.add_argument("directory", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "list":
        for name, search in searches.items():
            print(f"{name}: {len(search['configurations'])} configurations, {search['settings']}")
        return
    search, place = searches[arguments.name], arguments.directory / arguments.name
    try:
        if arguments.command == "run":
            perform(_design(search, place), None, [], report=False)
        keep(read_results(place), arguments.directory / f"{arguments.name}.csv")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _design(search: dict[str, Any], place: Path) -> Design:
    settings: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in search["settings"].items()
    }
    values = {name: [one[name] for one in search["configurations"]] for name in _names(search)}
    same = {name: found[0] for name, found in values.items() if len(set(found)) == 1}
    over = {name: sorted(set(found)) for name, found in values.items() if name not in same}
    listed = tuple({name: one[name] for name in over} for one in search["configurations"])
    base = Config(**settings, **same, output=place)
    return Listed(base=base, over=over, listed=listed)


def _names(search: dict[str, Any]) -> list[str]:
    return list(search["configurations"][0])


def keep(results: SweepResults, path: Path) -> None:
    """Writes a row for each configuration, by the mean over its seeds of the last return.

    Of a task with a threshold also the share of seeds solved within ``_SOLVED`` env steps, the
    least share solved at once from ``_STAYS`` on, and the median env steps to solve.
    """
    assert results.directory is not None  # it was given one
    threshold = read_json(results.directory / "sweep.json")["threshold"]
    rows = [
        values | _measure(results, results.configuration == number, threshold)
        for number, values in enumerate(results.configurations)
    ]
    rows.sort(key=lambda row: -float(row["mean"]))
    write_bytes(path, csv_bytes(tuple(rows[0]), rows))


def _measure(results: SweepResults, mine: np.ndarray, threshold: float | None) -> dict[str, str]:
    returns, steps = results.eval_return[:, mine], results.env_steps[:, mine]
    last = returns[-1]
    found = {
        "seeds": len(last),
        "env_steps": steps[-1].mean(),
        **{name: getattr(np, name)(last) for name in ("mean", "std", "min", "median", "max")},
    }
    if threshold is not None:
        solved = [np.inf if x is None else x for x in steps_to_solve(returns, steps, threshold)]
        stop = float(steps[-1].min())
        found["solved_within_100k"] = solved_within(solved, _SOLVED) / len(last)
        found["least_share_solved"] = (
            least_share_solved(returns, steps, threshold, _STAYS, stop) if stop > _STAYS else np.nan
        )
        found["median_steps_to_solve"] = np.median(solved)
    return {name: f"{float(x):.6g}" for name, x in found.items()}


if __name__ == "__main__":
    main()

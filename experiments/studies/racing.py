"""Does a race win? N races of K policies, beside K independent runs for each of N seeds.

    python -m experiments.studies.racing DIR --env Walker2d-v5 --minutes 4 --num-seeds 16 --race 4

DIR/race is a run of ``python -m mjx_reinforce.train`` with --race; DIR/independent one without, of
N * K seeds, whose policies begin as those of the races, with as many env steps each. So both train
as many policies side by side, for about as long. Of each K independent policies one is chosen as a
race chooses its leader, by its training returns. Words that the command does not know go to both
runs. DIR/racing.csv has a row for each arm, with the test returns of the N policies that were
chosen, and one for all N * K independent policies without a choice. The same command goes on with
runs that were stopped.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.kit import rows
from experiments.kit.markdown import table
from experiments.studies.results.runs import ended
from mjx_reinforce.files import read_arrays, read_json
from mjx_reinforce.statistics import estimate_mean, worst_if_not_finite
from mjx_reinforce.training import race


def main() -> None:
    """Reads the command line, trains what is not trained yet, and says what came of it."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.racing",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("directory", type=Path)
    parser.add_argument("--num-seeds", type=int, default=16, help="N, how many races")
    parser.add_argument("--race", type=int, default=4, help="K, the policies of each")
    arguments, words = parser.parse_known_args()
    raced, independent = (arguments.directory / name for name in ("race", "independent"))
    sizes = ["--num-seeds", str(arguments.num_seeds), "--race", str(arguments.race)]
    _train(raced, [*words, *sizes])
    # As many env steps: a budget in time would be measured anew.
    env_steps = read_json(raced / "config.json")["env_steps"]
    num_policies = arguments.num_seeds * arguments.race
    repeated = ["--like", str(raced), "--race", "1", "--num-seeds", str(num_policies)]
    _train(independent, [*repeated, "--env-steps", str(env_steps)])
    comparison = compare(raced, independent)
    rows.write(arguments.directory / "racing.csv", comparison)
    print(table([*comparison[0]], [[str(x) for x in row.values()] for row in comparison]))


def _train(directory: Path, words: Sequence[str]) -> None:
    """Trains a run to its end, if it has not ended; exits where it fails or is stopped."""
    if ended(directory):
        return
    goes_on = (directory / "config.json").exists()
    place = ["--resume", str(directory)] if goes_on else [*words, "--output", str(directory)]
    if code := subprocess.call([sys.executable, "-m", "mjx_reinforce.train", *place]):
        sys.exit(code)


def compare(raced: Path, independent: Path) -> list[dict[str, object]]:
    """Returns a row for each arm, from the directories of the two runs."""
    config = read_json(raced / "config.json")
    race_summary, summary = (read_json(x / "summary.json") for x in (raced, independent))
    training = read_arrays(independent / "returns.npz", ("episode_return", "env_steps"))
    # A seed whose budget is used plays no more; before, every update plays some env steps.
    updates = (np.diff(training["env_steps"], axis=0, prepend=0) > 0).sum(axis=0)
    scores = race.scores(training["episode_return"], updates)
    returns = np.array(summary["final_test_returns"])
    arms = {
        f"race of {config['race']}": (race_summary, np.array(race_summary["final_test_returns"])),
        f"best of {config['race']}": (summary, returns[race.leaders(scores, config["race"])]),
        "no choice": (summary, returns),
    }
    return [_row(config["env"], name, *arm) for name, arm in arms.items()]


def _row(env: str, name: str, summary: dict, returns: np.ndarray) -> dict[str, object]:
    """Returns what the policies of an arm return in the test, and what all of its run cost."""
    mean = estimate_mean(worst_if_not_finite(returns))
    return {
        "task": env,
        "arm": name,
        "policies": len(returns),
        "mean": f"{mean.value:.6g}",
        "low": f"{mean.low:.6g}",
        "high": f"{mean.high:.6g}",
        "worst": f"{returns.min():.6g}",
        "best": f"{returns.max():.6g}",
        "seconds": f"{summary['run_seconds']:.1f}",
        "env_steps": sum(summary["env_steps"]),
    }


if __name__ == "__main__":
    main()

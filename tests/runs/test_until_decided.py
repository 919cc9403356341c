"""Sweeps that train seeds until the best is decided: what they leave out, and how they go on."""

import json
from pathlib import Path

import numpy as np
import pytest

from mjx_reinforce.report import WrittenReport
from mjx_reinforce.runs import command_line, perform
from mjx_reinforce.runs.results import read_results
from mjx_reinforce.runs.sweep_saving import SweepFiles
from mjx_reinforce.statistics.sequential import look_seeds, sequential_test
from mjx_reinforce.training import driver

SWEEP = (
    "--env Drift-v0 --num-episodes 8 --eval-episodes 8 --hidden-sizes 4 --env-steps None "
    "--max-updates 8 --num-seeds 24 --until-decided --over learning-rate 1e-6 1e-5 3e-1"
)


class CrashError(Exception):
    pass


@pytest.fixture
def run(run, monkeypatch):
    """Runs a sweep of arguments in one string; the report has tests of its own."""
    monkeypatch.setattr(perform, "_report", lambda directory: WrittenReport(0.0, [], 0))
    return lambda line: run(*line.split(), command=command_line.sweep)


@pytest.mark.slow
def test_seeds_end_with_the_decision_and_a_crash_changes_nothing(run, monkeypatch):
    assert run(f"{SWEEP} --output whole") == 0
    decision = json.loads(Path("whole/sweep.json").read_text())["decision"]
    whole = read_results(Path("whole"))
    numbers = np.bincount(whole.configuration, minlength=3).tolist()
    # The last rate alone learns, and the two others are alike.
    assert decision["contenders"] == [2]
    assert decision["looks"] == look_seeds(24)[: len(decision["looks"])]
    assert decision["num_seeds"] == numbers
    assert max(numbers) < 24
    returns = [whole.eval_return[-1, whole.configuration == member] for member in range(3)]
    assert sequential_test(returns, 24)._asdict() == decision
    assert sorted(path.name for path in Path("whole/policies").iterdir()) == ["000", "001", "002"]

    write, drive, parts = SweepFiles._write_part, driver.Driver.drive, []

    def crash_after_part(*arguments):
        write(*arguments)
        parts.append(None)
        if len(parts) == 2:
            raise CrashError

    def interrupted(self, *arguments):
        # In the middle of the third stage.
        if self.runs.name != "000-2-0000":
            drive(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(SweepFiles, "_write_part", crash_after_part)
        with pytest.raises(CrashError):
            run(f"{SWEEP} --output parts")
    with monkeypatch.context() as patch:
        patch.setattr(driver.Driver, "drive", interrupted)
        assert run("--resume parts") == 0
    record = json.loads(Path("parts/sweep.json").read_text())
    assert (record["status"], record["decision"]["looks"]) == ("interrupted", [3, 6])
    assert run("--resume parts") == 0
    resumed = read_results(Path("parts"))
    for one, other in zip(whole[2:], resumed[2:], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_groups_take_turns_and_the_excluded_train_no_more(run):
    """Two programs, of which one has no contender left, and several chunks in a stage."""
    assert run(f"{SWEEP} --over num-episodes 8 2 --chunk-runs 4 --output groups") == 0
    decision = json.loads(Path("groups/sweep.json").read_text())["decision"]
    results = read_results(Path("groups"))
    assert np.bincount(results.configuration, minlength=6).tolist() == decision["num_seeds"]
    assert set(decision["contenders"]) <= {4, 5}
    assert max(decision["num_seeds"][:4]) < max(decision["num_seeds"][4:])
    for member in range(6):
        seeds = results.seed[results.configuration == member]
        assert seeds.tolist() == list(range(decision["num_seeds"][member]))


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--num-seeds 5", "cannot decide with 5 seeds"),
        ("--seeds 0:16", "--seeds 0:16 is a share of them"),
    ],
)
def test_what_cannot_be_decided_is_refused(run, capsys, flags, said):
    line = f"--env CartPole-v1 --over learning-rate 1e-2 1e-1 --until-decided {flags}"
    assert run(line) == 2
    assert said in capsys.readouterr().err

"""Races: who leads, who is dropped, what a copy has, what it costs, and that it goes on exactly."""

import contextlib
import json
import shutil

import jax
import numpy as np
import pytest
from command_lines import added_environments, run_command
from fake_sweeps import make_sweep
from measured_runs import ONE, make_measured_run
from pages import findings_of
from saved_runs import assert_same

from mjx_reinforce.engine import counts
from mjx_reinforce.export.policy_files import read_policy
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.reports import words
from mjx_reinforce.reports.findings import compute_findings
from mjx_reinforce.reports.sources import read_metrics, read_tasks
from mjx_reinforce.reports.tasks import compare_tasks
from mjx_reinforce.runs import command_line
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training import race
from mjx_reinforce.training.driver import RunDriver, Runs
from mjx_reinforce.training.record import Measured
from mjx_reinforce.training.run_record import RunRecord
from mjx_reinforce.training.state import RunState, copied

SMALL = ["--env", "ContinuousCartPole-v0", "--num-seeds", "2", "--eval-episodes", "2"]
SMALL += ["--num-episodes", "4", "--hidden-sizes", "4", "--env-steps", "None"]


def test_a_policy_is_judged_by_the_last_tenth_of_its_updates():
    returns = np.arange(40.0).reshape(20, 2)
    returns[19, 1] = np.nan
    assert race.scores(returns, np.array([20, 20])).tolist() == [37.0, 37.0]
    assert race.scores(returns, np.array([20, 5])).tolist() == [37.0, 9.0]
    assert race.scores(np.full((20, 2), np.nan), np.array([20, 20])).tolist() == [-np.inf] * 2
    assert race.scores(np.zeros((0, 2)), np.zeros(2, int)).tolist() == [-np.inf] * 2


def test_the_better_half_replaces_the_worse_in_its_own_race_alone():
    scores = np.array([3.0, 1.0, 4.0, 2.0, 9.0, 8.0, 7.0, 6.0])
    assert race.leaders(scores, 4).tolist() == [2, 4]
    assert race.leaders(scores, 1).tolist() == [*range(8)]
    assert race.sources(scores, np.array([True, False])).tolist() == [0, 2, 2, 0, 4, 5, 6, 7]
    assert race.sources(scores, np.array([True, True])).tolist() == [0, 2, 2, 0, 4, 5, 5, 4]
    odd = np.array([-np.inf, 5.0, -np.inf])
    assert race.sources(odd, np.array([True])).tolist() == [0, 1, 1]
    assert race.sources(np.zeros(2), np.array([True])).tolist() == [0, 0]


KEYS = jax.random.split(jax.random.key(0), 4)


def states():
    """Four policies after 5 to 8 updates."""
    made = np.stack([counts.from_int(x) for x in (5, 6, 7, 8)])
    train_states = TrainState(
        key=KEYS,
        num_updates=made,
        env_steps=made,
        progress=np.zeros(4),
        actor={"w": np.arange(8.0).reshape(4, 2)},
    )
    return RunState(train_states=train_states, eval_keys=KEYS[::-1])


def test_a_copy_has_weights_of_its_source_and_keys_of_its_own():
    copy = copied(states(), np.array([0, 1, 0, 3]))
    assert copy.train_states.actor["w"].tolist() == [[0, 1], [2, 3], [0, 1], [6, 7]]
    assert counts.to_int(copy.train_states.num_updates).tolist() == [5, 6, 5, 8]
    assert (copy.train_states.key == KEYS).all()
    assert (copy.eval_keys == KEYS[::-1]).all()


class Held:
    """Slots that hold states, and move nothing."""

    def __init__(self):
        self.state = states()

    def states(self):
        return self.state

    def restore(self, state):
        self.state = state


def test_a_run_goes_on_with_the_copies():
    config = Config(num_seeds=2, race=2, env_steps=100)
    record, held = RunRecord(config, threshold=None), Held()
    driver = RunDriver(config, held, record, Runs("000-0000", *np.zeros((3, 4), int)))
    record.add_updates(update([1.0, 2.0, 6.0, 5.0], [30, 10, 40, 40]))
    driver._cut()
    assert held.state.train_states.actor["w"][:, 0].tolist() == [2, 2, 4, 4]
    assert driver.states is held.state
    assert driver.last_actors()["w"][:, 0].tolist() == [2, 4]
    driver._cut()
    assert held.state is driver.states


def update(returns, env_steps):
    """A block of one update, without its evaluation."""
    ones = np.ones((1, len(returns)), np.int32)
    metrics = dict.fromkeys(("episodes", "simulated_steps"), ones)
    metrics |= dict.fromkeys(("nonfinite_episodes", "skipped_update"), 0 * ones)
    metrics |= {"active": ones > 0, "episode_return": np.float32([returns])}
    return Measured(np.arange(len(returns)), metrics | {"env_steps": ones * env_steps}, {})


def evaluation(returns):
    zeros = {name: np.zeros(len(returns), np.int32) for name in ("simulated_steps", "eval_steps")}
    return Measured(np.arange(len(returns)), {}, {"eval_return": np.float32(returns)} | zeros)


def test_a_cut_gives_a_policy_the_line_of_its_source_and_forgets_no_cost():
    config = Config(num_seeds=2, race=2, env_steps=100)
    record = RunRecord(config, threshold=None)
    record.add_updates(update([1.0, 2.0, 6.0, 5.0], [10, 30, 20, 20]))
    assert record.cut().tolist() == [1, 1, 2, 3]  # the first race alone has used a quarter
    assert record.cut() is None
    assert record.env_steps.tolist() == [30, 30, 20, 20]
    assert record.played_steps().tolist() == [40, 40]
    assert record._columns("training")["episode_return"].tolist() == [[2, 2, 6, 5]]
    record.add_updates(update([7.0, 3.0, 5.0, 8.0], [10, 10, 10, 60]))
    rows = record.add_evaluation(evaluation([70, 30, 50, 80]), seconds=1.0)
    assert rows["eval_return"].tolist() == [70, 80]
    assert rows["train_return"].tolist() == [7, 8]
    assert rows["env_steps"].tolist() == [60, 110]
    assert rows["episodes"].tolist() == [4, 4]
    assert rows["seed"].tolist() == [0, 1]
    assert record.cut().tolist() == [0, 1, 3, 3]  # two shares at once are one cut
    assert record.cuts.tolist() == [1, 3]
    assert record.training()["episode_return"].tolist() == [[2, 5], [7, 8]]
    assert record.history()["env_steps"].tolist() == [[60, 110]]
    summary = record.summary("vmap", 0.0, 2.0)
    assert summary["env_steps"] == [60, 110]
    assert summary["env_steps_per_second"] == 85.0
    assert summary["race"] == 2
    other = RunRecord(config, threshold=None)
    other.restore(record.arrays())
    assert other.arrays().keys() == record.arrays().keys()
    assert all(np.array_equal(x, record.arrays()[name]) for name, x in other.arrays().items())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two races of two: 24 updates, cuts after 10, 15 and 20; a checkpoint at 20 is left."""
    directory = tmp_path_factory.mktemp("raced")
    with added_environments(), contextlib.chdir(directory):
        budget = ["--max-updates", "24", "--checkpoint-every", "5", "--output", "whole"]
        assert run_command(*SMALL, "--race", 2, *budget) == 0
    return directory / "whole"


@pytest.mark.slow
def test_a_race_that_goes_on_is_the_race_that_never_stopped(run, whole, tmp_path, capsys):
    """Also where a cut was due, but not yet made, when it was killed."""
    parts = shutil.copytree(whole, tmp_path / "parts")
    (parts / "summary.json").write_text('{"status": "running"}')
    [*_, newest] = sorted((parts / "checkpoint").iterdir())
    newest.unlink()
    assert run("--resume", "parts") == 0
    assert "going on after 20 updates" in capsys.readouterr().out
    assert_same(whole, parts)


@pytest.mark.slow
def test_a_race_costs_what_all_its_policies_play_and_leaves_one_a_seed(whole):
    summary = json.loads((whole / "summary.json").read_text())
    assert summary["race"] == 2
    rows = read_metrics(whole / "metrics.csv")
    assert rows["seed"].tolist() == [0, 1]
    assert rows["env_steps"][-1].tolist() == summary["env_steps"]
    with np.load(whole / "returns.npz") as training:
        line = training["env_steps"][-1]
        assert training["episode_return"].shape == (24, 2)
    # The other policy of a race has played its part, which is no part of the line.
    assert (1.2 * line < summary["env_steps"]).all()
    assert len(summary["final_test_returns"]) == len(summary["best_test_returns"]) == 2
    assert read_policy(whole / "policy").num_seeds == 2


@pytest.mark.slow
def test_a_race_of_one_is_the_plain_run(run, tmp_path):
    assert run(*SMALL, "--max-updates", 10, "--output", "plain") == 0
    assert run(*SMALL, "--max-updates", 10, "--race", 1, "--output", "one") == 0
    assert_same(tmp_path / "plain", tmp_path / "one")


def test_races_that_do_not_fit_are_refused(run, capsys):
    refused = {
        ("--race", 0): "--race must be at least 1",
        ("--race", 2**30): "has no random numbers for seed 1: a race of seed n takes",
    }
    for arguments, said in refused.items():
        assert run(*SMALL, "--max-updates", 10, *arguments) == 2
        assert said in capsys.readouterr().err
    swept = ["--over", "learning-rate", "1e-3", "1e-2"]
    assert run(*SMALL, "--max-updates", 10, "--race", 2, *swept, command=command_line.sweep) == 2
    assert "--race is for one run, not for a sweep" in capsys.readouterr().err


def test_a_report_has_no_race_without_its_label(tmp_path):
    plain = make_measured_run(tmp_path / "plain")
    raced = make_measured_run(tmp_path / "raced", race=4)
    said = "is the best of a race"
    alone = findings_of(raced)
    assert alone.labels == ["CartPole-v1, race 4"]
    assert any(said in one for one in words.caveats(alone))
    both = findings_of(plain, raced)
    assert sorted(both.labels) == ["race 1", "race 4"]
    assert any(said in one and "race 1" not in one for one in words.caveats(both))
    assert not any(said in one for one in words.caveats(findings_of(plain)))
    swept = findings_of(make_sweep(tmp_path / "sweep", over=ONE))
    assert not any(said in one for one in words.caveats(swept))
    other = make_measured_run(tmp_path / "other", env="InvertedPendulum-v5")
    with pytest.raises(ValueError, match="no configuration is in all tasks"):
        compare_tasks([compute_findings(x) for x in read_tasks([raced, other])])

"""Budgets: those of the defaults, in time, and of runs that begin where others ended."""

import dataclasses
import json
import math

import pytest

from experiments.kit.trainings import results
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings import defaults, tables
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.settings.defaults import of_task

SMALL = [
    "--env",
    "ContinuousCartPole-v0",
    "--num-seeds",
    "3",
    "--eval-episodes",
    "2",
    "--num-episodes",
    "4",
]
SMALL += ["--hidden-sizes", "4"]


def settings(directory):
    return json.loads((directory / "config.json").read_text())


@pytest.mark.slow
def test_minutes_become_env_steps_that_repeat_the_run_and_go_on(run, tmp_path, capsys):
    """On from its last state, whatever that is, with no row lost; and never from the beginning."""
    assert run(*SMALL, "--minutes", 0.02, "--output", "first") == 0
    found = settings(tmp_path / "first")
    assert found["minutes"] is None
    assert found["env_steps"] > 100
    assert run("--like", "first", "--output", "second") == 0
    one, other = results(tmp_path / "first"), results(tmp_path / "second")
    assert all(one[name] == other[name] for name in one)
    second = tmp_path / "second"
    assert settings(second)["env_steps"] == found["env_steps"]
    rows = (second / "metrics.csv").read_text()
    assert run("--resume", "second", "--minutes", 0.01) == 0
    after = json.loads((second / "summary.json").read_text())
    assert min(after["env_steps"]) >= settings(second)["env_steps"] > found["env_steps"]
    assert (second / "metrics.csv").read_text().startswith(rows)
    capsys.readouterr()
    for path in (second / "checkpoint").iterdir():
        path.unlink()
    before = results(second)
    refused = {
        ("--resume", "second", "--minutes", 1): "has no checkpoint to go on from",
        ("--resume", "second", "--like", "second"): "leave --like out",
        ("categorical-cartpole", "--like", "first"): "leave the preset categorical-cartpole out",
    }
    for arguments, words in refused.items():
        assert run(*arguments) == 2
        assert words in capsys.readouterr().err
    assert results(second) == before


@pytest.mark.parametrize("gpu", [False, True])
def test_a_default_run_has_the_budget_of_its_machine(monkeypatch, gpu):
    monkeypatch.setattr(defaults, "has_gpu", lambda: gpu)
    for env in tables.OF_TASKS:
        config = of_task(env)
        check(config)
        own = tables.OF_TASKS[env].get("env_steps", Config.env_steps)
        assert config.env_steps >= own
        if env in tables.SOLVED:
            assert config.env_steps == own
        # More seeds than a default run has leave each with what it would learn.
        assert of_task(env, num_seeds=1000) == dataclasses.replace(config, num_seeds=1000)
        assert parse(["--env", env]) == config
        if gpu and env in tables.OF_BUDGETS:
            assert config.num_episodes >= 128
        assert config.env_steps <= tables.ENOUGH.get(env, math.inf)
        one, two = (of_task(env, seconds=x).env_steps for x in (60.0, 120.0))
        assert two == pytest.approx(2 * one, rel=0.06)


def test_a_budget_chooses_the_settings():
    few, some, many = (of_task("Hopper-v5", steps) for steps in (10**6, 3 * 10**6, 10**12))
    assert [x.num_episodes for x in (few, some, many)] == [16, 64, 1024]
    assert some.update == "natural-gradient"
    assert few.eval_every == 10
    assert many.env_steps == 10**12
    assert few.decay_steps == 1_500_000  # it does not end before the run
    assert some.decay_steps == many.decay_steps == "budget"
    # An interrupt of so long a run does not wait for a fiftieth of it.
    between = defaults.expected_env_steps(20.0, many)
    assert many.eval_every == max(few.eval_every, between // (1024 * 1000))
    assert many.eval_every < 10**12 // (1024 * 1000 * 50)
    medium = of_task("HalfCheetah-v5", 5 * 10**7)
    assert medium.eval_every == 5 * 10**7 // 50 // (16 * 250)
    for config in (few, some, many):
        words = ["--env", "Hopper-v5", "--env-steps", str(config.env_steps)]
        assert parse(words) == config
    assert parse(["--env=Hopper-v5", "--env-steps=1000000", "--num-seeds=9"]).num_seeds == 9

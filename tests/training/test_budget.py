"""Budgets: those of the defaults, in time, and of runs that begin where others ended."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest

from experiments.kit.trainings import results
from mjx_reinforce.export.policy_files import load_policy
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings import defaults, tuned
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.settings.defaults import of_task

SMALL = ["--env", "Drift-v0", "--num-seeds", "3", "--eval-episodes", "2", "--num-episodes", "4"]
SMALL += ["--hidden-sizes", "4"]


def settings(directory):
    return json.loads((directory / "config.json").read_text())


def test_minutes_become_env_steps_that_repeat_the_run(run, tmp_path):
    assert run(*SMALL, "--minutes", 0.02, "--output", "first") == 0
    found = settings(tmp_path / "first")
    assert found["minutes"] is None
    assert found["env_steps"] > 100
    assert run("--like", "first", "--output", "second") == 0
    one, other = results(tmp_path / "first"), results(tmp_path / "second")
    assert all(one[name] == other[name] for name in one)
    assert settings(tmp_path / "second")["env_steps"] == found["env_steps"]


def test_a_run_goes_on_for_minutes(run, tmp_path):
    """From its last state, whatever that is, and with none of its rows lost."""
    assert run(*SMALL, "--env-steps", 777, "--output", "out") == 0
    rows = (tmp_path / "out" / "metrics.csv").read_text()
    assert run("--resume", "out", "--minutes", 0.01) == 0
    after = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert min(after["env_steps"]) >= settings(tmp_path / "out")["env_steps"] > 777
    assert (tmp_path / "out" / "metrics.csv").read_text().startswith(rows)


def test_a_run_begins_with_the_policies_of_another(run, tmp_path):
    assert run(*SMALL, "--max-updates", 3, "--output", "first") == 0
    more = ["--max-updates", 1, "--learning-rate", 1e-12, "--normalize-steps", 0]
    assert run(*SMALL, *more, "--num-seeds", 5, "--init-from", "first", "--output", "next") == 0
    _, actor = load_policy(tmp_path / "first" / "policy")
    _, later = load_policy(tmp_path / "next" / "policy")
    for name, before in actor.params["network"]["params"]["Dense_0"].items():
        after = np.asarray(later.params["network"]["params"]["Dense_0"][name])
        np.testing.assert_allclose(after, np.asarray(before)[[0, 1, 2, 0, 1]], atol=1e-6)
    assert settings(tmp_path / "next")["init_from"] == "first"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--minutes", 1, "--env-steps", 100], "both say when the run ends"),
        (["--minutes", 0], "--minutes must be positive and finite, got 0"),
        (["--init-from", "nowhere"], "nowhere is no run directory"),
        (
            ["--init-from", "wide", "--hidden-sizes", 4],
            r"have hidden_sizes \[5\], and this run \[4",
        ),
        (["--like", "nowhere"], "--like nowhere: there is no run"),
    ],
)
def test_nonsense_is_refused_in_words(run, capsys, arguments, words):
    if "wide" in arguments:
        assert run(*SMALL, "--hidden-sizes", 5, "--max-updates", 1, "--output", "wide") == 0
    assert run(*SMALL, *arguments, "--output", "out") == 2
    assert re.search(words, capsys.readouterr().err)


@pytest.mark.parametrize("gpu", [False, True])
@pytest.mark.parametrize("env", tuned.OF_TASKS)
def test_a_default_run_has_the_budget_of_its_machine(monkeypatch, env, gpu):
    monkeypatch.setattr(defaults, "has_gpu", lambda: gpu)
    config = of_task(env)
    check(config)
    own = tuned.OF_TASKS[env].get("env_steps", Config.env_steps)
    assert config.env_steps >= own
    if env in tuned.SOLVED:
        assert config.env_steps == own
    # More seeds than a default run has leave each with what it would learn.
    assert of_task(env, num_seeds=1000) == dataclasses.replace(config, num_seeds=1000)
    assert parse(["--env", env]) == config
    if gpu and env in tuned.OF_BUDGETS:
        assert config.num_episodes >= 128
    assert config.env_steps <= tuned.ENOUGH.get(env, math.inf)
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


def test_settings_of_two_sources_are_refused(run, tmp_path, capsys):
    assert run(*SMALL, "--max-updates", 2, "--output", "out") == 0
    assert run("--resume", "out", "--like", "out") == 2
    assert "leave --like out" in capsys.readouterr().err
    assert run("categorical-cartpole", "--like", "out") == 2
    assert "leave the preset categorical-cartpole out" in capsys.readouterr().err


def test_minutes_never_begin_a_run_again(run, tmp_path, capsys):
    """Its checkpoints are gone: what it left stays."""
    assert run(*SMALL, "--max-updates", 2, "--output", "out") == 0
    for path in (tmp_path / "out" / "checkpoint").iterdir():
        path.unlink()
    before = results(tmp_path / "out")
    assert run("--resume", "out", "--minutes", 1) == 2
    assert "has no checkpoint to go on from" in capsys.readouterr().err
    assert results(tmp_path / "out") == before

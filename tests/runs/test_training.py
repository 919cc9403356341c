"""What the command line and Python do with a run that is ready: its driver, summary and curve."""

import dataclasses

import numpy as np
import pytest
from one_slot import compile_run

from mjx_reinforce import envs
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.ready import build_ready
from mjx_reinforce.training import driver as module
from mjx_reinforce.training.driver import Runs, begin_run
from mjx_reinforce.training.failures import HOPELESS

CONFIG = Config(
    env="ContinuousCartPole-v0",
    num_seeds=2,
    env_steps=None,
    max_updates=2,
    num_episodes=2,
    hidden_sizes=(),
    eval_every=1,
    eval_episodes=2,
    horizon=7,
    engine="vmap",
)


def begin(ready, config, **more):
    """A run with these settings, without files, before its first update."""
    slots = compile_run(ready.programs(), config)
    runs = Runs("", *np.zeros((3, config.num_seeds), int))
    return begin_run(config, ready.threshold, slots, runs, **more)


@pytest.fixture(scope="module")
def ready():
    return build_ready(envs.make(CONFIG.env), CONFIG)


@pytest.fixture(scope="module")
def driver(ready):
    """Of a whole run, at its end."""
    driver = begin(ready, CONFIG)
    driver.drive(lambda: False)
    return driver


def test_a_summary_says_how_the_run_ended(driver, monkeypatch):
    summary = driver.summary("vmap", 3.0, {"final_test_returns": [1.0, 2.0]})
    assert summary["status"] == "finished"
    assert "reason" not in summary
    assert summary["engine"] == "vmap"
    assert summary["compile_seconds"] == 3.0
    assert summary["final_test_returns"] == [1.0, 2.0]
    assert set(summary["best_updates"]) <= {0, 1, 2}
    assert driver.summary("vmap", 3.0, {})["status"] == "interrupted"
    monkeypatch.setattr(driver.record, "hopeless", lambda: True)
    stopped = driver.summary("vmap", 3.0, {"final_test_returns": []})
    assert (stopped["status"], stopped["reason"]) == ("stopped", HOPELESS)


def test_minutes_become_env_steps_before_the_run_begins(ready, monkeypatch):
    said = []
    monkeypatch.setattr(module, "env_steps_in", lambda seconds, *_: int(1000 * seconds))
    timed = dataclasses.replace(CONFIG, minutes=0.5)
    driver = begin(ready, timed, say=said.append)
    assert (driver.config.env_steps, driver.config.minutes) == (30_000, None)
    assert driver.config.budgets == (0, 30_000)
    assert said == ["0.5 min are at first about 30,000 env steps per seed here"]


def test_a_run_begins_with_the_policies_of_another(ready, driver):
    learned = driver.states.train_states.actor
    begun = begin(ready, CONFIG, actors=learned).states.train_states.actor
    mean = learned.normalizer.mean
    np.testing.assert_array_equal(begun.normalizer.mean, mean)
    assert mean.any()  # that of a fresh policy is 0

"""Budgets: those of the defaults, in time, and of runs that begin where others ended."""

import dataclasses
import itertools
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from saved_runs import assert_same

from experiments.kit.trainings import results
from mjx_reinforce import envs
from mjx_reinforce.engine import counts
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings import defaults
from mjx_reinforce.settings.config import MAX_COUNT, Config, check
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.training import minutes
from mjx_reinforce.training import record as measured

SMALL = ["--env", "ContinuousCartPole-v0", "--num-seeds", "3", "--eval-episodes", "2"]
SMALL += ["--num-episodes", "4", "--hidden-sizes", "4"]


def settings(directory):
    return json.loads((directory / "config.json").read_text())


@pytest.mark.slow
def test_minutes_become_env_steps_that_repeat_the_run_and_go_on(run, tmp_path, capsys):
    """On from its last state, whatever that is, with no row lost; and never from the beginning."""
    assert run(*SMALL, "--minutes", 0.02, "--output", "first") == 0
    found = settings(tmp_path / "first")
    assert found["minutes"] is None
    assert found["env_steps"] > 100
    assert found["budgets"][-1] == found["env_steps"]
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


@pytest.mark.slow
def test_a_run_in_time_goes_on_from_any_of_its_budgets(run, tmp_path):
    """Its newest checkpoint may be of an earlier budget than config.json says."""
    timed = ["--minutes", 0.05, "--checkpoint-every", 5, "--output", "whole"]
    assert run(*SMALL, *timed) == 0
    whole = tmp_path / "whole"
    assert len(settings(whole)["budgets"]) > 4
    parts = shutil.copytree(whole, tmp_path / "parts")
    (parts / "summary.json").write_text('{"status": "running"}')
    [_, *newer] = sorted((parts / "checkpoint").iterdir())
    for path in newer:
        path.unlink()
    assert run("--resume", "parts") == 0
    assert settings(parts)["resumed"][0]["updates"] > 0
    assert_same(whole, parts)


@pytest.mark.slow
def test_a_late_run_records_the_budget_that_ends_it(run, tmp_path, monkeypatch):
    """It is found after the last checkpoint, where a machine became slower at the end."""
    calls = itertools.count()

    def budget(self, seconds, env_steps, present_budget):
        return int(env_steps.min()) if next(calls) == 10 else None

    monkeypatch.setattr(minutes.Deadline, "budget", budget)
    timed = ["--minutes", 0.05, "--checkpoint-every", 5, "--eval-every", 5, "--output", "late"]
    assert run(*SMALL, *timed) == 0
    late = tmp_path / "late"
    assert next(calls) == 11
    summary = json.loads((late / "summary.json").read_text())
    assert settings(late)["env_steps"] == min(summary["env_steps"])
    assert run("--like", "late", "--output", "again") == 0
    assert_same(late, tmp_path / "again")


@pytest.mark.slow
@pytest.mark.parametrize("gpu", [False, True])
def test_a_default_run_has_the_budget_of_its_machine(monkeypatch, gpu):
    monkeypatch.setattr(defaults, "has_gpu", lambda: gpu)
    for env in defaults.OF_TASKS.keys() & set(envs.names()):
        config = of_task(env)
        check(config)
        assert config.env_steps == defaults.MINUTES.get(env, (Config.env_steps,) * 2)[gpu]
        # More seeds than a default run has leave each with what it would learn.
        assert of_task(env, num_seeds=1000) == dataclasses.replace(config, num_seeds=1000)
        timed = dataclasses.replace(config, minutes=1.0 if env in defaults.MINUTES else None)
        assert parse(["--env", env]).base == timed
        assert parse(["--env", env, "--max-updates", "9"]).base.minutes is None
        swept = ["--over", "discount", "0.9", "0.99"]
        assert parse(["--env", env, *swept], name="sweep").base == config
        if gpu and env in defaults.OF_BUDGETS:
            assert config.num_episodes >= 128
        longer = of_task(env, minutes=2.0)
        assert longer.env_steps == 2 * config.env_steps or env not in defaults.MINUTES
        played = longer.episodes_per_update * longer.eval_every * defaults.HORIZONS[env]
        assert longer.env_steps < 60 * played
    alone = of_task("Walker2d-v5", num_seeds=1)  # two cores play more of one seed
    assert (alone.env_steps == 4 * 3_900_000) != gpu
    assert alone.update == "natural-gradient"


def test_the_suite_of_playground_has_one_rule():
    """What differs between its tasks follows from the size of an action and the time of a step."""
    walker, cheetah = (of_task(f"playground:{name}") for name in ("WalkerRun", "CheetahRun"))
    check(walker)
    assert parse(["--env", "playground:WalkerRun"]).base == walker
    same = {name: getattr(walker, name) for name in ("env", "discount", "train_horizon")}
    assert dataclasses.replace(cheetah, **same) == walker
    # Both credit an action with the rewards of two seconds, and cut episodes after ten.
    assert 0.025 / (1 - walker.discount) == pytest.approx(2)
    assert 0.01 / (1 - cheetah.discount) == pytest.approx(2)
    assert (walker.train_horizon, cheetah.train_horizon) == (400, 1000)
    humanoid = of_task("playground:HumanoidRun", env_steps=10**9)
    assert humanoid.max_kl == pytest.approx(21 / 6 * walker.max_kl)
    assert humanoid.initial_std == walker.initial_std == 1
    assert humanoid.num_episodes == 256
    assert of_task("playground:Go1JoystickFlatTerrain") == Config(
        env="playground:Go1JoystickFlatTerrain"
    )


def test_a_budget_chooses_the_settings():
    few, some, many = (of_task("Hopper-v5", steps) for steps in (10**6, 3 * 10**6, 10**12))
    assert [x.num_episodes for x in (few, some, many)] == [16, 64, 1024]
    assert some.update == "natural-gradient"
    assert few.eval_every == 10
    assert many.env_steps == 10**12
    assert few.decay_steps == 1_500_000  # it does not end before the run
    assert some.decay_steps == many.decay_steps == "budget"
    # An interrupt of so long a run does not wait for a fiftieth of it.
    assert few.eval_every <= many.eval_every < 10**12 // (1024 * 1000 * 50)
    medium = of_task("HalfCheetah-v5", 5 * 10**7)
    assert medium.eval_every == 5 * 10**7 // 50 // (16 * 250)
    for config in (few, some, many):
        words = ["--env", "Hopper-v5", "--env-steps", str(config.env_steps)]
        assert parse(words).base == config
    assert parse(["--env=Hopper-v5", "--env-steps=1000000", "--num-seeds=9"]).base.num_seeds == 9


# A budget in time: the env steps that a machine trains in it, from the speed at the start.


class Machine:
    """Slots whose runs play so many env steps in each update, which takes a second.

    What is done once takes its time before the first update, and before the first evaluation.
    """

    def __init__(self, played, evaluating=0.0, once=0.0):
        self.played, self.evaluating, self.now = iter(played), evaluating, 0.0
        self.once = {"advance": once, "evaluate": once}
        self.env_steps, self.updates, self.budget = 0, 0, None

    def states(self):
        made = {"env_steps": self.env_steps, "num_updates": self.updates}
        each = {name: np.stack([counts.from_int(x)] * 2) for name, x in made.items()}
        return SimpleNamespace(train_states=SimpleNamespace(**each))

    def advance(self, evaluate):
        assert not evaluate
        made = int(counts.to_int(np.asarray(self.budget.updates))) - self.updates
        self.env_steps += sum(itertools.islice(self.played, made))
        self.updates, self.now = self.updates + made, self.now + made + self.once.pop("advance", 0)
        return [None] * made

    def seconds_to_evaluate(self):
        elapsed = self.evaluating + self.once.pop("evaluate", 0)
        self.now += elapsed
        return elapsed


@pytest.mark.parametrize(
    ("seconds", "machine", "config", "expected"),
    [
        # The steps of the trial of 1, 2, 4 and 8 updates are trained again.
        (300.0, Machine(itertools.repeat(50)), Config(), 50 * (300 - 15)),
        (300.0, Machine([*[1000] * 7, *[10] * 8]), Config(), 10 * 285),  # its second half counts
        # Blocks of 10 updates wait 10 s for an evaluation: the speed is half.
        (310.0, Machine(itertools.repeat(50), 10.0), Config(eval_every=10), 25 * (310 - 15 - 20)),
        # What is done once, more than the trial's share, says nothing about the speed.
        (300.0, Machine(itertools.repeat(50), once=60.0), Config(), 50 * (300 - 15 - 120)),
        (1e6, Machine(itertools.repeat(7)), Config(max_updates=3), 7 * (10**6 - 3)),  # it ends
        (1e12, Machine(itertools.repeat(10**9)), Config(max_updates=4), MAX_COUNT),
    ],
)
def test_what_is_trained_in_a_time(monkeypatch, seconds, machine, config, expected):
    monkeypatch.setattr(minutes.time, "perf_counter", lambda: machine.now)
    assert minutes.env_steps_in(seconds, machine, config) == expected


def test_a_trial_ends_where_its_first_update_took_all_of_the_time(monkeypatch):
    machine = Machine(itertools.repeat(50), once=60.0)
    monkeypatch.setattr(minutes.time, "perf_counter", lambda: machine.now)
    assert minutes.env_steps_in(12.0, machine, Config()) == 1
    assert machine.updates == 1


def test_minutes_beyond_all_counts_have_settings():
    assert of_task("CartPole-v1", minutes=1e200).env_steps == MAX_COUNT


@pytest.mark.parametrize(
    ("speed_at", "first_budget"),
    [
        (lambda time: 1000, 60_000),
        (lambda time: 1000 + 4000 * min(time / 40, 1), 60_000),  # episodes get longer
        (lambda time: 3000 / (1 + time / 20), 180_000),  # or dearer
        (lambda time: 1000, 2_000),
        (lambda time: 1000, 10**7),
        (lambda time: 1000 if int(time / 5) % 2 else 600, 10**7),
    ],
)
def test_a_run_in_time_ends_in_time(speed_at, first_budget):
    """Within six percent, though the first budget is wrong, by a few budgets after it."""
    config = Config(minutes=1.0).with_budget(0, first_budget)
    deadline = minutes.Deadline(start=10.0, end=70.0, env_steps=500.0)
    time, env_steps, updates = 10.0, 500.0, 0
    while env_steps < config.env_steps_at(updates):
        time, env_steps, updates = time + 0.5, env_steps + 0.5 * speed_at(time), updates + 5
        budget = deadline.budget(time, np.array([env_steps]), config.env_steps_at(updates))
        if budget is not None:
            config = config.with_budget(updates, budget)
    assert 66.4 < time < 73.6
    assert 8 < len(config.budgets) < 26


def test_a_policy_of_short_episodes_does_not_go_on_alone():
    """Others have used the budget of the mean, by so many updates each, long before it has."""
    steps_per_second = np.array([1000.0] * 15 + [300.0])
    config = Config(minutes=1.0).with_budget(0, 60_000)
    deadline = minutes.Deadline(start=0.0, end=60.0, env_steps=0.0)
    time, env_steps, updates = 0.0, np.zeros(16), 0
    while (env_steps < config.env_steps_at(updates)).any():
        running = env_steps < config.env_steps_at(updates)
        time, env_steps, updates = (
            time + 0.5,
            env_steps + 0.5 * steps_per_second * running,
            updates + 5,
        )
        budget = deadline.budget(time, env_steps, config.env_steps_at(updates))
        if budget is not None:
            config = config.with_budget(updates, budget)
    assert 60 <= time < 66
    assert env_steps.min() > 15_000
    # The budgets that config.json keeps end each policy where it ended.
    assert config.env_steps == int(env_steps.min())


def test_a_run_whose_trial_took_all_of_the_time_makes_an_update():
    deadline = minutes.Deadline(start=0.0, end=1.0, env_steps=500.0)
    assert deadline.budget(9.0, np.array([500, 500]), 501) is None
    assert deadline.budget(10.0, np.array([900, 700]), 501) == 700


def test_budgets_hold_from_their_updates_on_unless_another_is_given():
    config = Config(minutes=2.0).with_budget(0, 100).with_budget(20, 300)
    assert (config.minutes, config.env_steps, config.budgets) == (None, 300, (0, 100, 20, 300))
    assert [config.env_steps_at(x) for x in (0, 19, 20, 99)] == [100, 100, 300, 300]
    later = dataclasses.replace(config, env_steps=500)
    assert later.env_steps_at(0) == 500
    assert later.with_budget(40, 700).budgets == (40, 700)
    assert later.with_budget(40, 700).env_steps_at(0) == 700
    assert Config(env_steps=None).env_steps_at(5) is None


# How much of a budget is used, and when a checkpoint is due.


def test_the_budget_that_is_nearer_to_its_end_counts():
    steps, updates = np.array([[50, 200], [0, 0]]), np.array([[9, 1], [5, 0]])
    both = measured.used(Config(env_steps=100, max_updates=10), steps, updates)
    np.testing.assert_allclose(both, [[0.9, 2.0], [0.5, 0.0]])
    alone = measured.used(Config(env_steps=None, max_updates=10), steps, updates)
    np.testing.assert_allclose(alone, [[0.9, 0.1], [0.5, 0.0]])
    np.testing.assert_allclose(measured.used(Config(env_steps=100), steps, updates), steps / 100)

"""The peers' clock, settings and rows; and that they train, where they are installed."""

import csv
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT

from experiments.kit import rows as kit
from experiments.speed.peers import __main__ as peers
from experiments.speed.peers import rows, settings
from experiments.speed.peers.clock import Budgets, Clock
from mjx_reinforce import envs
from mjx_reinforce.types import Box

PUBLISHED = ROOT / "docs" / "published.csv"
FOUND = rows.result(60, 61.25, 5000, np.array([1.0, 2.0, 6.0]))
ROW = dict.fromkeys(rows.COLUMNS, "") | FOUND | {"peer": "a peer", "seed": 3}


def test_the_clock_leaves_pauses_out():
    now = 100.0
    clock = Clock(lambda: now)
    now = 104.0
    with clock.paused():
        now = 154.0
    now = 155.5
    assert clock.seconds == 5.5


def test_each_budget_is_due_once():
    budgets = Budgets([600, 60, 20])
    assert budgets.due(19.9) == []
    assert budgets.due(61) == [20, 60]
    assert not budgets.spent
    assert budgets.due(61) == []
    assert budgets.due(600) == [600]
    assert budgets.spent


@pytest.mark.parametrize("text", ["60,x", "", "0,60", "-1", "nan", "inf"])
def test_budgets_are_positive_numbers(text):
    with pytest.raises(ValueError, match=f"--seconds is {text!r}; give positive numbers"):
        rows.budgets(text)


def test_budgets_are_in_order():
    assert rows.budgets("600,60,60") == [60, 600]


def test_rows_come_back(tmp_path):
    path = tmp_path / "docs" / "rows.csv"
    kit.append(path, [ROW], rows.COLUMNS)
    other = ROW | {"seed": 4, "settings": kit.words({"a": 1, "b": "x, y"})}
    kit.append(path, [other], rows.COLUMNS)
    back = rows.read(path)
    assert [row["seed"] for row in back] == [3, 4]
    assert back[0]["mean_return"] == 3.0
    assert (back[0]["budget_seconds"], back[0]["seconds"]) == (60, 61.2)
    assert (back[0]["env_steps"], back[0]["episodes"]) == (5000, 3)
    assert back[1]["settings"] == "a=1, b=x, y"


def test_a_row_has_every_column(tmp_path):
    other = {k: ROW[k] for k in ROW if k != "task"} | {"more": 1}
    with pytest.raises(ValueError, match=r"columns that do not fit: \['more', 'task'\]"):
        kit.append(tmp_path / "rows.csv", [other], rows.COLUMNS)


def test_every_task_has_settings_and_their_source():
    gymnasium = pytest.importorskip("gymnasium")
    for task in settings.TASKS:
        assert task in envs.names()
        assert task in gymnasium.registry
        for source in (settings.BRAX[task].source, settings.sb3("PPO", task).source):
            assert re.search(r"\b[0-9a-f]{40} \S+\.(yml|ipynb|py), |^defaults of Stable", source)
        given = settings.BRAX[task].arguments
        assert given["batch_size"] * given["num_minibatches"] % given["num_envs"] == 0
    assert settings.sb3("SAC", "Swimmer-v5").arguments == {
        "learning_starts": 10_000,
        "gamma": 0.999,
    }
    assert settings.sb3("PPO", "Swimmer-v5").num_envs == 4
    assert settings.sb3("PPO", "Pusher-v5").arguments == {}
    assert settings.sb3("SAC", "Reacher-v5").source.startswith("defaults of Stable-Baselines3")


def test_actions_are_rescaled_to_the_bounds():
    from experiments.speed.peers.brax import Rescaled

    env = envs.make("ContinuousCartPole-v0")
    env.action_space = Box(np.array([-0.5]), np.array([0.1]))
    state = env.reset(jax.random.key(0))
    for action, own in ((-1.0, -0.5), (0.5, -0.05), (1.0, 0.1)):
        ours = env.step(state, jnp.array([own]))
        theirs = Rescaled(env).step(state, jnp.array([action]))
        np.testing.assert_allclose(theirs.obs, ours.obs, rtol=1e-6, atol=1e-7)
    env.action_space = Box(np.array([-np.inf]), np.array([3.0]))
    with pytest.raises(ValueError, match="actions have no bounds"):
        Rescaled(env)


def test_a_return_ends_with_its_episode():
    from experiments.speed.peers import brax as peers_brax

    env = envs.make("ContinuousCartPole-v0")
    keys = jax.random.split(jax.random.key(0), 3)
    still = peers_brax.play(env, lambda obs, _: (obs[:, :1] * 0, {}), keys, 50)
    pushed = peers_brax.play(env, lambda obs, _: (obs[:, :1] * 0 + 1, {}), keys, 50)
    assert np.all(np.asarray(pushed) < np.asarray(still))
    short = peers_brax.play(env, lambda obs, _: (obs[:, :1] * 0, {}), keys, 7)
    np.testing.assert_array_equal(short, [7.0, 7.0, 7.0])


def test_brax_trains_on_our_environments():
    from experiments.speed.peers import brax as peers_brax

    env = peers_brax.Rescaled(envs.make("ContinuousCartPole-v0"))
    few = {"num_envs": 64, "batch_size": 64, "num_minibatches": 8}
    arguments = {**settings.BRAX["InvertedPendulum-v5"].arguments, **few}
    reached = []
    peers_brax.train_on(env, settings.Brax("here", arguments), 0, [0.1, 2], 8, reached.append)
    assert [row["budget_seconds"] for row in reached] == ["0.1", "2"]
    assert 5120 < reached[0]["env_steps"] < reached[1]["env_steps"]
    assert all(row["episodes"] == 8 and 1 <= float(row["mean_return"]) <= 50 for row in reached)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size of 64")  # the zoo's
def test_stable_baselines3_trains(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")
    path = tmp_path / "rows.csv"
    given = ["peers.py", "sb3", "--tasks", "InvertedPendulum-v5", "--seconds", "0.5,1"]
    given += ["--cores", "1", "--episodes", "2", "--rows", str(path)]
    monkeypatch.setattr(sys, "argv", given)
    peers.main()
    back = rows.read(path)
    assert [(row["peer"], row["budget_seconds"]) for row in back] == [
        ("Stable-Baselines3 PPO", 0.5),
        ("Stable-Baselines3 PPO", 1),
        ("Stable-Baselines3 SAC", 0.5),
        ("Stable-Baselines3 SAC", 1),
    ]
    assert back[0]["env_steps"] < back[1]["env_steps"]
    assert back[0]["settings"].startswith("num_envs=1, normalize=True, batch_size=64")
    assert capsys.readouterr().out.count("InvertedPendulum-v5 seed 0: ") == 4


def test_published_figures_say_all_of_their_source():
    with PUBLISHED.open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    bases = {name.partition("-v")[0] for name in envs.names()}
    assert {row["task"] for row in found} >= {task.partition("-v")[0] for task in settings.TASKS}
    for row in found:
        assert row["task"] in bases
        assert re.fullmatch(r"v\d", row["version"])
        assert row["policy"] in ("on-policy", "off-policy", "policy search")
        assert re.fullmatch(r"\S+/\S+ \S+", row["source"])
        assert re.fullmatch(r"[0-9a-f]{40}", row["commit"])
        assert int(row["env_steps"]) >= 50_000
        assert int(row["seeds"]) >= 1
        float(row["mean"])
        assert (row["spread"] == "") == (row["spread_is"] == "")
        if row["spread"]:
            assert float(row["spread"]) >= 0
    keys = [
        tuple(row[k] for k in ("algorithm", "implementation", "task", "version", "env_steps"))
        for row in found
    ]
    assert len(set(keys)) == len(keys)

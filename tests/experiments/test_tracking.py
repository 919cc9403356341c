"""How well policies follow their commands: a robot that stands, and one that falls."""

import importlib
import shutil
import sys

import numpy as np
import pytest
from new_classes import write
from places import ROOT
from saved_runs import change, change_arrays, change_env, make_run

from experiments.checks import tracking

SPACE = {"action_low": [-1.0] * 12, "action_high": [1.0] * 12}
COMMAND = (0.6, -0.2, 0.4)
KERNEL = "params__network__params__Dense_0__kernel"
BIAS = "params__network__params__Dense_0__bias"


@pytest.fixture
def task(tmp_path, monkeypatch):
    """The module of a robot that neither lifts its feet nor is pushed, and has one command."""
    shutil.copy(ROOT / "experiments" / "examples" / "quadruped.xml", tmp_path / "tracked.xml")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write(monkeypatch, "tracked.xml")
    monkeypatch.delitem(sys.modules, "tracked", raising=False)
    module = importlib.import_module("tracked")
    module.LIFT = module.PUSH = 0.0
    module.SLOWEST = module.FASTEST = COMMAND
    return module


@pytest.fixture
def resting_run(tmp_path):
    """The directory of a run whose policies always act 0."""
    sizes = {"observation_size": 53, "hidden_sizes": []}
    run = make_run(tmp_path / "run", "InvertedPendulum-v5", **sizes, **SPACE)
    change_env(run, "tracked:Tracked")
    change_arrays(run, **{KERNEL: np.zeros_like, BIAS: np.zeros_like})
    change(run / "config.json", num_seeds=1)
    return run


@pytest.mark.slow
def test_a_robot_that_stands_misses_its_whole_command(task, resting_run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tracking", str(resting_run), "--episodes", "4"])
    capsys.readouterr()
    tracking.main()
    title, _, row, still = capsys.readouterr().out.splitlines()
    units = "| seed | forward_error (m/s) | sideways_error (m/s) | turn_error (rad/s) |"
    assert title == f"{units} did not fall |"
    seed, *errors, standing = row.strip("|").split("|")
    assert (int(seed), standing.strip()) == (0, "100%")
    np.testing.assert_allclose([*map(float, errors)], np.abs(COMMAND), atol=0.02)
    label, *commands, _ = still.strip("|").split("|")
    assert label.strip() == "stands still"
    np.testing.assert_allclose([*map(float, commands)], np.abs(COMMAND), atol=1e-3)


@pytest.mark.slow
def test_a_fall_counts_as_the_whole_command(task, resting_run, monkeypatch):
    """Before it, this robot does as it is commanded."""

    class Falls(task.Tracked):
        def __init__(self):
            super().__init__()
            self.max_episode_steps = 50

        def outcome(self, before, data, action):
            reward, _, metrics = super().outcome(before, data, action)
            exact = {f"reward_{name}": 0.0 * reward for name in tracking.ERRORS}
            return reward, data.time > 0.49, metrics | exact

    monkeypatch.setattr(Falls, "__module__", "tracked")
    settings = tracking.TrackingSettings(resting_run, episodes=2, ignored_seconds=0.2)
    result = tracking.tracking(settings, Falls, 0)
    # Of 40 env steps that count, 14 are before the one that ends at 0.5 s.
    np.testing.assert_allclose(result.errors, 26 / 40 * np.abs(COMMAND), rtol=1e-5)
    np.testing.assert_allclose(result.commands, np.abs(COMMAND), rtol=1e-6)
    assert result.standing == 0


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (
            "InvertedPendulum-v5",
            [],
            "was trained on InvertedPendulum-v5, which follows no commands",
        ),
        ("json:dumps", [], "was trained on json:dumps, which follows no commands"),
        ("no_such_module:Robot", [], "No module named 'no_such_module'"),
        ("json:dumps", ["--episodes", "0"], "episodes must be at least 1, got 0"),
    ],
)
def test_runs_of_other_tasks_are_named(tmp_path, monkeypatch, capsys, env, options, message):
    run = make_run(tmp_path / "run", "InvertedPendulum-v5")
    change_env(run, env)
    monkeypatch.setattr(sys, "argv", ["tracking", str(run), *options])
    with pytest.raises(SystemExit, match="2"):
        tracking.main()
    assert message in capsys.readouterr().err

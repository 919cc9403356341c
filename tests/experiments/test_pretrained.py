"""The stage that packs the package's policies out of runs."""

import json
import shlex

import jax
import numpy as np
import pytest
from saved_runs import change, change_arrays, make_run

from experiments.studies.results import pretrained
from mjx_reinforce import load_policy
from mjx_reinforce.files import read_json
from mjx_reinforce.runs import command_line
from mjx_reinforce.settings.defaults import of_task


def finished(directory, **config):
    """Writes a run of CartPole that has ended; its seed 1 pushes the cart under the pole."""
    make_run(directory, hidden_sizes=[], count=0.0)
    good = np.zeros((4, 2), np.float32)
    good[2:, 1] = 1.0
    kernels = np.stack([-good, good, np.zeros_like(good)])
    names = {f"params__network__params__Dense_0__{x}": x for x in ("kernel", "bias")}
    values = {"kernel": lambda _: kernels, "bias": np.zeros_like}
    changes = {name: values[kind] for name, kind in names.items()}
    change_arrays(directory, **changes)
    packages = {"jax": "0.10.2", "numpy": "2.0"}
    said = {"env_steps": 5000, "num_seeds": 3, "device": "cpu", "cpu": "znver4, 16 lanes"}
    said |= {"cpu_count": 2, "git_commit": "0123456789abcdef", "packages": packages}
    change(directory / "config.json", **said | config)
    change(
        directory / "summary.json",
        num_seeds=3,
        run_seconds=12.34,
        compile_seconds=5.0,
        env_steps=[5001, 5002, 5003],
    )
    return directory


def test_the_best_of_several_runs_is_packed(tmp_path):
    """By what it earns, whatever the runs say of themselves."""
    runs = tmp_path / "runs"
    for name, returns in (("a", [90.0, 1.0, 2.0]), ("b/c", [1.0, 9.0, 2.0]), ("d", [1.0, 2.0, 3])):
        change(finished(runs / name) / "summary.json", final_returns=returns)
    change(finished(runs / "unfinished") / "summary.json", status="running")
    said = pretrained.pack(runs, tmp_path / "out", 64)
    assert len(said) == 1
    facts = read_json(tmp_path / "out" / "CartPole-v1" / "provenance.json")
    _, packed = load_policy(tmp_path / "out" / "CartPole-v1", 0)
    _, of_run = load_policy(runs / "b" / "c" / "policy", 1)
    jax.tree.map(np.testing.assert_array_equal, packed, of_run)
    low, high = facts["interval"]
    assert 40 < low <= facts["return"] <= high
    assert (facts["seed"], facts["episodes"], facts["horizon"]) == (1, 64, 60)
    earned = f"{facts['return']:.2f} ({low:.2f} to {high:.2f})"
    assert said == [f"CartPole-v1: {earned} on other starts, {runs / 'b' / 'c'}, seed 1, last"]
    assert facts["env_steps"] == 5002
    kept = {name: facts[name] for name in ("machine", "packages", "seconds", "seeds", "policy")}
    assert kept == {
        "machine": "znver4, 2 CPU cores",
        "packages": {"jax": "0.10.2"},
        "seconds": 12.3,
        "seeds": 3,
        "policy": "last",
    }


def test_the_packages_policy_stays_where_no_run_is_better(tmp_path):
    """Interrupted runs take part, by their last policies."""
    place = tmp_path / "out" / "CartPole-v1"
    # By name of the run: its best seed, that of the package afterwards, and its seconds.
    for name, best, seed, seconds in (
        ("poor", 0, 0, 12.3),
        ("good", 1, 1, 12.3),
        ("poor again", 0, 1, 99.0),
        ("equal", 1, 1, 99.0),
    ):
        returns = [5.0 + (i == best) for i in range(3)]
        run = finished(tmp_path / name / "run")
        change(run / "summary.json", final_returns=returns, status="interrupted")
        pretrained.pack(tmp_path / name, tmp_path / "out", 32)
        facts = read_json(place / "provenance.json")
        assert (facts["seed"], facts["seconds"]) == (seed, seconds)
        assert (facts["return"] > 40) == (seed == 1)  # measured, also of what stays
        _, packed = load_policy(place, 0)
        _, expected = load_policy(run / "policy", seed)
        jax.tree.map(np.testing.assert_array_equal, packed, expected)
        change(place / "provenance.json", seconds=99.0, **{"return": -1.0})


def test_the_command_gives_the_settings_again():
    config = of_task("CartPole-v1", 7000, 5)
    own = {"standardize_floor": None, "hidden_sizes": [8, 4], "value_fits": 3}  # the last unread
    written = json.loads(json.dumps(vars(config))) | own
    line = shlex.split(pretrained.command(written))
    assert line[:3] == ["python", "-m", "mjx_reinforce.train"]
    again = command_line.parse(line[3:]).base
    assert vars(again) == vars(config) | {"standardize_floor": None, "hidden_sizes": (8, 4)}


def test_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="has no run of a task of this package with policies"):
        pretrained.pack(tmp_path, tmp_path / "out", 8)

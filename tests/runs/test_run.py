"""``mjx_reinforce.run``: a run from Python, its results, files and observers."""

import dataclasses

import numpy as np
import pytest

import mjx_reinforce
from mjx_reinforce.export.policy_files import read_policy

CONFIG = dataclasses.replace(
    mjx_reinforce.of_task("ContinuousCartPole-v0"),
    num_seeds=2,
    env_steps=None,
    max_updates=6,
    eval_every=2,
    eval_episodes=2,
    engine="vmap",
    horizon=20,
)


@pytest.fixture(scope="module")
def results():
    return mjx_reinforce.run(CONFIG, quiet=True)


def test_what_it_returns(results, tmp_path, monkeypatch):
    assert results.eval_return.shape == results.env_steps.shape == (4, 2)
    assert results.training["episode_return"].shape == (6, 2)
    assert results.test_returns.shape == results.best_test_returns.shape == (2,)
    assert results.config.horizon == 20
    assert results.directory is None
    assert results.summary["status"] == "finished"
    assert repr(results).startswith("RunResults(ContinuousCartPole-v0, 2 seeds, return ")


def test_files_are_written_only_where_asked_and_say_the_same(results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mjx_reinforce.run(CONFIG, quiet=True)
    assert [*tmp_path.iterdir()] == []
    written = mjx_reinforce.run(CONFIG, output="here", quiet=True)
    np.testing.assert_array_equal(written.eval_return, results.eval_return)
    saved = read_policy(tmp_path / "here" / "policy", 1)
    np.testing.assert_array_equal(
        saved.actor.normalizer.mean, written.player(1).actor.normalizer.mean
    )
    assert (tmp_path / "here" / "metrics.csv").read_text().count("\n") == 1 + 4 * 2
    with pytest.raises(ValueError, match="not empty"):
        mjx_reinforce.run(CONFIG, output="here", quiet=True)


def test_observers_see_every_evaluation(results):
    seen = []
    mjx_reinforce.run(CONFIG, observers=[seen.append], quiet=True)
    assert [one.updates.tolist() for one in seen] == [[0, 0], [2, 2], [4, 4], [6, 6]]
    np.testing.assert_array_equal([x.measured["eval_return"] for x in seen], results.eval_return)
    np.testing.assert_array_equal([x.env_steps for x in seen], results.env_steps)
    last = seen[-1].actor.normalizer.mean
    np.testing.assert_array_equal(last, results.actor.normalizer.mean)


def test_an_observer_ends_a_run():
    ended = mjx_reinforce.run(CONFIG, observers=[lambda one: one.updates.max() >= 2], quiet=True)
    assert ended.summary["status"] == "finished"
    assert len(ended.training["episode_return"]) == 4


def test_quiet_is_quiet_and_the_rest_shows_progress(capsys):
    mjx_reinforce.run(CONFIG, quiet=True)
    assert capsys.readouterr().out == ""
    mjx_reinforce.run(CONFIG)
    said = capsys.readouterr().out
    assert said.startswith("Training 2 seeds of ContinuousCartPole-v0")
    assert "update     6" in said


def test_players_of_seeds(results):
    assert results.player().seed == np.argmax(results.test_returns)
    assert results.player(1, "best").actor.normalizer.mean.shape == (4,)
    with pytest.raises(ValueError, match=r"seed must be in \[0, 2\), got 2"):
        results.player(2)


def test_what_makes_no_sense_is_refused(tmp_path):
    with pytest.raises(ValueError, match="config must be of type Config"):
        mjx_reinforce.run("Hopper-v5")
    for observers in (print, [3]):
        with pytest.raises(ValueError, match="observers must be a list of functions of one"):
            mjx_reinforce.run(CONFIG, observers=observers)
    with pytest.raises(ValueError, match="run\\(\\) begins a run"):
        mjx_reinforce.run(dataclasses.replace(CONFIG, resume=tmp_path))
    with pytest.raises(ValueError, match="--num-seeds must be at least 1"):
        mjx_reinforce.run(dataclasses.replace(CONFIG, num_seeds=0), output=tmp_path / "new")
    assert [*tmp_path.iterdir()] == []


def test_a_run_to_begin_from_is_looked_for_before_anything_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr("mjx_reinforce.runs.run.compile_driver", pytest.fail)
    wanted = dataclasses.replace(CONFIG, init_from=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match="is no run directory"):
        mjx_reinforce.run(wanted, output=tmp_path / "new", quiet=True)
    assert [*tmp_path.iterdir()] == []


def test_a_sweep_leaves_files_only_where_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    swept = mjx_reinforce.sweep(CONFIG, {"discount": [0.9, 0.99]}, quiet=True)
    assert [*tmp_path.iterdir()] == []
    assert swept.directory is None
    assert swept.eval_return.shape[1] == 4
    assert capsys.readouterr().out == ""

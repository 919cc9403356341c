"""``mjx_reinforce.run``: a run from Python, its results, files and observers."""

import contextlib
import dataclasses
import io

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
def made(tmp_path_factory):
    """A quiet run without files: what it returned, and what an observer saw."""
    seen, folder = [], tmp_path_factory.mktemp("nothing")
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as said:
        results = mjx_reinforce.run(CONFIG, observers=[seen.append], quiet=True)
    assert said.getvalue() == ""
    assert [*folder.iterdir()] == []
    return results, seen


@pytest.fixture(scope="module")
def results(made):
    return made[0]


def test_what_it_returns(results):
    assert results.eval_return.shape == results.env_steps.shape == (4, 2)
    assert results.training["episode_return"].shape == (6, 2)
    assert results.test_returns.shape == results.best_test_returns.shape == (2,)
    assert results.config.horizon == 20
    assert results.directory is None
    assert results.summary["status"] == "finished"
    assert repr(results).startswith("RunResults(ContinuousCartPole-v0, 2 seeds, return ")


@pytest.mark.slow
def test_files_and_a_screen_say_the_same(results, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written = mjx_reinforce.run(CONFIG, output="here")
    said = capsys.readouterr().out
    assert said.startswith("Training 2 seeds of ContinuousCartPole-v0")
    compiling, compiled, *_ = said.splitlines()[1:]  # the first in a log before it, too
    assert compiling.startswith("compiling, ")
    assert compiled.startswith("compiled in ")
    assert "update     6" in said
    np.testing.assert_array_equal(written.eval_return, results.eval_return)
    saved = read_policy(tmp_path / "here" / "policy", 1)
    np.testing.assert_array_equal(
        saved.actor.normalizer.mean, written.player(1).actor.normalizer.mean
    )
    assert (tmp_path / "here" / "metrics.csv").read_text().count("\n") == 1 + 4 * 2
    with pytest.raises(ValueError, match="not empty"):
        mjx_reinforce.run(CONFIG, output="here", quiet=True)


def test_observers_see_every_evaluation(made):
    results, seen = made
    assert [one.updates.tolist() for one in seen] == [[0, 0], [2, 2], [4, 4], [6, 6]]
    np.testing.assert_array_equal([x.measured["eval_return"] for x in seen], results.eval_return)
    np.testing.assert_array_equal([x.env_steps for x in seen], results.env_steps)
    last = seen[-1].actor.normalizer.mean
    np.testing.assert_array_equal(last, results.actor.normalizer.mean)


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
    with pytest.raises(ValueError, match="this begins anew"):
        mjx_reinforce.run(dataclasses.replace(CONFIG, resume=tmp_path))
    with pytest.raises(ValueError, match="--num-seeds must be at least 1"):
        mjx_reinforce.run(dataclasses.replace(CONFIG, num_seeds=0), output=tmp_path / "new")
    assert [*tmp_path.iterdir()] == []


def test_a_run_to_begin_from_is_looked_for_before_anything_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setattr("mjx_reinforce.runs.conduct.compile_slots", pytest.fail)
    wanted = dataclasses.replace(CONFIG, init_from=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match="is not a run directory"):
        mjx_reinforce.run(wanted, output=tmp_path / "new", quiet=True)
    assert [*tmp_path.iterdir()] == []

"""The terms of a reward in the evaluations of a run: in metrics.csv, and in a run that goes on."""

import csv

import jax
import numpy as np
import pytest
from toys import Paid

import mjx_reinforce as mr
from mjx_reinforce.reports.sources import read_metrics
from mjx_reinforce.training.rows import COLUMNS


class Unbroken(Paid):
    breaks_at = np.inf


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_an_evaluation_has_the_mean_sum_of_each_term():
    env = Unbroken()
    learner = mr.reinforce(env, num_episodes=2)
    actor = learner.init(jax.random.key(0)).actor
    options = {"num_episodes": 8, "horizon": 60}
    measured = mr.evaluate(env, learner, actor, jax.random.key(1), **options)
    terms = measured["eval_reward_speed"], measured["eval_reward_effort"]
    assert min(abs(term) for term in terms) > 0.01
    np.testing.assert_allclose(sum(terms), measured["eval_return"], rtol=1e-5)
    alone = mr.evaluate(env, learner, actor, jax.random.key(1), sampled=False, **options)
    assert alone["eval_return"] == measured["eval_return"]
    assert not [name for name in alone if "reward" in name]  # a sweep records returns


@pytest.mark.slow
def test_a_term_of_a_broken_episode_says_nothing():
    learner = mr.reinforce(Paid(), num_episodes=2)
    actor = learner.init(jax.random.key(0)).actor
    measured = mr.evaluate(Paid(), learner, actor, jax.random.key(1), num_episodes=20, horizon=60)
    assert np.isnan([measured[f"eval_{name}"] for name in ("return", "reward_speed")]).all()


@pytest.mark.slow
def test_metrics_have_a_column_for_each_term(run, register, tmp_path):
    """A run that an older version began goes on with the columns of its file."""
    register("Unbroken-v0", Unbroken)
    settings = ["--env", "Unbroken-v0", "--env-steps", "None", "--num-seeds", 2, "--horizon", 20]
    settings += ["--max-updates", 2, "--eval-every", 1, "--num-episodes", 2, "--decay-steps", 9]
    assert run(*settings, "--output", "new") == 0
    rows = table(tmp_path / "new" / "metrics.csv")
    assert [*rows[0]] == [*COLUMNS, "eval_reward_speed", "eval_reward_effort"]
    for row in rows:
        total = float(row["eval_reward_speed"]) + float(row["eval_reward_effort"])
        np.testing.assert_allclose(total, float(row["eval_return"]), atol=1e-5)
    read = read_metrics(tmp_path / "new" / "metrics.csv")["eval_reward_effort"]
    assert read.ravel().tolist() == [float(row["eval_reward_effort"]) for row in rows]
    assert run("--resume", "new", "--max-updates", 4) == 0
    longer = table(tmp_path / "new" / "metrics.csv")
    assert longer[: len(rows)] == rows
    assert all(row["eval_reward_effort"] for row in longer[len(rows) :])


@pytest.mark.slow
def test_a_run_of_an_older_version_goes_on_with_its_columns(run, register, tmp_path, monkeypatch):
    register("Unbroken-v0", Unbroken)
    settings = ["--env", "Unbroken-v0", "--env-steps", "None", "--num-seeds", 2, "--horizon", 20]
    settings += ["--max-updates", 2, "--eval-every", 1, "--num-episodes", 2, "--decay-steps", 9]
    with monkeypatch.context() as patch:
        patch.setattr("mjx_reinforce.setup.ready.term_names", lambda env: ())
        assert run(*settings, "--output", "old") == 0
    assert run("--resume", "old", "--max-updates", 4) == 0
    rows = table(tmp_path / "old" / "metrics.csv")
    assert [*rows[0]] == [*COLUMNS]
    assert rows[-1]["update"] == "4"
    assert None not in rows[-1]  # no cell without a column

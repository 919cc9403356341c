"""The noise scale of simulated gradients, and of an environment that is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Drift

from experiments.studies import noise_scale as module
from experiments.studies.noise_scale import Settings, episode_gradients, noise_scale, rows
from mjx_reinforce import leave_one_out, mlp_policy, normal, rollout
from mjx_reinforce.learners.gradients import accumulate_gradient
from mjx_reinforce.learners.reinforce import _surrogate
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.actor import Actor, act
from mjx_reinforce.settings.defaults import of_task


def test_by_hand():
    found = noise_scale(np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
    assert found.signal == pytest.approx(4 / 6)  # four of six pairs have the product 1
    assert found.noise == pytest.approx(5 / 4 - 4 / 6)  # less that than the mean square
    assert found.episodes == pytest.approx(7 / 8)
    assert found.half_cosine == pytest.approx(0.5 / np.sqrt(1.25))


@pytest.mark.parametrize("noise_scale_is", [4.0, 40.0])
def test_unbiased_and_as_sure_as_it_says(noise_scale_is):
    """Of 60 gradients of 30 entries with spreads unlike each other."""
    random, count, size = np.random.default_rng(0), 60, 30
    spread = 1.0 / np.arange(1, size + 1)
    mean = np.zeros(size)
    mean[::3] = np.sqrt(np.sum(spread**2) / noise_scale_is / len(mean[::3]))
    drawn = mean + spread * random.normal(size=(1000, count, size))
    found = [noise_scale(gradients) for gradients in drawn]
    for name, expected in (("signal", np.sum(mean**2)), ("noise", np.sum(spread**2))):
        values = np.array([getattr(each, name) for each in found])
        assert abs(values.mean() - expected) < 4.5 * values.std() / np.sqrt(len(values))
    covered = [low <= noise_scale_is <= high for low, high in (each.interval for each in found)]
    assert 0.9 < np.mean(covered) < 0.98


def test_no_signal_is_no_number():
    opposite = np.array([[1.0, 0.0], [-1.0, 0.1], [0.0, 1.0], [0.1, -1.0]])
    found = noise_scale(opposite)
    assert found.ratio < 0
    assert found.episodes == np.inf
    assert found.interval[1] == np.inf


def test_gradients_of_episodes_sum_to_that_of_the_update():
    policy = mlp_policy(1, normal(Drift.action_space), (3,))
    actor = Actor(params=policy.init(jax.random.key(0)), normalizer=normalize.init(1))

    def outputs(actor, observation):
        return act(policy, actor, observation)

    trajectory = rollout(
        Drift(),
        outputs,
        actor,
        policy.distribution,
        jax.random.key(1),
        num_episodes=5,
        horizon=20,
    )
    weight = leave_one_out(0.9).update((), trajectory)[0]
    each = episode_gradients(policy, actor.params, trajectory, weight)
    samples = (trajectory.observation, trajectory.action, weight, trajectory.mask)
    _, loss, _ = accumulate_gradient(_surrogate(policy, 0.0), actor.params, samples)
    expected = -np.concatenate([np.ravel(x) for x in jax.tree.leaves(loss)])
    assert each.shape == (5, expected.size)
    np.testing.assert_allclose(each.sum(axis=0), expected, rtol=1e-4, atol=1e-5)
    assert np.all(np.abs(each).sum(axis=1) > 0)


def test_a_table_of_a_small_task(register, monkeypatch, tmp_path):
    """Of every estimator, discount and shift, before and after training."""
    vmapped = dataclasses.replace(of_task("Drift-v0"), num_seeds=1, engine="vmap")
    monkeypatch.setattr(module, "_config", lambda env: vmapped)
    settings = Settings(
        env="Drift-v0",
        env_steps=(0, 500),
        num_episodes=64,
        discount=(0.9,),
        reward_shift=(0.0, 0.5),
        value_fits=20,
        value_batch_size=64,
    )
    found = list(rows(settings))
    assert len(found) == 2 * 2 * 3
    assert {row["env_steps"] for row in found[:6]} == {0}
    assert all(500 <= row["env_steps"] < 1000 for row in found[6:])
    assert all(np.isfinite(row["half_cosine"]) and row["noise_scale"] > 0 for row in found)
    assert len({row["noise_scale"] for row in found if np.isfinite(row["noise_scale"])}) > 6
    path = tmp_path / "rows.csv"
    for row in found:
        module.kit.append(path, [row], list(row))
    assert len(path.read_text().splitlines()) == 1 + len(found)
    assert not jnp.isnan(jnp.array([row["explained_variance"] for row in found])).any()
    with pytest.raises(ValueError, match="at least 4, got 3"):
        list(rows(dataclasses.replace(settings, num_episodes=3)))

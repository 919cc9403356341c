"""Estimators against sums by hand, the exact gradient of a bandit, and poisoned padding."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from toys import Chain, categorical, expected_return

from mjx_reinforce import Policy, Trajectory, reinforce, train_step
from mjx_reinforce.learners import estimators as est
from mjx_reinforce.registry import ESTIMATORS, load

LENGTHS = np.array([4, 1, 3])
REWARD = np.array([[1.0, 2.0, 0.5], [0.5, 9.0, 1.5], [2.0, 9.0, 1.0], [3.0, 9.0, 9.0]])


def make_trajectory(padding=0.0):
    mask = np.arange(4)[:, None] < LENGTHS
    filler = np.where(mask, 0.0, padding)[..., None]
    return Trajectory(
        observation=jnp.asarray(np.arange(12.0).reshape(4, 3, 1) * mask[..., None] + filler),
        action=jnp.asarray(filler),
        reward=jnp.asarray(np.where(mask, REWARD, 0.0)),
        mask=jnp.asarray(mask),
        nonfinite=jnp.zeros(3, bool),
    )


def weights(estimator, trajectory):
    state = estimator.init(jax.random.key(0), 1)
    return np.asarray(estimator.update(state, trajectory)[0])


def returns_by_hand(discount):
    returns = np.zeros((5, 3))
    for t in reversed(range(4)):
        alive = t < LENGTHS
        returns[t] = np.where(alive, np.where(alive, REWARD[t], 0) + discount * returns[t + 1], 0.0)
    return returns[:4]


def test_reward_to_go_and_total_return_by_hand():
    expected = returns_by_hand(0.9)
    mask = np.arange(4)[:, None] < LENGTHS
    got = weights(est.reward_to_go(0.9), make_trajectory())
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    got = weights(est.total_return(0.9), make_trajectory())
    np.testing.assert_allclose(got, np.where(mask, expected[0], 0.0), rtol=1e-6)


@pytest.mark.parametrize("ended", ["zero", "skip"])
def test_leave_one_out_by_hand(ended):
    returns = returns_by_hand(0.9)
    expected = np.zeros((4, 3))
    for t in range(4):
        for n in range(3):
            others = [m for m in range(3) if m != n and (ended == "zero" or t < LENGTHS[m])]
            baseline = np.mean([returns[t, m] for m in others]) if others else 0.0
            expected[t, n] = returns[t, n] - baseline if t < LENGTHS[n] else 0.0
    got = weights(est.leave_one_out(0.9, ended=ended), make_trajectory())
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_mean_log_prob_is_the_gradient_of_its_loss():
    """The weight of log pi[t] in mean(log_probs) * sum(returns), episode by episode."""
    returns, got = returns_by_hand(0.9), weights(est.mean_log_prob(0.9), make_trajectory())
    for n, length in enumerate(LENGTHS):

        def objective(log_probs, n=n, length=length):
            return jnp.sum(jnp.mean(log_probs) * returns[:length, n])

        np.testing.assert_allclose(
            got[:length, n], jax.grad(objective)(jnp.ones(length)), rtol=1e-6
        )
        assert np.all(got[length:, n] == 0.0)


def test_normalized_returns_by_hand():
    returns = returns_by_hand(0.9)
    got = weights(est.normalized_returns(0.9), make_trajectory())
    for n, length in enumerate(LENGTHS):
        own = returns[:length, n]
        spread = np.std(own, ddof=1) if length > 1 else 0.0
        expected = (own - own.mean()) / (spread + np.finfo(np.float32).eps)
        np.testing.assert_allclose(got[:length, n], expected, rtol=1e-5, atol=1e-6)
        assert np.all(got[length:, n] == 0.0)


def test_standardize_and_discount_weights():
    raw = weights(est.reward_to_go(1.0), make_trajectory())
    mask = np.arange(4)[:, None] < LENGTHS
    scaled = weights(est.standardize(est.reward_to_go(1.0), floor=0.0), make_trajectory())
    np.testing.assert_allclose(scaled, raw / np.sqrt(np.mean(raw[mask] ** 2)), rtol=1e-5)
    centred = weights(est.standardize(est.reward_to_go(1.0), center=True), make_trajectory())
    assert np.mean(centred[mask]) == pytest.approx(0.0, abs=1e-6)
    assert np.std(centred[mask]) == pytest.approx(1.0, rel=1e-5)
    powers = weights(est.discount_weights(est.reward_to_go(1.0), 0.5), make_trajectory())
    np.testing.assert_allclose(powers, raw * 0.5 ** np.arange(4)[:, None], rtol=1e-6)


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_nothing_after_the_end_has_any_effect(name):
    estimator = est.standardize(load(ESTIMATORS[name])(0.9))
    clean = weights(estimator, make_trajectory())
    poisoned = make_trajectory().replace(action=make_trajectory(np.nan).action)
    np.testing.assert_array_equal(clean, weights(estimator, poisoned))
    assert np.all(clean[np.arange(4)[:, None] >= LENGTHS] == 0.0)


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_permuting_episodes_permutes_weights(name):
    estimator, order = load(ESTIMATORS[name])(0.9), np.array([2, 0, 1])
    trajectory = make_trajectory()
    permuted = trajectory.replace(
        **{k: getattr(trajectory, k)[:, order] for k in ("observation", "action", "reward", "mask")}
    )
    expected = weights(estimator, trajectory)[:, order]
    np.testing.assert_allclose(weights(estimator, permuted), expected, rtol=1e-5, atol=1e-6)


def tabular_policy():
    """One row of logits for each pull of Chain."""

    def init(key):
        del key
        return jnp.array([[0.2, -0.1], [0.5, 0.3], [-0.4, 0.1]])

    return Policy(init, lambda params, observation: observation @ params, categorical(2))


CASES = {
    "total return": (est.total_return(1.0), 1.0),
    "reward to go": (est.reward_to_go(1.0), 1.0),
    "leave one out": (est.leave_one_out(1.0), 1.0),
    "leave one out of the living": (est.leave_one_out(1.0, ended="skip"), 1.0),
    "value baseline": (est.value_baseline(1.0), 1.0),
    "discounted with gamma^t": (est.discount_weights(est.leave_one_out(0.5), 0.5), 0.5),
}


@pytest.mark.parametrize("case", CASES)
def test_gradient_is_unbiased_on_a_bandit(case):
    estimator, discount = CASES[case]
    assert_unbiased(estimator, functools.partial(expected_return, discount=discount))


def test_mean_log_prob_is_unbiased_for_the_mean_return_to_go():
    """E[sum_t G[t] / L]: at discount 1, reward t counts t + 1 times, over the length."""

    def expected(logits):
        log_probs, total = jax.nn.log_softmax(logits), 0.0
        for arms in [(a, 0) for a in (0, 1)] + [(a, 1, b) for a in (0, 1) for b in (0, 1)]:
            probability = jnp.exp(sum(log_probs[t, arm] for t, arm in enumerate(arms)))
            earned = sum((t + 1) * Chain.rewards[t, arm] for t, arm in enumerate(arms))
            total = total + probability * earned / len(arms)
        return total

    assert_unbiased(est.mean_log_prob(1.0), expected)


def assert_unbiased(estimator, objective):
    policy = tabular_policy()
    learner = reinforce(
        Chain(),
        policy=policy,
        estimator=estimator,
        optimizer=optax.sgd(1.0),
        num_episodes=3,
        normalize_steps=0,
    )
    start = policy.init(jax.random.key(0))

    def gradient(key):
        state, _ = train_step(learner, learner.init(key))
        return state.actor.params - start

    samples = jax.jit(jax.vmap(gradient))(jax.random.split(jax.random.key(1), 30_000))
    exact = jax.grad(objective)(start)
    error = np.std(samples, axis=0) / np.sqrt(len(samples))
    assert np.all(np.abs(np.mean(samples, axis=0) - exact) < 4.5 * error + 1e-6)


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match=r"discount must lie in \[0, 1\], got 1.5"):
        est.reward_to_go(1.5)
    with pytest.raises(ValueError, match="'zero' or 'skip'"):
        est.leave_one_out(ended="alive")
    with pytest.raises(ValueError, match="at least 2 episodes"):
        reinforce(Chain(), policy=tabular_policy(), estimator=est.leave_one_out(), num_episodes=1)

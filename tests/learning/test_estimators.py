"""Baselines against sums by hand, all estimators with poisoned padding and broken episodes."""

import functools

import flax.linen
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from toys import Chain, tabular_policy

from mjx_reinforce import Trajectory, reinforce
from mjx_reinforce.learning import estimators as est
from mjx_reinforce.learning.estimators import discounted_returns
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.learning.value import full_batch_value_baseline, value_baseline
from mjx_reinforce.registry import ESTIMATORS, load_definition

LENGTHS = np.array([4, 1, 3])
REWARD = np.array([[1.0, 2.0, 0.5], [0.5, 9.0, 1.5], [2.0, 9.0, 1.0], [3.0, 9.0, 9.0]])


MAKERS = {name: load_definition(path) for name, path in ESTIMATORS.items()}
MAKERS["full-batch value-baseline"] = full_batch_value_baseline
MASK = np.arange(4)[:, None] < LENGTHS


def make_trajectory(mask=MASK, observation=0.0, action=0.0, reward=0.0):
    """Three episodes; the arguments are what stands behind their ends."""
    seen = np.arange(12.0).reshape(4, 3, 1) / 12
    return Trajectory(
        observation=jnp.asarray(np.where(mask[..., None], seen, observation)),
        action=jnp.asarray(np.where(mask[..., None], 0.5, action)),
        reward=jnp.asarray(np.where(mask, REWARD, reward)),
        mask=jnp.asarray(mask),
        nonfinite=jnp.zeros(mask.shape[1], bool),
        simulated=jnp.int32(mask.size),
    )


def update(estimator, trajectory):
    return estimator.update(estimator.init(jax.random.key(0), 1), trajectory)


def weights(estimator, trajectory):
    return np.asarray(update(estimator, trajectory)[0])


def assert_equal(got, expected):
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def returns_by_hand(discount):
    returns = np.zeros((5, 3))
    for t in reversed(range(4)):
        alive = t < LENGTHS
        returns[t] = np.where(alive, np.where(alive, REWARD[t], 0) + discount * returns[t + 1], 0.0)
    return returns[:4]


@pytest.mark.parametrize(
    ("horizon", "dtype", "within"),
    [(1, np.float64, 1e-12), (36, np.float64, 1e-12), (37, np.float32, 1e-5)],
)
def test_returns_to_go_are_those_of_the_recurrence(horizon, dtype, within):
    reward = np.random.default_rng(horizon).normal(1.0, 1.0, (horizon, 2)).astype(dtype)
    discounts = [0, 0.5, 0.995, 1]
    expected = np.zeros((horizon + 1, len(discounts), 2))
    for t in reversed(range(horizon)):
        expected[t] = reward[t] + np.array(discounts)[:, None] * expected[t + 1]
    with jax.enable_x64(dtype == np.float64):
        traced = jnp.asarray(discounts, dtype)
        together = jax.vmap(discounted_returns, (None, 0), 1)(jnp.asarray(reward), traced)
        alone = [discounted_returns(jnp.asarray(reward), discount) for discount in discounts]
    for got in (together, np.stack(alone, 1)):
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected[:-1], rtol=within, atol=within)


@pytest.mark.parametrize("make", [est.leave_one_out, est.leave_one_out_alive])
def test_leave_one_out_by_hand(make):
    returns = returns_by_hand(0.9)
    expected = np.zeros((4, 3))
    for t in range(4):
        for n in range(3):
            others = [
                m for m in range(3) if m != n and (make is est.leave_one_out or t < LENGTHS[m])
            ]
            baseline = np.mean([returns[t, m] for m in others]) if others else 0.0
            expected[t, n] = returns[t, n] - baseline if t < LENGTHS[n] else 0.0
    got = weights(make(0.9), make_trajectory())
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_full_batch_value_baseline_by_hand():
    """Two gradient steps of a linear critic on the mean squared error, after its use."""
    returns, seen = (
        returns_by_hand(0.9)[MASK],
        np.asarray(make_trajectory().observation)[MASK][:, 0],
    )
    estimator = full_batch_value_baseline(
        0.9, network=flax.linen.Dense(1), optimizer=optax.sgd(0.1), num_fits=2
    )
    critic = estimator.init(jax.random.key(0), 1)
    slope, bias = float(critic.params["params"]["kernel"][0, 0]), 0.0
    weight, after, metrics = estimator.update(critic, make_trajectory())
    residual = returns - slope * seen
    np.testing.assert_allclose(np.asarray(weight)[MASK], residual, rtol=1e-5)
    assert np.all(np.asarray(weight)[~MASK] == 0.0)
    assert float(metrics["value_loss"]) == pytest.approx(np.mean(residual**2), rel=1e-5)
    explained = 1 - np.var(residual) / np.var(returns)
    assert float(metrics["explained_variance"]) == pytest.approx(explained, rel=1e-5)
    for _ in range(2):
        error = slope * seen + bias - returns
        slope, bias = slope - 0.1 * np.mean(2 * error * seen), bias - 0.1 * np.mean(2 * error)
    params = after.params["params"]
    assert float(params["kernel"][0, 0]) == pytest.approx(slope, rel=1e-5)
    assert float(params["bias"][0]) == pytest.approx(bias, rel=1e-5)


def test_the_critics_optimizer_keeps_its_state_and_sees_the_parameters():
    """Momentum goes on from one update to the next; a weight decay needs the parameters."""
    optimizer = optax.chain(optax.add_decayed_weights(0.5), optax.sgd(0.1, momentum=0.9))
    trajectory, network = make_trajectory(), flax.linen.Dense(1)
    one, two = (
        full_batch_value_baseline(0.9, network=network, optimizer=optimizer, num_fits=fits)
        for fits in (1, 2)
    )
    critic = one.init(jax.random.key(0), 1)
    twice = one.update(one.update(critic, trajectory)[1], trajectory)[1]
    at_once = two.update(critic, trajectory)[1]
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), twice, at_once)


def test_value_baseline_by_hand():
    """Two updates of a linear critic of (observation, time), two drawn minibatches each."""
    returns = returns_by_hand(0.9)[MASK]
    seen = np.asarray(make_trajectory().observation)[MASK][:, 0]
    inputs = np.stack([seen, np.nonzero(MASK)[0] / 4, np.ones_like(seen)], axis=1)
    optimizer = optax.sgd(0.1, momentum=0.5)
    estimator = value_baseline(
        0.9, horizon=4, network=flax.linen.Dense(1), optimizer=optimizer, num_fits=2, batch_size=5
    )
    critic = estimator.init(jax.random.key(0), 1)
    line = np.append(np.asarray(critic.params["params"]["kernel"])[:, 0], 0.0)
    trace, mean, variance = np.zeros(3), 0.0, 0.0
    for number, share in enumerate((1.0, 0.5)):
        draw_key = jax.random.fold_in(jax.random.key(critic.seed), number)
        drawn = jax.random.randint(draw_key, (2, 5), 1, MASK.sum() + 1)
        expected = returns - (mean + np.sqrt(variance) * inputs @ line)
        weight, critic, metrics = estimator.update(critic, make_trajectory())
        np.testing.assert_allclose(np.asarray(weight)[MASK], expected, rtol=1e-5, atol=1e-5)
        assert np.all(np.asarray(weight)[~MASK] == 0.0)
        assert float(metrics["value_loss"]) == pytest.approx(np.mean(expected**2), rel=1e-5)
        mean += share * (returns.mean() - mean)
        variance += share * (np.mean((returns - mean) ** 2) - variance)
        targets = (returns - mean) / np.sqrt(variance)
        for batch in np.asarray(drawn) - 1:
            error = inputs[batch] @ line - targets[batch]
            trace = 0.5 * trace + np.mean(2 * error[:, None] * inputs[batch], axis=0)
            line = line - 0.1 * trace
        params = critic.params["params"]
        got = np.append(np.asarray(params["kernel"])[:, 0], np.asarray(params["bias"]))
        np.testing.assert_allclose(got, line, rtol=1e-4, atol=1e-6)


def test_returns_that_do_not_vary_are_learned_at_once():
    trajectory = make_trajectory().replace(reward=jnp.where(jnp.asarray(MASK), 3.0, 0.0))
    estimator = value_baseline(0.0)
    critic = estimator.update(estimator.init(jax.random.key(0), 1), trajectory)[1]
    weight = estimator.update(critic, trajectory)[0]
    np.testing.assert_allclose(weight, 0.0, atol=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.1, -1e6])
def test_equal_returns_leave_nothing_to_explain(level):
    """Neither a perfect baseline nor a bad one: NaN, also where their mean is rounded."""
    residual = jnp.tile(jnp.array([1e-4, -1e-4, 0.0]), (7, 1))
    explained = est.explained_variance(residual, jnp.full((7, 3), level), jnp.ones((7, 3), bool))
    assert np.isnan(explained)


def test_a_perfect_baseline_explains_all_and_a_constant_nothing():
    returns, mask = jnp.asarray(REWARD), jnp.asarray(MASK)
    zero = jnp.where(mask, 0.0, 7.0)
    assert float(est.explained_variance(zero, returns, mask)) == 1.0
    assert float(est.explained_variance(returns - 3, returns, mask)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("center", [False, True])
def test_standardize_divides_by_the_deviation_and_its_floor(center):
    raw = weights(est.reward_to_go(1.0), make_trajectory())
    mean = raw[MASK].mean() if center else 0.0
    std = np.sqrt(np.mean((raw[MASK] - mean) ** 2))
    estimator = est.standardize(est.reward_to_go(1.0), floor=0.5, center=center)
    got, _, metrics = update(estimator, make_trajectory())
    expected = np.where(MASK, (raw - mean) / (std + 0.5), 0.0)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert float(metrics["weight_std"]) == pytest.approx(std, rel=1e-5)


def test_standardize_by_default_does_not_centre_and_adds_almost_nothing():
    tiny = 1e-8 * make_trajectory().reward
    trajectory = make_trajectory().replace(reward=tiny)
    got = weights(est.standardize(est.reward_to_go(0.0)), trajectory)
    expected = np.asarray(tiny) / (np.sqrt(np.mean(np.asarray(tiny)[MASK] ** 2)) + 1e-8)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.parametrize("wrap", [est.standardize, est.discount_weights])
def test_wrapping_keeps_what_an_estimator_requires_learns_and_measures(wrap):
    inner = value_baseline(0.9)
    assert wrap(est.leave_one_out()).min_episodes == 2
    _, critic, metrics = update(inner, make_trajectory())
    _, wrapped_critic, wrapped_metrics = update(wrap(inner), make_trajectory())
    assert jax.tree.structure(critic) == jax.tree.structure(wrapped_critic)
    assert metrics.keys() <= wrapped_metrics.keys()
    assert_equal(critic, wrapped_critic)
    assert_equal(metrics, {name: wrapped_metrics[name] for name in metrics})


@pytest.mark.parametrize(
    ("name", "wrap"),
    [
        *((name, lambda e: e) for name in sorted(MAKERS)),
        *(("value-baseline", wrap) for wrap in (est.standardize, est.discount_weights)),
    ],
)
def test_nothing_after_the_end_has_any_effect_on_the_weights(name, wrap):
    """A normalized observation behind the end may be anything: no weight reads it."""
    estimator = wrap(MAKERS[name](0.9))
    clean = weights(estimator, make_trajectory())
    poisoned = weights(estimator, make_trajectory(observation=np.nan, action=np.nan))
    np.testing.assert_array_equal(clean, poisoned)
    assert np.all(clean[~MASK] == 0.0)
    assert np.any(clean[MASK] != 0.0)


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_nothing_after_the_end_has_any_effect_on_what_is_learned(name):
    """The observation stays finite, as it does clipped: a critic is differentiated.

    A reward behind the end is zero by Trajectory's contract, for it would count in the return of
    every step before it. Not so at discount 0, where G[t] = r[t]: there it may be poisoned too.
    Only a mean that counts ended episodes as the 0 they earn relies on that 0.
    """
    make = est.leave_one_out_alive if name == "leave-one-out" else MAKERS[name]
    estimator = make(0.0)
    clean = update(estimator, make_trajectory())
    huge = make_trajectory(observation=1e30, action=np.nan, reward=1e30)
    assert_equal(update(estimator, huge), clean)


@pytest.mark.parametrize("wrap", [lambda e: e, functools.partial(est.standardize, center=True)])
@pytest.mark.parametrize("name", sorted(MAKERS))
def test_a_seed_that_plays_nothing_stays_finite(name, wrap):
    estimator = wrap(MAKERS[name](0.9))
    weight, state, metrics = update(estimator, make_trajectory(mask=np.zeros((4, 3), bool)))
    assert np.all(np.asarray(weight) == 0.0)
    assert np.isnan(metrics.pop("explained_variance", np.nan))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, metrics)))


def test_one_step_is_a_sample_of_one():
    """A mean over one step divides by one."""
    mask = np.array([[True], [False]])
    trajectory = make_trajectory(mask=np.pad(mask, ((0, 2), (0, 2))))
    scaled, _, metrics = update(est.standardize(est.reward_to_go(), floor=0.0), trajectory)
    assert float(metrics["weight_std"]) == float(scaled[0, 0]) == 1.0
    estimator = full_batch_value_baseline(network=flax.linen.Dense(1), num_fits=1)
    critic = estimator.init(jax.random.key(0), 1)
    _, _, metrics = estimator.update(critic, trajectory)
    assert float(metrics["value_loss"]) == pytest.approx(
        1.0, rel=1e-5
    )  # seen 0, valued 0, earned 1


def broken(trajectory, which=1):
    return trajectory.replace(nonfinite=jnp.arange(3) == which)


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_what_a_broken_episode_earned_has_no_effect(name):
    """It may be anything; what is learned of the others is the same."""
    estimator, trajectory = MAKERS[name](0.9), broken(make_trajectory())
    rich = trajectory.replace(reward=trajectory.reward.at[0, 1].set(1e3))
    assert_equal(update(estimator, rich), update(estimator, trajectory))


@pytest.mark.parametrize(("which", "sign"), [(0, 1), (1, -1), (2, 1)])
@pytest.mark.parametrize("name", sorted(MAKERS))
def test_a_broken_episode_is_the_worst(name, which, sign):
    """At every step; the critic is of zeros."""
    options = {"network": MLP((), 1, output_scale=0.0)} if "value-baseline" in name else {}
    trajectory = make_trajectory()
    trajectory = broken(trajectory.replace(reward=sign * trajectory.reward), which)
    got = weights(MAKERS[name](0.9, **options), trajectory)
    others = np.where(MASK & (np.arange(3) != which), got, np.inf)
    assert np.all((got[:, which] <= others.min(axis=1) + 1e-6)[MASK[:, which]])


def test_a_broken_episode_by_hand():
    returns = returns_by_hand(0.9)
    got = weights(est.reward_to_go(0.9), broken(make_trajectory(), 0))
    returns[:, 0] = returns[:, 1:].min(axis=1)
    np.testing.assert_allclose(got, np.where(MASK, returns, 0.0), rtol=1e-6)


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_permuting_episodes_permutes_weights(name):
    estimator, order = MAKERS[name](0.9), np.array([2, 0, 1])
    trajectory = make_trajectory()
    permuted = trajectory.replace(
        **{k: getattr(trajectory, k)[:, order] for k in ("observation", "action", "reward", "mask")}
    )
    expected = weights(estimator, trajectory)[:, order]
    np.testing.assert_allclose(weights(estimator, permuted), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "make", [*MAKERS.values(), functools.partial(est.discount_weights, est.reward_to_go())]
)
def test_a_discount_lies_between_0_and_1(make):
    make(0.0), make(1.0)
    jax.vmap(lambda discount: make(discount) and discount)(jnp.array([0.5, 2.0]))  # on trust
    for wrong in (-0.01, 1.01):
        with pytest.raises(ValueError, match=rf"must lie in \[0, 1\], got {wrong}"):
            make(wrong)


def test_nonsense_is_refused():
    for name in ("horizon", "num_fits", "batch_size"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            value_baseline(**{name: 0})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="num_fits must be at least 1, got 0"):
        full_batch_value_baseline(num_fits=0)
    with pytest.raises(ValueError, match="estimator"):
        est.standardize(est.reward_to_go)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 2 episodes"):
        reinforce(Chain(), policy=tabular_policy(), estimator=est.leave_one_out(), num_episodes=1)

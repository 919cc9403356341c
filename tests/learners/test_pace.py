"""As many episodes an update as the gradient's noise asks for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Survive, Toy

from mjx_reinforce import (
    full_batch,
    leave_one_out,
    make_optimizer,
    mean_log_prob,
    minibatches,
    mlp_policy,
    normal,
    normalized_returns,
    reinforce,
    standardize,
    total_return,
    value_baseline,
)
from mjx_reinforce.learners import pace
from mjx_reinforce.learners.diagnostics import noise_of_groups
from mjx_reinforce.learners.pace import AutoEpisodes, Noise
from mjx_reinforce.types import Box

AUTO = AutoEpisodes(16, 400)


def followed(measured, auto=AUTO, start=None):
    """Returns the numbers of episodes after each update that measured (signal, noise)."""
    state = pace.first_pace(auto)
    if start is not None:
        state = dataclasses.replace(state, num_episodes=jnp.int32(start))
    numbers = []
    for signal, noise in measured:
        state = pace.next_pace(state, auto, Noise(jnp.float32(signal), jnp.float32(noise)))
        numbers.append(int(state.num_episodes))
    return numbers


def test_it_goes_to_the_noise_scale_by_a_factor_of_two_an_update():
    assert followed([(2.0, 200.0)] * 5) == [32, 64, 100, 100, 100]
    assert followed([(2.0, 200.0)] * 4, AUTO._replace(ratio=0.25)) == [25, 25, 25, 25]
    assert followed([(1.0, 50.0)] * 5, start=400) == [200, 100, 50, 50, 50]
    assert followed([(1.0, 51.0)] * 4, start=33)[:2] == [51, 51]


def test_it_stays_between_its_bounds():
    assert followed([(1.0, 3.0)] * 3) == [16] * 3
    assert followed([(1e-6, 1.0)] * 7) == [32, 64, 128, 256, 400, 400, 400]


def test_a_signal_that_noise_hides_asks_for_more():
    """A mean that is 0 or negative, and one so small that the ratio would overflow."""
    for signal in (-5.0, 0.0, 1e-38):
        assert followed([(signal, 1.0)] * 6) == [32, 64, 128, 256, 400, 400]
    after = followed([(-1.0, 100.0)] + [(10.0, 100.0)] * 60)
    assert after[0] == 32
    assert after[-1] == 16  # one such update is forgotten


def test_an_update_that_broke_says_nothing():
    for broken in ((np.nan, 1.0), (1.0, np.inf), (np.inf, np.nan)):
        assert followed([(1.0, 30.0), broken, (1.0, 30.0)]) == [30, 30, 30]


def test_means_are_over_the_last_updates():
    """After a change of noise tenfold, half of it shows after some 7 updates, 95 % after 28."""
    numbers = followed([(1.0, 10.0)] * 100 + [(1.0, 110.0)] * 40, AutoEpisodes(2, 4000))
    assert numbers[99] == 10
    assert abs(numbers[106] - 60) < 5
    assert numbers[127] > 104


@pytest.mark.parametrize(("least", "most"), [(2, 2), (16, 2048), (16, 63), (16, 64), (5, 1001)])
def test_there_is_room_for_every_number(least, most):
    """The arrays are less than four times as wide, or as the least number."""
    rooms = AutoEpisodes(least, most).rooms()
    assert rooms == sorted(rooms)
    assert rooms[-1] == most
    for number in range(least, most + 1):
        room = min(room for room in rooms if room >= number)
        assert room < 4 * max(number, least)


@pytest.mark.parametrize("counts", [(4, 4, 4, 4), (1, 9, 2, 5), (3, 0, 0, 2)])
def test_the_noise_between_groups_is_unbiased(counts):
    """On average over 4,000 draws, for numbers of episodes that differ and groups without any."""
    mean, std = np.array([0.5, -1.0, 0.0]), np.array([1.0, 3.0, 0.2])
    total, trials = sum(counts), 4000
    drawn = mean + std * np.random.default_rng(0).normal(size=(trials, total, 3))
    ends = np.cumsum(counts)
    sums = np.stack(
        [drawn[:, end - n : end].sum(axis=1) for end, n in zip(ends, counts, strict=True)], axis=1
    )
    got = jax.vmap(lambda x: noise_of_groups({"a": x[:, :2], "b": x[:, 2]}, jnp.array(counts)))(
        jnp.asarray(sums, jnp.float32)
    )
    for values, exact in ((got.signal, np.sum(mean**2)), (got.noise, np.sum(std**2))):
        error = np.std(values) / np.sqrt(trials)
        assert abs(np.mean(values) - exact) < 4 * error
        assert error < exact / 10


def test_bad_bounds_are_refused():
    def learner(auto, update=None):
        return reinforce(Survive(), num_episodes=auto, update=update)

    with pytest.raises(ValueError, match=r"AutoEpisodes\.least must be at least 2, got 1"):
        learner(AutoEpisodes(1, 5))
    with pytest.raises(ValueError, match=r"AutoEpisodes\.most must be at least 9, got 8"):
        learner(AutoEpisodes(9, 8))
    with pytest.raises(ValueError, match=r"AutoEpisodes\.ratio must be positive"):
        learner(AutoEpisodes(ratio=0.0))
    with pytest.raises(ValueError, match=r"needs the update full_batch\(\)"):
        learner(AutoEpisodes(), minibatches(2, 3))


class Noisy(Toy):
    """Earns its action and a number that is drawn at the start."""

    action_space = Box(np.array([-np.inf]), np.array([np.inf]))
    spread = 0.0

    def reset(self, rng):
        start = super().reset(rng)
        return dataclasses.replace(start, info=self.spread * jax.random.normal(rng))

    def step(self, state, action):
        return state.replace(reward=action[0] + state.info, done=jnp.ones(()))


@pytest.mark.parametrize("scale", [40, 160])
def test_an_update_plays_as_many_episodes_as_the_noise_scale(scale):
    """Known exactly for one step of a normal distribution, whose mean and log std are trained.

    The gradient of an episode is (e + x)(e, e^2 - 1), with e the action's noise of variance 1 and x
    the reward's of variance s^2: its mean is (1, 0), its variances are 2 + s^2 and 10 + 2 s^2.
    """
    env = Noisy()
    env.spread = np.sqrt((scale - 12) / 3)
    learner = reinforce(
        env,
        policy=mlp_policy(1, normal(env.action_space, initial_std=1.0), ()),
        estimator=leave_one_out(1.0),
        optimizer=make_optimizer("sgd", 0.0, max_grad_norm=None),
        num_episodes=AutoEpisodes(16, 600),
        normalize_steps=0,
        engine="vmap",
    )
    state = learner.init(jax.random.key(0))

    def step(state, _):
        state, metrics = learner.step(state)
        return state, metrics["episodes"]

    numbers = np.asarray(jax.jit(lambda s: jax.lax.scan(step, s, length=600))(state)[1])
    assert numbers[0] == 16
    middle = np.median(numbers[100:])
    assert 0.75 * scale < middle < 1.35 * scale
    assert np.ptp(numbers) > 0


ESTIMATORS = {
    "leave-one-out": leave_one_out(0.9),
    "skip": leave_one_out(0.9, ended="skip"),
    "total": total_return(0.9),
    "standardized": standardize(leave_one_out(0.9), floor=0.5),
    "value": value_baseline(0.9, num_fits=2),
    "mean log prob": mean_log_prob(0.9),
    "normalized": normalized_returns(0.9),
}


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("loss_per", ["episode", "step"])
def test_only_episodes_that_were_played_count(name, loss_per):
    """Learning from 20 of 90 is learning from 20, one of which broke, up to rounding."""
    env = Survive()

    def learner(num_episodes):
        return reinforce(
            env,
            policy=mlp_policy(1, normal(env.action_space), (4,)),
            estimator=ESTIMATORS[name],
            optimizer=make_optimizer("sgd", 0.1, max_grad_norm=None),
            num_episodes=num_episodes,
            max_kl=1e-3,
            entropy_cost=0.01,
            loss_per=loss_per,
            engine="vmap",
        )

    fixed, auto = learner(20), learner(AutoEpisodes(16, 90))
    first = fixed.init(jax.random.key(3))
    start = dataclasses.replace(auto.init(jax.random.key(3)).pace, num_episodes=jnp.int32(20))
    played = jax.jit(fixed.play)(first, jax.random.key(1))
    wide = jax.jit(auto.play)(dataclasses.replace(first, pace=start), jax.random.key(1))
    for key in ("observation", "action", "reward", "mask"):
        np.testing.assert_array_equal(getattr(wide, key)[:, :20], getattr(played, key))
        assert not np.any(getattr(wide, key)[:, 20:])
    broken = jnp.arange(20) == 7
    played = dataclasses.replace(played, nonfinite=broken)
    wide = dataclasses.replace(wide, nonfinite=jnp.pad(broken, (0, 70)))
    after, metrics = jax.jit(fixed.learn)(first, played, jax.random.key(2))
    key = jax.random.key(2)
    got, others = jax.jit(auto.learn)(dataclasses.replace(first, pace=start), wide, key)
    assert metrics.keys() == others.keys()
    skipped = {"gradient_snr", "kl", "simulated_steps"}
    for key in metrics.keys() - skipped:
        np.testing.assert_allclose(others[key], metrics[key], rtol=1e-5, atol=1e-6, err_msg=key)
    assert int(others["episodes"]) == 20
    pairs = zip(jax.tree.leaves(got.actor), jax.tree.leaves(after.actor), strict=True)
    for ours, theirs in pairs:
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    moved = [
        np.any(a != b)
        for a, b in zip(*map(jax.tree.leaves, (after.actor, first.actor)), strict=True)
    ]
    assert np.any(moved)


def test_seeds_side_by_side_have_numbers_of_their_own():
    """And what each does is what it does alone, up to rounding."""
    learner = reinforce(Survive(), num_episodes=AutoEpisodes(2, 40), engine="vmap")
    states = jax.vmap(learner.init)(jax.random.split(jax.random.key(0), 3))
    numbers = jnp.int32([3, 40, 8])
    states = dataclasses.replace(
        states, pace=dataclasses.replace(states.pace, num_episodes=numbers)
    )
    active = jnp.array([True, False, True])
    after, metrics = jax.jit(jax.vmap(learner.step))(states, active)
    assert metrics["episodes"].tolist() == [3, 0, 8]
    for s in (0, 2):
        one = jax.tree.map(lambda x, s=s: x[s], states)
        alone, measured = jax.jit(learner.step)(one, True)
        np.testing.assert_allclose(metrics["episode_return"][s], measured["episode_return"])
        np.testing.assert_array_equal(after.pace.num_episodes[s], alone.pace.num_episodes)
        pairs = zip(jax.tree.leaves(after.actor), jax.tree.leaves(alone.actor), strict=True)
        for ours, theirs in pairs:
            np.testing.assert_allclose(ours[s], theirs, rtol=2e-5, atol=1e-6)
    assert int(after.pace.num_episodes[1]) == 40


def test_a_fixed_number_has_no_pace():
    learner = reinforce(Survive(), num_episodes=4, update=full_batch(), engine="vmap")
    assert learner.init(jax.random.key(0)).pace is None
    assert not learner.narrower

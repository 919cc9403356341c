"""Updates and optimizers against loops by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import MASK, PARAMS, START, make_problem, surrogate
from toys import Survive

from mjx_reinforce import reinforce
from mjx_reinforce.engine import counts
from mjx_reinforce.learning import schedules, updates
from mjx_reinforce.learning.updates import Problem
from mjx_reinforce.published import variants
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.build import _build_optimizer


def run(update, problem, key=None):
    key = jax.random.key(1) if key is None else key
    return update(problem, key, PARAMS, problem.optimizer.init(PARAMS))


def descend(problem, params, opt_state, samples, divisor):
    grads, sums = jax.grad(surrogate, has_aux=True)(params, samples)
    grads = jax.tree.map(lambda g: g / divisor, grads)
    changes, opt_state = problem.optimizer.update(grads, opt_state, params)
    norm = np.sqrt(sum(float(g) ** 2 for g in grads.values()))
    return optax.apply_updates(params, changes), opt_state, norm, float(sums["entropy"])


def assert_close(got, expected):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6), got, expected)


#: It reads its state, and the parameters for their decay.
ADAMW = optax.adamw(0.1, weight_decay=0.3)


def test_full_batch_is_one_step():
    problem = make_problem(ADAMW)
    params, opt_state, metrics = run(updates.full_batch(), problem)
    start = PARAMS, problem.optimizer.init(PARAMS)
    expected = descend(problem, *start, problem.samples, 3)
    assert_close((params, opt_state), expected[:2])
    assert float(metrics["gradient_norm"]) == pytest.approx(expected[2], rel=1e-5)
    assert float(metrics["entropy"]) == pytest.approx(expected[3] / MASK.sum(), rel=1e-5)


@pytest.mark.parametrize("update", [updates.full_batch(), variants.each_step()])
def test_metrics_of_a_single_step_and_of_none(update):
    """A mean over one step divides by one; nothing played measures nothing, and is finite."""
    one = np.zeros((5, 3), bool)
    one[0, 1] = True
    problem = make_problem(optax.sgd(0.1), divisor=2, mask=one)
    _, _, metrics = run(update, problem)
    expected = descend(problem, PARAMS, problem.optimizer.init(PARAMS), problem.samples, 2)
    assert float(metrics["gradient_norm"]) == pytest.approx(expected[2], rel=1e-5)
    assert float(metrics["entropy"]) == pytest.approx(expected[3], rel=1e-5)
    params, _, metrics = run(update, make_problem(optax.sgd(0.1), mask=np.zeros((5, 3), bool)))
    assert_close(params, PARAMS)
    assert np.isnan(metrics.pop("gradient_snr", np.nan))
    assert {name: float(x) for name, x in metrics.items()} == {"entropy": 0, "gradient_norm": 0}


def each_step_by_hand(problem):
    params, opt_state = PARAMS, problem.optimizer.init(PARAMS)
    norms, entropy, mask = [], 0.0, np.asarray(problem.samples[-1])
    for t in range(len(mask)):
        if mask[t].any():
            now = tuple(x[t] for x in problem.samples)
            params, opt_state, norm, sums = descend(problem, params, opt_state, now, 3)
            norms, entropy = [*norms, norm], entropy + sums
    return params, opt_state, {"entropy": entropy / mask.sum(), "gradient_norm": np.mean(norms)}


@pytest.mark.parametrize("longest", [1, 4, 5])
def test_each_step_is_a_loop_over_time(longest):
    """Up to the end of the longest episode, which may be the horizon of 5."""
    mask = np.arange(5)[:, None] < np.minimum([longest, 1, 3], longest)
    problem = make_problem(ADAMW, mask=mask)
    assert_close(run(variants.each_step(), problem), each_step_by_hand(problem))


def test_each_step_of_one_seed_ends_with_its_own_episodes():
    """Beside a seed whose episodes are longer; Adam would move on without a gradient."""
    short, optimizer = np.arange(5)[:, None] < np.array([2, 1, 1]), optax.adam(0.1)
    problems = [make_problem(optimizer), make_problem(optimizer, mask=short, seed=1)]
    samples = jax.tree.map(lambda *x: jnp.stack(x), *[p.samples for p in problems])

    def update(samples):
        return run(variants.each_step(), Problem(surrogate, optimizer, samples, 3, START))

    together = jax.vmap(update)(samples)
    for s, problem in enumerate(problems):
        alone = jax.tree.map(lambda x, s=s: x[s], together)
        assert_close(alone, each_step_by_hand(problem))


def test_minibatches_are_steps_on_drawn_samples():
    problem, key = make_problem(ADAMW), jax.random.key(5)
    got = run(variants.minibatches(3, 4), problem, key)
    drawn = jax.random.randint(key, (3, 4), 1, MASK.sum() + 1)
    flat = [x.reshape(-1, *x.shape[2:]) for x in problem.samples]
    params, opt_state, norms, entropy = PARAMS, problem.optimizer.init(PARAMS), [], []
    for index in np.flatnonzero(MASK)[np.asarray(drawn) - 1]:
        batch = tuple(x[index] for x in flat)
        params, opt_state, norm, sums = descend(problem, params, opt_state, batch, 4)
        norms, entropy = [*norms, norm], [*entropy, sums / 4]
    metrics = {"entropy": np.mean(entropy), "gradient_norm": np.mean(norms)}
    assert_close(got, (params, opt_state, metrics))


def test_minibatches_of_nothing_stay_in_bounds():
    """A seed that stands still draws too; what it draws is thrown away, and must be finite."""
    params, _, metrics = run(
        variants.minibatches(2, 3), make_problem(optax.adam(0.1), mask=np.zeros((5, 3), bool))
    )
    assert all(np.isfinite(x) for x in jax.tree.leaves((params, metrics)))


def test_minibatches_draw_every_played_step_alike_and_no_other():
    """The weights outside the mask are NaN here."""

    def which(key):
        number = jnp.asarray(np.where(MASK, np.arange(MASK.size).reshape(MASK.shape), np.nan))
        samples = tuple(map(jnp.asarray, (number, MASK)))
        total = lambda w, s: (w * jnp.sum(s[0]), {"entropy": 0.0})  # noqa: E731
        linear = Problem(total, optax.sgd(1.0), samples, 1, START)
        return -variants.minibatches(1, 1)(linear, key, jnp.zeros(()), linear.optimizer.init(0.0))[
            0
        ]

    drawn = np.asarray(jax.vmap(which)(jax.random.split(jax.random.key(0), 8000))).round()
    counts = np.bincount(drawn.astype(int), minlength=MASK.size).reshape(MASK.shape)
    assert np.all(counts[~MASK] == 0)
    np.testing.assert_allclose(counts[MASK], 1000, atol=5 * np.sqrt(1000 * 7 / 8))


@pytest.mark.slow
def test_a_seed_that_stands_still_stays_as_it_is():
    learner = reinforce(Survive(), num_episodes=4, update=variants.each_step())
    states = jax.jit(jax.vmap(learner.init))(jax.random.split(jax.random.key(0), 2))
    after, metrics = jax.jit(jax.vmap(learner.step))(states, jnp.array([True, False]))
    assert int(metrics["env_steps"][1]) == 0

    def same(seed, x, y):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        return bool(np.all(np.asarray(x[seed]) == np.asarray(y[seed])))

    assert all(jax.tree.leaves(jax.tree.map(functools.partial(same, 1), states, after)))
    assert not all(jax.tree.leaves(jax.tree.map(functools.partial(same, 0), states, after)))


#: It clips by default.
CLIP, SCHEDULE = optax.clip_by_global_norm, optax.piecewise_constant_schedule(0.1, {1: 10.0})


@pytest.mark.parametrize(
    ("given", "settings", "expected"),
    [
        ((), {}, [CLIP(1.0), optax.adam(1e-2)]),
        (("sgd", SCHEDULE), {}, [CLIP(1.0), optax.sgd(SCHEDULE)]),
        (("adam", 0.1), {"momentum": 0.5}, [CLIP(1.0), optax.adam(0.1, 0.5)]),
        (("sgd", 0.1), {"max_grad_norm": None}, [optax.sgd(0.1)]),
        (("adam", 0.1), {"max_grad_norm": 0.5}, [CLIP(0.5), optax.adam(0.1)]),
    ],
)
def test_an_optimizer_is_a_chain_of_optax(given, settings, expected):
    def changes(optimizer):
        params, made = jnp.array([6.0, 8.0]), []
        state = optimizer.init(params)
        for gradient in ([3.0, 4.0], [0.3, -0.4], [-0.1, 0.2]):
            change, state = optimizer.update(jnp.array(gradient), state, params)
            params, made = params + change, [*made, change]
        return np.stack(made)

    made = updates.make_optimizer(*given, **settings)
    np.testing.assert_allclose(changes(made), changes(optax.chain(*expected)), rtol=1e-5)


UPDATES = {
    "full-batch": updates.full_batch(),
    "minibatches": variants.minibatches(3, 4),
    "each-step": variants.each_step(),
}


def clock(progress=0.0, env_steps=0.0):
    return updates.Clock(jnp.asarray(progress), jnp.asarray(env_steps))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "length"),
    [("full-batch", None), ("full-batch", 10), ("minibatches", None), ("each-step", 10)],
)
def test_the_rate_falls_with_the_budget_or_with_env_steps(name, length):
    """All optimizer steps of an update have the rate of its beginning."""
    plain = updates.make_optimizer("sgd", 0.1, max_grad_norm=None)
    decaying = optax.chain(plain, schedules.decay_rate(0.2, length))

    def moved(optimizer, now):
        problem = make_problem(optimizer)._replace(clock=now)
        return UPDATES[name](problem, jax.random.key(3), PARAMS, optimizer.init(PARAMS))[0]

    for share, factor in ((0.0, 1.0), (0.5, 0.6), (1.0, 0.2), (3.0, 0.2)):
        now = clock(share) if length is None else clock(0.9, 10 * share)
        scaled = updates.make_optimizer("sgd", 0.1 * factor, max_grad_norm=None)
        expected, actual = moved(scaled, now), moved(decaying, now)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), actual, expected)


def test_the_std_shrinks_with_the_budget_besides_what_is_learned():
    params = {"network": jnp.ones(2), "constants": jnp.log(jnp.array([0.5, 0.3]))}
    learned = jax.tree.map(lambda x: 0.1 * jnp.ones_like(x), params)
    optimizer = optax.chain(optax.sgd(1.0), schedules.shrink_std(0.1, 20))
    state = optimizer.init(params)
    total = jnp.zeros(2)
    for played, share in ((0, 0.0), (5, 0.25), (15, 0.5), (25, 0.25), (35, 0.0), (10, -0.5)):
        now = clock(env_steps=float(played))
        change, state = optimizer.update(learned, state, params, clock=now)
        np.testing.assert_allclose(change["network"], [-0.1, -0.1], rtol=1e-6)
        expected = np.full(2, -0.1 + share * np.log(0.1))
        np.testing.assert_allclose(change["constants"], expected, rtol=1e-5)
        total += change["constants"] + 0.1
    np.testing.assert_allclose(total, [0.5 * np.log(0.1)] * 2, rtol=1e-5)


@pytest.mark.parametrize("budget", [10**6, 2**53])
def test_schedules_are_exact_for_budgets_of_any_size(budget):
    """Shares of counts in two words, and the std after 10,000 updates however small each is."""
    limit = counts.from_int(budget)
    rate = schedules.decay_rate(0.0)

    @jax.jit
    def share_of(count):
        return counts.as_float(count) / counts.as_float(limit)

    for used in (0, 1, budget // 3, 2**31 - 1, 2**31, 2**32, 2**32 + 7, budget - 1, budget):
        if used <= budget:
            now = updates.Clock(share_of(counts.from_int(used)), jnp.zeros(()))
            factor = rate.update(jnp.ones(()), (), clock=now)[0]
            assert float(factor) == pytest.approx(1 - used / budget, abs=2e-7)

    shrink = schedules.shrink_std(1e-3)
    each, log_std = budget // 10_000, jnp.zeros(1)

    def one(carry, _):
        state, log_std, count = carry
        now = updates.Clock(share_of(count), jnp.zeros(()))
        change, state = shrink.update({"constants": jnp.zeros(1)}, state, None, clock=now)
        count = jax.lax.fori_loop(0, each // 2**30, lambda _, c: counts.plus(c, 2**30), count)
        count = counts.plus(count, each % 2**30)
        return (state, log_std + change["constants"], count), None

    start = shrink.init(None), log_std, counts.zero()
    (_, log_std, count), _ = jax.lax.scan(one, start, length=10_001)
    assert counts.to_int(count) == each * 10_001
    np.testing.assert_allclose(log_std, np.log(1e-3), rtol=3e-4)


def test_settings_become_the_schedules_they_name():
    """The rate falls to a tenth if nothing is said; the noise by the ratio of its two settings."""
    params = {"network": jnp.ones(2), "constants": jnp.zeros(1)}

    def changes(**settings):
        config = Config(optimizer="sgd", learning_rate=0.1, max_grad_norm=None, **settings)
        optimizer = _build_optimizer(config, Survive.action_space)
        state, found = optimizer.init(params), []
        for now in (clock(0.0, 0.0), clock(0.25, 50.0), clock(0.5, 100.0)):
            change, state = optimizer.update(params, state, params, clock=now)
            found.append((float(change["network"][0]), float(change["constants"][0])))
        return np.array(found)

    rates = changes(decay_steps=100)
    np.testing.assert_allclose(rates[:, 0], [-0.1, -0.055, -0.01], rtol=1e-5)
    np.testing.assert_allclose(changes()[:, 0], [-0.1, -0.0775, -0.055], rtol=1e-5)
    rates = changes(decay_steps=100, final_learning_rate=0.05)
    np.testing.assert_allclose(rates[:, 0], [-0.1, -0.075, -0.05], rtol=1e-5)
    np.testing.assert_allclose(changes(decay_steps=None)[:, 0], [-0.1] * 3, rtol=1e-5)
    shrunk = changes(decay_steps=100, initial_std=0.6, final_std=0.03)
    np.testing.assert_allclose(shrunk[:, 1], np.log(0.05) * np.array([0, 0.5, 0.5]), rtol=1e-5)


def test_a_policy_without_an_std_of_its_own_has_nothing_to_shrink():
    params = {"network": jnp.ones(2), "constants": jnp.zeros(0)}
    shrink = schedules.shrink_std(0.1, 20)
    changes, _ = shrink.update(params, shrink.init(params), params, clock=clock(env_steps=10.0))
    assert changes["constants"].shape == (0,)
    np.testing.assert_array_equal(changes["network"], 1)


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="num_updates must be at least 1, got 0"):
        variants.minibatches(0, 8)
    with pytest.raises(ValueError, match="batch_size must be at least 1, got -1"):
        variants.minibatches(1, -1)
    with pytest.raises(ValueError, match=r"unknown optimizer 'adamm'\. Did you mean 'adam'"):
        updates.make_optimizer("adamm")

"""The learner: exact gradients, probes, one trace, keys used once, seeds kept apart."""

import dataclasses
import functools
import inspect

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax import envs as brax_envs
from toys import Drifting, SignedTarget, Survive

from mjx_reinforce import Cut, ars, mlp_policy, normal, reinforce, train_step
from mjx_reinforce.engine import counts
from mjx_reinforce.learning import estimators
from mjx_reinforce.learning import learner as learner_module
from mjx_reinforce.learning.estimators import discounted_returns
from mjx_reinforce.learning.value import value_baseline
from mjx_reinforce.published import variants
from mjx_reinforce.published.gymnasium_tutorial import with_one_start
from mjx_reinforce.training import wrappers


@functools.cache
def survivor():
    """A learner that several tests train, and its compiled start."""
    learner = reinforce(Survive(), num_episodes=4)
    return learner, jax.jit(learner.init)


def train(env, num_updates, **settings):
    learner = reinforce(env, num_episodes=32, **settings)
    state = jax.jit(learner.init)(jax.random.key(0))

    def body(state, _):
        return learner.step(state)

    return learner, *jax.jit(lambda s: jax.lax.scan(body, s, length=num_updates))(state)


def test_train_step_has_what_a_jitted_function_has():
    learner, init = survivor()
    state = jax.eval_shape(init, jax.random.key(0))
    after, metrics = train_step.eval_shape(learner, state)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert metrics["episodes"].shape == ()
    lowered = train_step.lower(learner, state)
    assert lowered.out_info[1].keys() == metrics.keys()
    assert train_step.trace(learner, state).jaxpr.out_avals
    assert list(inspect.signature(train_step).parameters) == ["learner", "state"]
    with pytest.raises(ValueError, match="state must be of type TrainState"):
        train_step(learner, metrics)


@pytest.mark.slow
def test_probe_2_the_best_action_depends_on_the_observation():
    learner, state, _ = train(SignedTarget(), 300)
    obs = jnp.array([[-1.0], [1.0]])
    mode = learner.policy.distribution.mode(learner.act(state.actor, obs))
    np.testing.assert_allclose(mode[:, 0], [-0.5, 0.5], atol=0.15)


@pytest.mark.slow
def test_update_is_the_gradient_of_the_surrogate():
    """SGD at rate 1 moves the parameters by minus the gradient of the formula in reinforce()."""
    with jax.enable_x64(True):
        env, cost = Survive(), 0.1
        policy = mlp_policy(1, normal(env.action_space), (3,))
        learner = reinforce(
            env,
            policy=policy,
            estimator=estimators.reward_to_go(0.9),
            optimizer=optax.sgd(1.0),
            num_episodes=4,
            entropy_cost=cost,
            normalize_steps=0,
        )
        state = jax.jit(learner.init)(jax.random.key(3))
        after, _ = jax.jit(learner.step)(state)
        trajectory = learner.play(state, jax.random.split(state.key)[1], True)
        weight = discounted_returns(trajectory.reward, 0.9)

        def surrogate(params):
            outputs = policy.apply(params, trajectory.observation)
            log_prob = policy.distribution.log_prob(outputs, trajectory.action)
            terms = log_prob * weight + cost * policy.distribution.entropy(outputs)
            return jnp.sum(jnp.where(trajectory.mask, terms, 0.0)) / 4

        moved = jax.tree.map(jnp.subtract, after.actor.params, state.actor.params)
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12),
            moved,
            jax.grad(surrogate)(state.actor.params),
        )


@pytest.mark.slow
def test_one_trace_and_nothing_donated_and_seeds_together_are_the_seeds_alone():
    """Up to the last bits: the width of a batch changes XLA's reductions."""
    learner, init = survivor()
    states = jax.jit(jax.vmap(learner.init))(jax.random.split(jax.random.key(0), 3))
    together, metrics = jax.vmap(functools.partial(train_step, learner))(states)
    assert metrics["episode_return"].shape == (3,)
    diagnostics = {"kl", "policy_std", "explained_variance", "gradient_snr"}
    assert all(np.all(np.isfinite(metrics[name])) for name in diagnostics)
    before = learner_module._jitted_step._cache_size()
    for s, key in enumerate(jax.random.split(jax.random.key(0), 3)):
        state = init(key)
        alone, metrics = train_step(learner, state)
        jax.tree.map(
            lambda x, y, s=s: np.testing.assert_allclose(x[s], y, rtol=1e-4, atol=1e-6),
            together.actor,
            alone.actor,
        )
    again = train_step(learner, state)
    jax.tree.map(np.testing.assert_array_equal, (alone.actor, metrics), (again[0].actor, again[1]))
    train_step(learner, alone)
    assert learner_module._jitted_step._cache_size() == before + 1


@pytest.mark.slow
def test_no_key_is_used_twice():
    with jax.debug_key_reuse(True):
        learner = reinforce(
            Survive(),
            num_episodes=4,
            estimator=value_baseline(0.5),
            update=variants.minibatches(2, 8),
        )
        learner = with_one_start(learner)
        learner = wrappers.in_one_launch(learner)
        state = jax.jit(learner.init)(jax.random.key(0))
        state, _ = train_step(learner, state)
        train_step(learner, state)


class Scattered(Survive):
    """Starts anywhere."""

    def observe(self, key):
        return jax.random.uniform(key, (1,))


@pytest.mark.slow
@pytest.mark.parametrize(("one_start", "shared"), [(True, True), (True, False), (False, True)])
def test_one_start_is_a_seeds_own_and_stays(one_start, shared):
    learner = reinforce(Scattered(), num_episodes=4)
    learner = with_one_start(learner) if one_start else learner
    if shared:
        learner = wrappers.in_one_launch(learner)
    states = jax.jit(jax.vmap(learner.init))(jax.random.split(jax.random.key(0), 3))
    play = jax.jit(jax.vmap(learner.play))
    played = [play(states, jax.random.split(jax.random.key(update), 3)) for update in (1, 2)]
    starts = np.stack([each.observation[:, 0, :, 0] for each in played])  # [2, seeds, episodes]
    assert np.unique(starts).size == (3 if one_start else starts.size)
    if one_start:
        assert np.unique(starts[:, 0]).size == 1


class Breaks(Survive):
    """Leaves the finite numbers at once when ``broken``, which the reset key decides."""

    def __init__(self, broken):
        self.broken = broken

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=jnp.where(self.broken, jnp.nan, after.obs))


@pytest.mark.slow
def test_a_broken_simulation_is_counted_and_stays_in_its_seed():
    @jax.jit
    @jax.vmap
    def step(broken, key):
        learner = reinforce(Breaks(broken), num_episodes=4)
        return learner.step(learner.init(key))

    keys = jax.random.split(jax.random.key(0), 2)
    healthy, metrics = step(jnp.array([False, False]), keys)
    assert np.all(metrics["nonfinite_episodes"] == 0)
    mixed, metrics = step(jnp.array([True, False]), keys)
    np.testing.assert_array_equal(metrics["nonfinite_episodes"], [4, 0])
    for name in ("entropy", "gradient_norm", "kl", "policy_std", "gradient_snr", "weight_std"):
        np.testing.assert_array_equal(np.isfinite(metrics[name]), [False, True], err_msg=name)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[1], y[1]), healthy.actor, mixed.actor)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(mixed.actor))
    np.testing.assert_array_equal(metrics["skipped_update"], [1, 0])  # all of them broke


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_is_skipped():
    estimator = estimators.reward_to_go()
    bad = estimator._replace(update=lambda s, t: (jnp.full_like(t.reward, jnp.nan), s, {}))
    learner = reinforce(Survive(), num_episodes=4, estimator=bad)
    state = jax.jit(learner.init)(jax.random.key(0))
    after, metrics = train_step(learner, state)
    assert int(metrics["skipped_update"]) == 1
    for name in ("entropy", "gradient_norm", "kl"):
        assert np.isnan(metrics[name]), name
    assert counts.to_int(after.num_updates) == 1
    jax.tree.map(np.testing.assert_array_equal, state.actor, after.actor)


@pytest.mark.slow
def test_short_episodes_are_learned_from_in_short(monkeypatch):
    """Of 400 steps at most, where no episode took more than 50: the same, up to rounding."""

    class Ends(Survive):
        max_episode_steps = 400

        def reset(self, rng):
            return super().reset(rng).replace(info=jnp.zeros(()))

        def step(self, state, action):
            count = state.info + 1.0
            done = (count >= 50).astype(jnp.float32)
            return state.replace(reward=jnp.cos(action[0] + count), done=done, info=count)

    learned, branches = [], []
    for many in (2 * 3 * 400, 2 * 3 * 400 + 1):
        monkeypatch.setattr(wrappers, "_MIN_STEPS", many)
        settings = {"optimizer": optax.sgd(1.0), "engine": "vmap"}
        learner = reinforce(Ends(), num_episodes=3, **settings)
        learner = wrappers.short_episodes(learner, Ends.max_episode_steps, num_seeds=2)
        seeds = jax.jit(jax.vmap(learner.init))(jax.random.split(jax.random.key(0), 2))
        program = jax.jit(jax.vmap(learner.step)).lower(seeds)
        branches.append("stablehlo.case" in program.as_text())
        learned.append(jax.tree.map(np.asarray, program.compile()(seeds)[0].actor.params))
    assert branches == [True, False]
    assert np.abs(learned[0]["constants"]).max() > 0
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), *learned)


@pytest.mark.slow
def test_episodes_are_cut_until_a_share_of_the_budget_is_used(monkeypatch):
    """An update learns what one does whose episodes all have that horizon."""
    monkeypatch.setattr(wrappers, "_MIN_STEPS", 0)
    settings = {"num_episodes": 8, "engine": "vmap"}
    settings["policy"] = mlp_policy(2, normal(Drifting.action_space), ())
    cut = wrappers.short_episodes(reinforce(Drifting(), horizon=100, **settings), 100, 1, 50)
    cut = Cut(steps=50, until=0.5)(cut)
    steps = {x: jax.jit(reinforce(Drifting(), horizon=x, **settings).step) for x in (50, 100)}
    first, cut = cut.init(jax.random.key(0)), jax.jit(cut.step)
    played = {}
    for progress, horizon in ((0.0, 50), (0.49, 50), (0.5, 100), (1.0, 100)):
        state = dataclasses.replace(first, progress=jnp.asarray(progress))
        got, metrics = cut(state)
        want, expected = steps[horizon](state)
        played[horizon] = int(metrics["env_steps"])
        assert played[horizon] == int(expected["env_steps"])
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=2e-5, atol=1e-6),
            got.actor,
            want.actor,
        )
    assert played[50] < played[100]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"horizon": 10**12}, r"horizon must be less than 2\^31, got 1000000000000"),
        ({"num_episodes": 2**31}, r"num_episodes must be less than 2\^31, got 2147483648"),
        ({"num_episodes": 2**16, "horizon": 2**16}, "an update may have 4,294,967,296 env steps"),
        ({"estimator": lambda used: estimators.reward_to_go()}, "estimator must be of type"),
        ({"optimizer": jax.nn.relu}, "optimizer must be of type GradientTransformation"),
    ],
)
def test_nonsense_is_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        reinforce(Survive(), **settings)


@pytest.mark.parametrize(
    ("cut", "said"),
    [
        (Cut(0, 0.5), "cut.steps must be at least 1, got 0"),
        (Cut(5, 1.5), r"cut.until must be a share of the budget in \[0, 1\], got 1.5"),
        (Cut(5, -0.1), "cut.until must be 0 or more and finite, got -0.1"),
    ],
)
def test_a_cut_that_makes_no_sense_is_refused(cut, said):
    with pytest.raises(ValueError, match=said):
        cut(reinforce(Survive()))
    for other in (7, ars(Survive())):
        with pytest.raises(ValueError, match="a cut takes a learner of"):
            Cut(5, 0.5)(other)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Brax System")
def test_a_brax_environment_trains():
    """Ours under brax's tools are in test_envs.py."""
    env = brax_envs.get_environment("inverted_pendulum", backend="generalized")
    learner = reinforce(env, num_episodes=8, horizon=30)
    assert learner.engine.name == "native"
    state = learner.init(jax.random.key(0))
    after, metrics = train_step(learner, state)
    assert int(metrics["skipped_update"]) == 0
    assert int(metrics["env_steps"]) > 8
    before, later = (jax.flatten_util.ravel_pytree(s.actor.params)[0] for s in (state, after))
    assert np.all(np.isfinite(later))
    assert np.any(before != later)

"""Actions in any unit: how far a policy explores, and what is played of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from saved_runs import make_run
from toys import Target

import mjx_reinforce as mr
from mjx_reinforce import Box, envs, playing, reinforce
from mjx_reinforce.engine.base import action_space
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.learning.distributions import normal_sigmoid, normal_softplus
from mjx_reinforce.learning.policy import within_bounds
from mjx_reinforce.learning.updates import Clock
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import OF_BUDGETS, OF_TASKS, PRESETS
from mjx_reinforce.setup import build

MIXED = Box(np.array([-3.0, 0.0, -np.inf]), np.array([3.0, 255.0, 1.0]))


class Geared(Target):
    """``Target`` whose actions are in another unit."""

    def __init__(self, unit, middle=0.0):
        self.unit, self.middle = unit, middle
        self.action_space = Box(np.array([middle - unit]), np.array([middle + unit]))

    def earn(self, obs, action):
        return super().earn(obs, (action - self.middle) / self.unit)


def trained(env, **settings):
    """Returns what thirty updates of eight episodes earned."""
    learner, returns = reinforce(env, num_episodes=8, engine="vmap", **settings), []
    state = jax.jit(learner.init)(jax.random.key(0))
    for _ in range(30):
        state, metrics = mr.train_step(learner, state)
        returns.append(float(metrics["episode_return"]))
    return np.array(returns)


@pytest.mark.slow
def test_training_is_the_same_in_every_unit():
    """But for the rounding of the logarithm of the deviation."""
    expected = trained(Geared(1.0))
    assert np.mean(expected[-5:]) > np.mean(expected[:5])
    np.testing.assert_allclose(trained(Geared(2.0**14)), expected, rtol=1e-3)
    np.testing.assert_allclose(trained(Geared(2.0**-10)), expected, rtol=1e-3)


@pytest.mark.slow
def test_a_gripper_learns():
    """Its actions are from 0 to 255."""
    np.testing.assert_allclose(trained(Geared(127.5, 127.5)), trained(Geared(1.0)), atol=1e-3)


@pytest.mark.parametrize(
    "family", [mr.normal, normal_softplus, normal_sigmoid, mr.truncated_normal]
)
def test_the_default_deviation_is_a_share_of_each_range(family):
    bounded = Box(MIXED.low[:2], MIXED.high[:2])
    space = bounded if family is mr.truncated_normal else MIXED
    made = family(space)
    fresh = jnp.array([0.0] * made.num_outputs + list(made.constants))
    expected = np.array([1.5, 63.75, 0.5])[: len(space.low)]
    if family is normal_sigmoid:
        expected = np.full(len(space.low), 0.5)  # it stays below 1
    np.testing.assert_allclose(made.std(fresh), expected, rtol=1e-5)


def test_a_deviation_of_each_entry():
    made = mr.normal(MIXED, initial_std=[0.1, 20.0, 3.0])
    np.testing.assert_allclose(np.exp(made.constants), [0.1, 20.0, 3.0])
    with pytest.raises(ValueError, match=r"a number, or \[3\], one for each entry, got \[1, 2\]"):
        mr.normal(MIXED, initial_std=[1, 2])
    with pytest.raises(ValueError, match="initial_std must be positive and finite, got 0"):
        mr.normal(MIXED, initial_std=[1.0, 0.0, 2.0])


def test_no_task_of_ours_trains_otherwise():
    """Those whose half range is not 1 have a deviation in their own table."""
    tuned = {task for task, settings in OF_TASKS.items() if "initial_std" in settings}
    checked = 0
    for task in (OF_TASKS | OF_BUDGETS).keys() & set(envs.names()):
        space = action_space(envs.make(task))
        if isinstance(space, Box) and not np.all(space.high - space.low == 2):
            assert task in tuned, task
            checked += 1
    assert checked >= 3
    continuous = [c for _, c in PRESETS.values() if c.policy not in ("auto", "categorical")]
    assert all(config.initial_std is not None for config in continuous)


def fixed_family(space, *, initial_std, rescale):
    """A user's own, which needs a number."""
    assert rescale
    return mr.normal(space, initial_std=float(initial_std))


def test_the_setting_in_words_and_in_own_families():
    assert Config().initial_std is None
    described = build.policy_settings(Geared(8.0), Config(env="Geared-v0"))
    assert np.exp(build_policy(described).distribution.constants) == pytest.approx(4.0)
    own = described | {"policy": f"{__name__}:fixed_family"}
    assert np.exp(build_policy(own).distribution.constants) == pytest.approx(4.0)
    kept = described | {"initial_std": 0.5}  # as runs of earlier versions say it
    assert np.exp(build_policy(kept).distribution.constants) == pytest.approx(0.5)


def test_a_saved_policy_says_how_many_observations_it_sees():
    """A robot's program has to keep them."""
    env = Geared(8.0)
    config = Config(env="Geared-v0")
    assert build.policy_settings(env, config)["frames"] == 1
    env.frames = 3
    assert build.policy_settings(env, config)["frames"] == 3


def test_the_noise_of_every_entry_shrinks_to_the_final_one():
    env = Target()
    env.action_space = Box(np.array([-8.0, -1.0]), np.array([8.0, 1.0]))
    config = Config(final_std=0.25, decay_steps=10, optimizer="sgd")
    optimizer = build._build_optimizer(config, env.action_space)
    params = {"network": jnp.zeros(2), "constants": jnp.log(jnp.array([4.0, 0.5]))}
    clock = Clock(jnp.zeros(()), jnp.asarray(10.0))
    changes, _ = optimizer.update(
        jax.tree.map(jnp.zeros_like, params), optimizer.init(params), params, clock=clock
    )
    np.testing.assert_allclose(np.exp(params["constants"] + changes["constants"]), 0.25, rtol=1e-5)


class Paid(Target):
    """The reward is the action."""

    def earn(self, obs, action):
        return action[0]


def far_out(policy):
    """Returns a policy whose mean is 3, beyond the bound at 1."""

    def init(key):
        params = policy.init(key)
        layer = params["network"]["params"]["Dense_0"]
        network = {
            "params": {"Dense_0": {"kernel": 0 * layer["kernel"], "bias": layer["bias"] + 3}}
        }
        return params | {"network": network}

    return policy._replace(init=init)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["reinforce", "ars"])
def test_evaluations_are_clipped_and_training_is_not(algorithm):
    family = mr.normal if algorithm == "reinforce" else mr.deterministic
    policy = far_out(mr.mlp_policy(1, family(Paid.action_space), ()))
    if algorithm == "reinforce":
        learner = reinforce(Paid(), policy=policy, num_episodes=8, engine="vmap")
    else:
        learner = mr.ars(Paid(), policy=policy, num_directions=4, engine="vmap")
    state = jax.jit(learner.init)(jax.random.key(0))
    _, metrics = mr.train_step(learner, state)
    assert metrics["episode_return"] > 2
    played = mr.evaluate(Paid(), learner, state.actor, jax.random.key(1), num_episodes=4, horizon=1)
    assert played["eval_return"] == 1
    assert played["eval_return_stochastic"] > 2  # with noise as in training


def test_what_is_loaded_plays_within_the_bounds(tmp_path):
    """Drawn or not, in one observation or many, and in a film."""
    run = make_run(tmp_path, "InvertedPendulum-v5", action_low=[-0.02], action_high=[0.03])
    player = mr.load(run)
    observations = np.random.default_rng(0).normal(size=(64, 4)) * 30
    for rng in (None, np.random.default_rng(0)):
        actions = player.act(observations, rng)
        assert actions.dtype == np.float32
        low, high = np.float32(-0.02), np.float32(0.03)
        assert np.all((actions >= low) & (actions <= high))
        assert np.any((actions == low) | (actions == high))
    policy, actor = mr.load_policy(run / "policy", 0)
    mode = policy.distribution.mode(mr.act(policy, actor, observations))
    assert np.abs(mode).max() <= np.float32(0.03)


@pytest.mark.slow
def test_films_are_clipped():
    """Also with noise, in our simulation as in C MuJoCo, which asks the player."""
    env = envs.make("InvertedPendulum-v5")
    policy = mr.mlp_policy(4, mr.normal(env.action_space, initial_std=50.0), ())
    policy = within_bounds(policy, env.action_space)
    seen = []

    def step(state, action):
        jax.debug.callback(lambda x: seen.append(np.array(x)), action)
        return type(env).step(env, state, action)

    class Watching:
        action_space, action_size, reset = env.action_space, 1, env.reset

    watching = Watching()
    watching.step = step
    actor = reinforce(env, policy=policy, engine="vmap").init(jax.random.key(0)).actor
    player = mr.Player("InvertedPendulum-v5", 0, policy, actor)
    playing.simulator(watching, player, 5)(0, True)
    jax.effects_barrier()
    assert seen
    assert np.abs(seen).max() == 3


def test_what_has_no_bounds_is_not_clipped():
    space = Box(np.full(1, -np.inf), np.full(1, np.inf))
    policy = mr.mlp_policy(1, mr.normal(space), ())
    assert within_bounds(policy, space) is policy

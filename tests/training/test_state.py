"""The compiled programs of a run."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from one_slot import compile_run
from toys import Toy

from mjx_reinforce import envs
from mjx_reinforce.engine import counts
from mjx_reinforce.engine.base import plain
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup import ready
from mjx_reinforce.training.state import seed_keys

CONFIG = Config(env="CartPole-v1", num_seeds=2, num_episodes=4, env_steps=400, eval_episodes=2)


@pytest.fixture(scope="module")
def prepared():
    """A run of CartPole that is ready."""
    return ready.build_ready(envs.make(CONFIG.env), CONFIG)


def test_the_keys_of_seeds_are_those_of_a_split():
    """Whichever of them are asked for, and however many there are."""
    root = jax.random.fold_in(jax.random.key(7), 0)
    split = jax.random.key_data(jax.random.split(root, 9))
    keys = seed_keys(7, np.array([2, 8], np.uint32))
    np.testing.assert_array_equal(jax.random.key_data(keys), split[np.array([2, 8])])


@pytest.mark.slow
def test_they_have_run_once_without_an_update(prepared):
    """A GPU's driver translates kernels when they first run: that is compiling too."""
    made = []

    def advance(*arguments):
        rows, metrics, eval_metrics = prepared.programs().advance(*arguments)
        jax.debug.callback(lambda x: made.append(int(x.sum())), metrics["active"])
        return rows, metrics, eval_metrics

    slots = compile_run(prepared.programs()._replace(advance=advance), CONFIG)
    jax.effects_barrier()
    assert made == [0]
    assert not slots.states().train_states.env_steps.any()
    slots.advance()
    jax.effects_barrier()
    assert made[1] > 0


@pytest.mark.slow
def test_evaluations_ride_with_the_updates_that_follow(prepared):
    """They measure the policies before these, and leave what is trained as it is, to the bit."""
    assert prepared.engine == "native"
    assert prepared.programs().advance_evaluates
    slots = compile_run(prepared.programs(), CONFIG)
    first, alone = slots.states(), slots.evaluate().eval_metrics
    [(_, metrics, eval_metrics)], one = slots.advance(), slots.states()
    slots.restore(first)
    [(_, same, none)], other = slots.advance(evaluate=False), slots.states()
    assert none == {}
    assert np.all(metrics.pop("simulated_steps")[0] > same.pop("simulated_steps")[0])
    jax.tree.map(np.testing.assert_array_equal, (plain(one), metrics), (plain(other), same))
    for name in ("eval_return", "eval_return_stochastic", "eval_length", "eval_steps"):
        np.testing.assert_array_equal(eval_metrics[name], alone[name])
    made = metrics["active"].sum(axis=0)
    assert counts.to_int(one.train_states.num_updates).tolist() == made.tolist()


def test_a_seed_begins_alike_whichever_begin_with_it():
    """So do the seeds that a process has, and those of a slot."""
    config = dataclasses.replace(LUCK, num_seeds=4, test_episodes=6)
    begin = jax.jit(ready.build_ready(Luck(), config).programs().begin)
    every, all_keys = begin(3, np.arange(4, dtype=np.uint32), {})
    some, keys = begin(3, np.array([2, 0], np.uint32), {})
    assert np.array_equal(some, every[np.array([2, 0])])
    assert keys.shape == (3, 2, 2)
    assert np.array_equal(keys, all_keys[:, [2, 0]])


class Luck(Toy):
    """The return is the start, whatever is done: its mean is 0, and every policy is equal."""

    def observe(self, key):
        return jax.random.uniform(key, (1,), minval=-1.0)

    def earn(self, obs, action):
        return obs[0]


LUCK = Config(env="Luck-v0", num_seeds=3, hidden_sizes=(), eval_episodes=2, test_episodes=5)


@functools.cache
def evaluations(**changes):
    """Returns what settings evaluate to before and after an update, and what they test to."""
    config = dataclasses.replace(LUCK, **changes)
    slots = compile_run(ready.build_ready(Luck(), config).programs(), config)
    [first], later = slots.advance(), slots.evaluate()
    return first.eval_metrics, later.eval_metrics, slots.test(slots.states().train_states.actor)


@pytest.mark.slow
def test_each_seed_is_evaluated_and_tested_on_starts_of_its_own_whatever_is_trained():
    first, second, test = (result["eval_return"] for result in evaluations())
    assert len({*first.tolist(), *test.tolist()}) == 6
    assert np.array_equal(first, second)  # the same at every evaluation
    changed = evaluations(num_seeds=5, seed=7, learning_rate=0.5, hidden_sizes=(3,))
    for one, other in zip(evaluations(), changed, strict=True):
        assert np.array_equal(one["eval_return"], other["eval_return"][:3])


@pytest.mark.slow
def test_a_test_plays_whole_evaluations_from_starts_of_their_own():
    tests = [
        evaluations(**changes)[2] for changes in ({"test_episodes": None}, {}, {"test_episodes": 6})
    ]
    assert [int(test["eval_steps"][0]) for test in tests] == [2 * n for n in (2, 6, 6)]
    for name in ("eval_return", "eval_return_stochastic", "eval_length"):
        assert np.array_equal(tests[1][name], tests[2][name])
    assert not np.isin(tests[0]["eval_return"], tests[2]["eval_return"]).any()


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_training_is_cut_for_a_share_of_the_budget_and_evaluations_never(share):
    """These play to the time limit, and ride where training comes to do that, too."""
    config = dataclasses.replace(
        CONFIG, num_seeds=1, env_steps=800, train_horizon=8, whole_after=share, eval_every=1
    )
    prepared = ready.build_ready(envs.make(config.env), config)
    assert prepared.horizon == 500
    assert prepared.programs().advance_evaluates == (share < 1)
    slots, steps, cut, whole = compile_run(prepared.programs(), config), 0, [], []
    while steps < config.env_steps:
        [(_, metrics, eval_metrics)] = slots.advance()
        lengths = cut if steps < share * config.env_steps else whole
        lengths.append(float(metrics["episode_length"].max()))
        assert np.all(eval_metrics["eval_length"] > 8)
        steps = int(counts.to_int(slots.states().train_states.env_steps)[0])
    assert max(cut) == 8
    assert bool(whole) == (share < 1)
    assert all(length > 8 for length in whole)


def test_a_cut_after_the_time_limit_is_none():
    """So a task that cuts its episodes by default takes any ``--horizon``."""
    config = dataclasses.replace(CONFIG, horizon=20, train_horizon=100)
    prepared = ready.build_ready(envs.make(CONFIG.env), config)
    assert prepared.horizon == 20
    assert prepared.programs().advance_evaluates

"""The terms of a reward: the same in every engine, and nothing where there are none."""

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act, assert_same_episodes, both, played
from toys import Drifting, Paid, PaidState

from mjx_reinforce import envs
from mjx_reinforce.engine.base import term_names
from mjx_reinforce.engine.play import available, native, rollouts

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


class PaidOnce(Paid):
    names = ("reward_speed",)


def assert_paid(episodes):
    """The terms add up to the reward, step by step; after the end there are none."""
    assert [*episodes.terms] == ["reward_effort", "reward_speed"]
    np.testing.assert_allclose(sum(episodes.terms.values()), episodes.reward, atol=1e-6)
    for term in episodes.terms.values():
        assert np.all(term[~episodes.mask] == 0)
        assert np.any(term != 0)


def test_terms_add_up_to_the_reward_in_machine_code():
    env = Paid()
    got, want = both(env, actor_and_act(env, (4,)), horizon=100, num_episodes=9)
    assert got.nonfinite.any()
    assert not got.nonfinite.all()
    assert_same_episodes(got, want, rounding=2e-5)
    assert_paid(got)


def test_terms_add_up_to_the_reward_in_a_thread_of_a_gpu(monkeypatch):
    env = Paid()
    player = actor_and_act(env, (4,))
    want = played(rollouts.vmap_rollout, env, player, horizon=100)
    gpu_on_cpu.emulate(monkeypatch, 3)
    got = played(native.native_rollout, env, player, horizon=100)
    assert_same_episodes(got, want, rounding=2e-5)
    assert_paid(got)


def test_parts_of_episodes_have_their_terms():
    env = Paid()
    episodes = played(rollouts.vmap_rollout, env, actor_and_act(env, ()), num_seeds=1)
    one = jax.tree.map(lambda x: x[0], episodes)
    assert one.first(7).terms["reward_speed"].shape == (7, 5)
    part = one.episodes(slice(1, 3)).terms["reward_effort"]
    np.testing.assert_array_equal(part, one.terms["reward_effort"][:, 1:3])


def test_terms_are_named_in_the_order_of_the_task():
    assert term_names(Paid()) == ("reward_speed", "reward_effort")
    expected = ("reward_forward", "reward_ctrl", "reward_survive")
    assert term_names(envs.make("Hopper-v5")) == expected


def test_a_single_term_is_the_reward_and_not_recorded():
    env = PaidOnce()
    assert term_names(env) == term_names(Drifting()) == ()
    got, want = both(env, actor_and_act(env, ()), horizon=10)
    assert got.terms == want.terms == {}


@pytest.mark.parametrize(
    "metrics",
    [
        None,
        jnp.zeros(2),
        {0: jnp.zeros(()), 1: jnp.zeros(())},
        {"reward_a": jnp.zeros(()), "reward_b": jnp.zeros(3)},
        {"reward_a": {"inner": jnp.zeros(())}, "reward_b": jnp.zeros(())},
    ],
)
def test_metrics_of_another_kind_are_no_terms(metrics):
    class Own(Drifting):
        def reset(self, rng):
            state = super().reset(rng)
            return PaidState(state.obs, state.reward, state.done, state.info, metrics)

    assert term_names(Own()) == ()

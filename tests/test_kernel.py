"""The kernel plays the same episodes as `rollouts.rollout`; here in Pallas's interpreter."""

import contextlib
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act, assert_same_episodes
from toys import Chain, Survive, ToyState, categorical

from mjx_reinforce import envs, fused
from mjx_reinforce.engines import kernel, rollouts

HORIZON = 24  # one chunk; a fresh pendulum falls after 6 to 30 steps


@pytest.fixture(scope="module")
def pendulum():
    return envs.make("InvertedPendulum-v5")


@pytest.mark.parametrize("hidden_sizes", [(5, 6), (7, 5, 6)])
def test_same_episodes_as_every_engine(pendulum, hidden_sizes):
    actor, act, distribution = actor_and_act(pendulum, hidden_sizes)
    step = fused.vmap(pendulum.step, in_axes=-1, out_axes=-1)
    settings: dict[str, Any] = {"num_episodes": 37, "horizon": HORIZON, "num_deterministic": 5}
    play = functools.partial(kernel.rollout, pendulum, act, interpret=True, **settings)
    expect = functools.partial(rollouts.rollout, pendulum, act, env_step=step, **settings)
    key = jax.random.key(3)
    got = jax.jit(lambda actor, key: play(actor, distribution, key))(actor, key)
    want = jax.jit(lambda actor, key: expect(actor, distribution, key))(actor, key)
    assert not want.mask[-1].all()
    assert_same_episodes(got, want, rounding=2e-5)


def test_seeds_and_chunks_are_independent():
    env = Survive()
    actors = [actor_and_act(env, (5,), seed) for seed in range(2)]
    _, act, distribution = actors[0]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(actor for actor, _, _ in actors))
    keys = jax.random.split(jax.random.key(1), 2)
    settings: dict[str, Any] = {"num_episodes": 33, "horizon": 106}  # 53 chunks of 2

    def play(actor, key):
        return kernel.rollout(env, act, actor, distribution, key, interpret=True, **settings)

    def expect(actor, key):
        return rollouts.rollout(env, act, actor, distribution, key, **settings)

    got = jax.jit(jax.vmap(play))(stacked, keys)
    want = jax.jit(jax.vmap(expect))(stacked, keys)
    assert_same_episodes(got, want, rounding=1e-6)
    assert not np.any(got.action[:, -1])


def test_actions_may_be_integers():
    env = Chain()
    actor, act, distribution = actor_and_act(env, (4,), distribution=categorical(2))
    settings: dict[str, Any] = {"num_episodes": 9, "horizon": 3}
    key = jax.random.key(0)
    got = kernel.rollout(env, act, actor, distribution, key, interpret=True, **settings)
    want = rollouts.rollout(env, act, actor, distribution, key, **settings)
    assert got.action.dtype == want.action.dtype
    assert_same_episodes(got, want, rounding=1e-6)


class Breaks(Survive):
    """The reward is infinite once the action is beyond the threshold."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=1 / (1 - after.done), done=jnp.zeros(()))


def test_nonfinite_episodes_end():
    env = Breaks()
    actor, act, distribution = actor_and_act(env, ())
    settings: dict[str, Any] = {"num_episodes": 9, "horizon": 8}
    key = jax.random.key(0)
    got = kernel.rollout(env, act, actor, distribution, key, interpret=True, **settings)
    want = rollouts.rollout(env, act, actor, distribution, key, **settings)
    assert want.nonfinite.any()
    assert_same_episodes(got, want, rounding=1e-6)


def pretended_gpu():
    """From JAX 0.11 on, Triton's lowering wants to know the GPU."""
    device = getattr(jax.sharding, "AbstractDevice", None)
    if device is None:
        return contextlib.nullcontext()
    h200 = device(device_kind="NVIDIA H200", num_cores=132, platform="cuda")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=h200)
    return jax.sharding.use_abstract_mesh(mesh)


def test_lowers_for_nvidia_gpus(pendulum):
    actor, act, distribution = actor_and_act(pendulum, (64, 64))
    assert kernel.unsupported(pendulum, act, actor, distribution) is None

    def play(actor, key):
        return kernel.rollout(
            pendulum, act, actor, distribution, key, num_episodes=300, horizon=HORIZON
        )

    with pretended_gpu():
        traced = jax.jit(play).trace(actor, jax.random.key(0))
        lowered = traced.lower(lowering_platforms=("cuda",))
    assert "triton" in lowered.as_text()


class Pays(Survive):
    """Pays what it was built with."""

    def __init__(self, price):
        self.price = price

    def step(self, state, action):
        return super().step(state, action).replace(reward=self.price)


def test_a_traced_value_in_the_environment_is_not_supported():
    def reason(price):
        env = Pays(price)
        actor, act, distribution = actor_and_act(env, ())
        reasons.append(kernel.unsupported(env, act, actor, distribution))
        return price

    reasons = []
    jax.vmap(reason)(jnp.ones(2))
    reason(jnp.ones(()))
    assert "JAX is tracing" in reasons[0]
    assert reasons[1] is None


class Flagged(Survive):
    """Its state has a bool."""

    def reset(self, rng):
        return ToyState(jnp.zeros(1), jnp.zeros(()), jnp.zeros(()), jnp.zeros((), bool))


def test_says_what_it_does_not_support():
    env = Flagged()
    actor, act, distribution = actor_and_act(env, ())
    reason = kernel.unsupported(env, act, actor, distribution)
    assert reason is not None
    assert "info is bool" in reason
    with pytest.raises(ValueError, match="info is bool"):
        kernel.rollout(env, act, actor, distribution, jax.random.key(0), num_episodes=2, horizon=2)

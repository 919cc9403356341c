"""Anybody's network plays: flax, nnx, plain functions, one's own distribution; on every engine."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen, nnx
from toys import Drifting

from mjx_reinforce import Box, Discrete, envs, make_vec, normal, rollout, unroll
from mjx_reinforce.engines import any_policy, choice
from mjx_reinforce.policies.distributions.categorical import categorical

KEY = jax.random.key(0)


def plain(inner, outputs):
    """Parameters of a network of two hidden layers, and the network."""

    def init(size):
        keys = jax.random.split(KEY, 3)
        sizes = [(size, inner), (inner, inner), (inner, outputs)]
        return [jax.random.normal(k, s) / s[0] ** 0.5 for k, s in zip(keys, sizes, strict=True)]

    def act(params, observation):
        first, second, last = params
        return jnp.tanh(jnp.tanh(observation @ first) @ second) @ last

    return init, act


class Linen(linen.Module):
    outputs: int

    @linen.compact
    def __call__(self, x):
        return linen.Dense(self.outputs)(linen.relu(linen.Dense(8)(linen.swish(linen.Dense(8)(x)))))


class Nnx(nnx.Module):
    def __init__(self, size, outputs, rngs):
        self.first = nnx.Linear(size, 8, rngs=rngs)
        self.last = nnx.Linear(8, outputs, rngs=rngs)

    def __call__(self, x):
        return self.last(nnx.gelu(self.first(x)))


@jax.tree_util.register_pytree_node_class
class Network:
    """A network that is its own parameters, as a module of equinox is."""

    def __init__(self, weights, activation):
        self.weights, self.activation = weights, activation

    def __call__(self, x):
        *inner, last = self.weights
        for weights in inner:
            x = self.activation(x @ weights)
        return x @ last

    def tree_flatten(self):
        return (self.weights,), self.activation

    @classmethod
    def tree_unflatten(cls, activation, children):
        return cls(*children, activation)


def policies(size, outputs):
    init, act = plain(8, outputs)
    module = Linen(outputs)
    graph, state = nnx.split(Nnx(size, outputs, nnx.Rngs(0)))
    return {
        "plain": (act, init(size)),
        "linen": (module.apply, module.init(KEY, jnp.zeros(size))),
        "nnx": (lambda state, x: nnx.merge(graph, state)(x), state),
        "callable": (lambda network, x: network(x), Network(init(size), jnp.tanh)),
    }


@pytest.mark.parametrize("kind", ["plain", "linen", "nnx", "callable"])
@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "CartPole-v1"])
def test_every_engine_plays_every_policy(env_id, kind):
    env = envs.make(env_id)
    space = env.action_space
    distribution = categorical(space) if isinstance(space, Discrete) else normal(space)
    size = env.observation_size
    act, params = policies(size, distribution.num_outputs)[kind]
    if distribution.constants:
        network = act
        act = lambda p, x: jnp.append(network(p, x), jnp.asarray(distribution.constants))  # noqa: E731
    played = {
        engine: jax.jit(
            functools.partial(
                rollout, env, act, distribution=distribution, num_episodes=5, horizon=30,
                engine=engine,
            )
        )(params, key=KEY)
        for engine in ("auto", "vmap")
    }  # fmt: skip
    auto, vmap = played["auto"], played["vmap"]
    np.testing.assert_array_equal(auto.mask, vmap.mask)
    np.testing.assert_allclose(auto.reward, vmap.reward, atol=1e-3)
    np.testing.assert_allclose(auto.observation, vmap.observation, atol=1e-3)


def test_an_equinox_module_plays_as_the_document_writes_it():
    """docs/vector.md; a module filtered by ``partition`` has None where its functions were."""
    eqx = pytest.importorskip("equinox")
    env = envs.make("InvertedPendulum-v5")
    model = eqx.nn.MLP(4, 2, width_size=8, depth=2, activation=jnp.tanh, key=KEY)
    params, static = eqx.partition(model, eqx.is_array)
    play = functools.partial(
        rollout, env, lambda params, x: eqx.combine(params, static)(x),
        distribution=normal(env.action_space), num_episodes=5, horizon=30,
    )  # fmt: skip
    played = {
        engine: jax.jit(functools.partial(play, engine=engine))(params, key=KEY)
        for engine in ("auto", "native", "vmap")
    }
    np.testing.assert_array_equal(played["auto"].observation, played["native"].observation)
    np.testing.assert_array_equal(played["auto"].mask, played["vmap"].mask)
    np.testing.assert_allclose(played["auto"].observation, played["vmap"].observation, atol=1e-3)


def test_a_large_policy_plays_on_machine_code_of_the_env_step(monkeypatch):
    env = envs.make("InvertedPendulum-v5")
    init, act = plain(128, 2)
    params = init(4)
    chosen = []
    monkeypatch.setattr(choice, "choose", lambda *args: chosen.append(args))
    play = functools.partial(
        rollout, env, act, distribution=normal(env.action_space), num_episodes=7, horizon=40
    )
    got = jax.jit(play)(params, key=KEY)
    assert not chosen
    monkeypatch.undo()
    want = jax.jit(functools.partial(play, engine="vmap"))(params, key=KEY)
    np.testing.assert_array_equal(got.mask, want.mask)
    np.testing.assert_allclose(got.observation, want.observation, atol=1e-3)


def test_what_machine_code_cannot_play():
    space = Box(np.array([-3.0]), np.array([1.0]))
    env, distribution = Drifting(space), normal(space)

    def act(params, observation):
        return jnp.fft.fft(observation).real[:2] * params

    play = functools.partial(rollout, env, act, 1.0, distribution, KEY, num_episodes=2, horizon=4)
    assert play().mask.shape == (4, 2)
    with pytest.raises(ValueError, match=r"fft.*test_any_policy.py"):
        play(engine="native")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"act": 1}, "act must be a function"),
        ({"distribution": "normal"}, "distribution"),
        ({"num_episodes": 0}, "num_episodes"),
        ({"horizon": 0}, "horizon"),
        ({"engine": "best"}, "engine"),
        ({"key": 1}, "random key"),
    ],
)
def test_bad_arguments(change, message):
    env = envs.make("InvertedPendulum-v5")
    right = {
        "act": plain(4, 2)[1],
        "actor": plain(4, 2)[0](4),
        "distribution": normal(env.action_space),
        "key": KEY,
        "num_episodes": 1,
        "horizon": 2,
    }
    with pytest.raises(ValueError, match=message):
        any_policy.rollout(env, **(right | change))


def test_outputs_that_are_not_the_distributions():
    vec = make_vec("InvertedPendulum-v5", 2)
    state, family = vec.reset(KEY), normal(vec.action_space)
    message = r"must return \[2\] outputs of one observation: 1 that a network computes, .* \[1\]"
    act = lambda params, x: x[:1]  # noqa: E731
    with pytest.raises(ValueError, match=message):
        unroll(vec, act, None, family, state, KEY, 3)
    with pytest.raises(ValueError, match=message):
        rollout(vec.env, act, None, family, KEY, num_episodes=2, horizon=3)
    with pytest.raises(ValueError, match=r"pass its env, vec\.env"):
        rollout(vec, act, None, family, KEY, num_episodes=2, horizon=3)
    with pytest.raises(ValueError, match="vec must be"):
        unroll(vec.env, act, None, family, state, KEY, 3)


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_segments_go_on(autoreset):
    """Two of 20 steps are one of 40; what they say fits together."""
    env = envs.make("InvertedPendulum-v5")
    distribution = normal(env.action_space)
    init, act = plain(16, 2)
    params = init(4)
    vec = make_vec(env, 6, autoreset=autoreset, max_episode_steps=12)

    @functools.partial(jax.jit, static_argnums=2)
    def play(state, key, num_steps):
        return unroll(vec, act, params, distribution, state, key, num_steps)

    start = vec.reset(KEY)
    keys = jax.random.split(jax.random.key(4))
    between, first = play(start, keys[0], 20)
    _, second = play(between, keys[1], 20)
    np.testing.assert_array_equal(second.observation[0], between.obs)
    np.testing.assert_array_equal(second.log_prob.shape, (20, 6))
    outputs = jax.vmap(jax.vmap(act, (None, 0)), (None, 0))(params, first.observation)
    np.testing.assert_allclose(
        first.log_prob, distribution.log_prob(outputs, first.action), rtol=1e-5
    )
    goes_on = ~np.asarray(first.done[:-1])
    np.testing.assert_array_equal(
        np.asarray(first.next_observation[:-1])[goes_on], np.asarray(first.observation[1:])[goes_on]
    )
    assert np.any(first.truncated)
    assert np.any(first.terminated)
    reset_steps = np.asarray(first.done[:-1]) if autoreset == "next_step" else np.zeros((19, 6))
    np.testing.assert_array_equal(first.played[1:], reset_steps == 0)

"""Machine code takes the step that plain MJX takes: limits, high speeds and falls included."""

import functools
import warnings

import golden
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen, nnx
from players import actor_and_act
from toys import Drifting

from mjx_reinforce import Box, Discrete, make_vec, normal, rollout, unroll
from mjx_reinforce.engine.play import available, choice
from mjx_reinforce.engine.play import choice as engines
from mjx_reinforce.engine.scalar import writing_out
from mjx_reinforce.learning.distributions import categorical
from mjx_reinforce.learning.policy import MLP


def test_a_jax_that_multiplies_wrongly_is_told(monkeypatch):
    """Where all is left to it."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())
    policy = engines.ActingPolicy(act, actor, distribution)
    cases = ("vmap", "0.10.2", True), ("native", "0.10.2", False), ("vmap", "0.11.2", False)
    for name, version, told in cases:
        monkeypatch.setattr(jax, "__version__", version)
        with warnings.catch_warnings(record=True) as met:
            warnings.simplefilter("always")
            engines.choose(name, env, policy, 2)
        assert [str(x.message)[:10] for x in met] == ["JAX 0.10.2"] * told


# -------------------------------------------------------------------------------------------------
# An update of each engine is that of its golden file: the mathematics changes on purpose alone.

#: Of the greatest value of an array. The engines differ by 1e-6, for each rounds in its own order,
#: as versions of JAX and XLA's flags do; a discount of 0.985 in place of 0.99 changes 5e-2.
_ROUNDING = 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("engine", golden.ENGINES)
def test_an_update_is_as_it_was(engine):
    if engine == "native" and (reason := available.unavailable()):
        pytest.skip(reason)
    got = golden.updated(engine)
    with np.load(golden.FOLDER / f"{engine}.npz", allow_pickle=False) as want:
        assert sorted(got) == sorted(want.files)
        for name in want.files:
            atol = _ROUNDING * max(np.abs(want[name]).max(), 1e-6)
            np.testing.assert_allclose(got[name], want[name], rtol=0, atol=atol, err_msg=name)


def test_the_engines_make_the_same_update():
    """The files too: one that a broken engine wrote would differ from the other."""
    native, vmap = (np.load(golden.FOLDER / f"{engine}.npz") for engine in ("native", "vmap"))
    assert np.abs(vmap["params"]).max() > 1e-3
    for name in vmap.files:
        atol = _ROUNDING * max(np.abs(vmap[name]).max(), 1e-6)
        np.testing.assert_allclose(native[name], vmap[name], rtol=0, atol=atol, err_msg=name)


# -------------------------------------------------------------------------------------------------
# Anybody's network plays: flax, nnx, plain functions; one of a module that filters its leaves.

KEY = jax.random.key(0)


def plain(inner, outputs):
    """Parameters of a network of two hidden layers, and the network."""

    def init(size):
        keys = jax.random.split(KEY, 3)
        sizes = [(size, inner), (inner, inner), (inner, outputs)]
        weights = [jax.random.normal(k, s) / s[0] ** 0.5 for k, s in zip(keys, sizes, strict=True)]
        return [*weights, None]  # as equinox's ``partition`` leaves it

    def act(params, observation):
        first, second, last, _ = params
        return jnp.tanh(jnp.tanh(observation @ first) @ second) @ last

    return init, act


def layered(weights, x):
    for weight in weights[:-1]:
        x = jnp.tanh(x @ weight)
    return x @ weights[-1]


def policies(size, outputs):
    init, act = plain(8, outputs)
    module = linen.Sequential([linen.Dense(8), linen.swish, linen.Dense(8), linen.Dense(outputs)])
    rngs = nnx.Rngs(0)
    layers = nnx.Linear(size, 8, rngs=rngs), nnx.gelu, nnx.Linear(8, outputs, rngs=rngs)
    graph, state = nnx.split(nnx.Sequential(*layers))
    return {
        "plain": (act, init(size)),
        "linen": (module.apply, module.init(KEY, jnp.zeros(size))),
        "nnx": (lambda state, x: nnx.merge(graph, state)(x), state),
        # A network that is its own parameters, as a module of equinox is.
        "callable": (lambda network, x: network(x), jax.tree_util.Partial(layered, init(size)[:3])),
    }


def compared(play, engine):
    """The mask of what an engine plays, whose episodes are those of vmap."""
    got, want = (
        jax.jit(functools.partial(play, engine=name))(key=KEY) for name in (engine, "vmap")
    )
    np.testing.assert_array_equal(got.mask, want.mask)
    np.testing.assert_allclose(got.reward, want.reward, atol=1e-3)
    np.testing.assert_allclose(got.observation, want.observation, atol=1e-3)
    return got.mask


@pytest.mark.parametrize("kind", ["plain", "linen", "nnx", "callable"])
def test_machine_code_plays_every_policy(kind):
    space = Discrete(3) if kind in ("plain", "nnx") else Box(np.array([-3.0]), np.array([1.0]))
    distribution = categorical(space) if isinstance(space, Discrete) else normal(space)
    act, params = policies(2, distribution.num_outputs)[kind]
    constants = jnp.asarray(distribution.constants)
    full = lambda p, x: jnp.append(act(p, x), constants)  # noqa: E731
    play = functools.partial(
        rollout, Drifting(space), full, params, distribution, num_episodes=5, horizon=30
    )
    compared(play, "native")


def test_a_large_policy_plays_on_machine_code_of_the_env_step(monkeypatch):
    env = Drifting()
    init, act = plain(128, 2)
    chosen, choose = [], choice.choose
    monkeypatch.setattr(choice, "choose", lambda *x: chosen.append(x[0]) or choose(*x))
    play = functools.partial(
        rollout, env, act, init(2), normal(env.action_space), num_episodes=7, horizon=40
    )
    assert not compared(play, "auto").all()
    assert chosen == ["vmap"]


def test_what_machine_code_cannot_play():
    space = Box(np.array([-3.0]), np.array([1.0]))
    env, distribution = Drifting(space), normal(space)

    def act(params, observation):
        return jnp.fft.fft(observation).real[:2] * params

    play = functools.partial(rollout, env, act, 1.0, distribution, KEY, num_episodes=2, horizon=4)
    assert play().mask.shape == (4, 2)
    with pytest.raises(ValueError, match=r"fft.*test_engines.py"):
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
    env = Drifting()
    right = {
        "act": plain(4, 2)[1],
        "actor": plain(4, 2)[0](2),
        "distribution": normal(env.action_space),
        "key": KEY,
        "num_episodes": 1,
        "horizon": 2,
    }
    with pytest.raises(ValueError, match=message):
        choice.rollout(env, **(right | change))


def test_outputs_that_are_not_the_distributions():
    vec = make_vec(Drifting(), 2)
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


@pytest.mark.slow
@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_segments_go_on(autoreset):
    """Two of 20 steps are one of 40; what they say fits together."""
    env = Drifting(length=10.0)
    distribution = normal(env.action_space)
    init, act = plain(16, 2)
    params = init(2)
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
    want = distribution.log_prob(outputs, first.action)
    # The sum of a log-probability may be near zero, where its terms, of size one, are rounded.
    np.testing.assert_allclose(first.log_prob, want, rtol=1e-5, atol=1e-6)
    goes_on = ~np.asarray(first.done[:-1])
    np.testing.assert_array_equal(
        np.asarray(first.next_observation[:-1])[goes_on], np.asarray(first.observation[1:])[goes_on]
    )
    assert np.any(first.truncated)
    assert np.any(first.terminated)
    reset_steps = np.asarray(first.done[:-1]) if autoreset == "next_step" else np.zeros((19, 6))
    np.testing.assert_array_equal(first.played[1:], reset_steps == 0)


# -------------------------------------------------------------------------------------------------
# A network as loops over its units computes what the network computes.


def both(sizes, x, outputs=2):
    """The results of a network as it is, and unit by unit."""
    network = MLP(sizes, outputs)
    params = network.init(jax.random.key(0), x)
    params = jax.tree.map(lambda p: p + 0.1, params)  # biases, too
    plain = network.apply(params, x)
    with writing_out():
        return plain, network.apply(params, x), jax.make_jaxpr(network.apply)(params, x)


def test_what_a_network_computes():
    """Also where two pairs of layers have the same shapes."""
    for sizes in ((), (8,), (8, 6), (5, 8, 12), (3,) * 4):
        plain, looped, jaxpr = both(sizes, jnp.arange(3.0))
        np.testing.assert_allclose(looped, plain, rtol=1e-5, atol=1e-6)
        assert str(jaxpr).count("scan[") == (len(sizes) + 1) // 2


def test_a_batch_is_left_as_it_is():
    plain, same, jaxpr = both((8,), jnp.ones((4, 3)))
    np.testing.assert_array_equal(same, plain)
    assert "scan" not in str(jaxpr)


def test_units_of_one_iteration_are_as_many_as_divide_the_layer():
    _, _, jaxpr = both((8,), jnp.ones(3))
    assert "length=2" in str(jaxpr)
    _, _, jaxpr = both((7,), jnp.ones(3))
    assert "length=7" in str(jaxpr)

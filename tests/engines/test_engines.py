"""Every engine plays the same step from the same state: limits, high speeds and falls included."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import envs, normal
from mjx_reinforce.engines import choice as engines
from mjx_reinforce.types import action_space

NUM_STATES = 10_000


class Wide:
    """A task from states up to a tenth beyond its limits and fast; it shows qpos and qvel.

    It never ends, so that what follows a fall shows too.
    """

    def __init__(self, env):
        self.env, self.action_size, self.action_space = env, env.action_size, env.action_space

    def reset(self, rng):
        qpos_key, qvel_key = jax.random.split(rng)
        model = self.env.mj_model
        limits = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.pi, np.pi])
        low, high = jnp.asarray(1.1 * limits.T, jnp.result_type(float))
        # The same states in single and in double precision.
        where = jax.random.uniform(qpos_key, (model.nq,), jnp.float32)
        qvel = 10 * jax.random.uniform(qvel_key, (model.nv,), jnp.float32, minval=-1)
        qpos = low + (high - low) * where
        qvel = qvel.astype(qpos.dtype)
        return self._show(self.env.set_state(qpos, qvel))

    def step(self, state, action):
        return self._show(self.env.step(state, action))

    def _show(self, state):
        physics = state.pipeline_state
        shown = jnp.concatenate([physics.qpos, physics.qvel])
        return state.replace(obs=shown, done=jnp.zeros_like(state.done))


def act(actor, observation):
    """An action from the state, up to a fifth beyond the bounds; no noise."""
    size = actor.shape[-1] // 2
    outputs = 1.2 * jnp.sin(100 * observation[..., :size])
    fixed = jnp.broadcast_to(actor[size:], outputs.shape)
    return jnp.concatenate([outputs, fixed], axis=-1)


def one_step(id, engine, solver="exact", **options):
    """Returns [N, nq + nv + 1]: positions, velocities and reward after one env step."""
    env = Wide(envs.make(id, solver=solver))
    distribution = normal(action_space(env))
    player = engines.ActingPolicy(act, jnp.zeros(2 * env.action_size), distribution)
    play = engines.choose(engine, env, player, 2).rollout
    episodes = jax.jit(
        lambda actor, key: play(
            env,
            act,
            actor,
            distribution,
            key,
            num_episodes=NUM_STATES,
            deterministic=True,
            horizon=2,
            **options,
        )
    )(jnp.zeros(2 * env.action_size), jax.random.key(0))
    return np.column_stack([episodes.observation[1], episodes.reward[0]])


def error(got, want):
    """Returns the largest difference, relative where a number is greater than one."""
    return np.max(np.abs(got - want) / np.maximum(np.abs(want), 1.0))


@pytest.fixture(scope="module")
def exact():
    """Plain MJX in double precision, and how far plain MJX in single precision is from it."""
    jax.clear_caches()  # MJX's traces in one precision, kept, do not lower in the other
    with jax.enable_x64(True):
        reference = one_step("InvertedPendulum-v5", "vmap", solver="mjx")
    jax.clear_caches()
    assert np.any(np.abs(reference[:, 0]) > 1)
    assert np.any(np.abs(reference[:, 1]) > 0.2)
    return reference, error(one_step("InvertedPendulum-v5", "vmap", solver="mjx"), reference)


def test_machine_code_is_plain_mjx_in_double_precision(exact):
    with jax.enable_x64(True):
        assert error(one_step("InvertedPendulum-v5", "native"), exact[0]) < 1e-12


def test_single_precision_is_closer_than_plain_mjx(exact):
    """MJX's iterative solver ends 1e-3 from the optimum at the rail, the closed form 3e-5."""
    reference, plain_error = exact
    assert error(one_step("InvertedPendulum-v5", "native"), reference) < plain_error / 10


def test_auto_says_what_it_takes_and_why():
    pendulum = envs.make("InvertedPendulum-v5")
    assert "every episode has a policy of its own" in engines.choose("auto", pendulum).why
    with pytest.raises(ValueError, match=r"a policy of its own.*choose auto"):
        engines.choose("native", pendulum)


@pytest.mark.parametrize(
    ("name", "version", "told"),
    [("vmap", "0.10.2", True), ("native", "0.10.2", False), ("vmap", "0.11.2", False)],
)
def test_a_jax_that_multiplies_wrongly_is_told(name, version, told, monkeypatch):
    """Where all is left to it."""
    monkeypatch.setattr(jax, "__version__", version)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    env = envs.make("InvertedPendulum-v5")
    player = engines.ActingPolicy(act, jnp.zeros(2), normal(env.action_space))
    with warnings.catch_warnings(record=True) as met:
        warnings.simplefilter("always")
        engines.choose(name, env, player, 2)
    assert [str(x.message)[:10] for x in met] == ["JAX 0.10.2"] * told

"""Machine code takes the step that plain MJX takes: limits, high speeds and falls included."""

import warnings

import golden
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act
from toys import Drifting

from mjx_reinforce import envs
from mjx_reinforce.engine.play import available
from mjx_reinforce.engine.play import choice as engines
from mjx_reinforce.engine.play.program import machine_map

NUM_STATES = 10_000


def vmapped(step, *_):
    return jax.vmap(step)


def stepped(solver, mapped):
    """Positions, velocities and reward [N, nq + nv + 1] after an env step from random states.

    They are up to a tenth beyond the limits and fast, and actions a fifth beyond the bounds.
    """
    env = envs.make("InvertedPendulum-v5", solver=solver)
    model, rng = env.mj_model, np.random.default_rng(0)
    limits = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.pi, np.pi])
    args = [
        rng.uniform(*1.1 * limits.T, (NUM_STATES, model.nq)),
        rng.uniform(-10, 10, (NUM_STATES, model.nv)),
        1.2 * rng.uniform(*model.actuator_ctrlrange.T, (NUM_STATES, model.nu)),
    ]
    # The same numbers in single and in double precision.
    args = [jnp.asarray(x.astype(np.float32), jnp.result_type(float)) for x in args]

    def step(qpos, qvel, action):
        after = env.step(env.set_state(qpos, qvel), action)
        physics = after.pipeline_state
        return jnp.concatenate([physics.qpos, physics.qvel, after.reward[None]])

    return np.asarray(jax.jit(mapped(step, *(x[0] for x in args)))(*args))


def error(got, want):
    """Returns the largest difference, relative where a number is greater than one."""
    return np.max(np.abs(got - want) / np.maximum(np.abs(want), 1.0))


@pytest.mark.slow
def test_machine_code_is_plain_mjx_in_double_precision():
    """In single precision it ends 3e-5 from that at the rail, and MJX's iterative solver 1e-3."""
    jax.clear_caches()  # MJX's traces in one precision, kept, do not lower in the other
    with jax.enable_x64(True):
        reference = stepped("mjx", vmapped)
        assert error(stepped("exact", machine_map), reference) < 1e-12
    jax.clear_caches()
    assert np.any(np.abs(reference[:, 0]) > 1)
    assert np.any(np.abs(reference[:, 1]) > 0.2)
    assert error(stepped("exact", machine_map), reference) < 1e-4


def test_a_jax_that_multiplies_wrongly_is_told(monkeypatch):
    """Where all is left to it."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    env = Drifting()
    actor, act, distribution = actor_and_act(env, ())
    player = engines.ActingPolicy(act, actor, distribution)
    cases = ("vmap", "0.10.2", True), ("native", "0.10.2", False), ("vmap", "0.11.2", False)
    for name, version, told in cases:
        monkeypatch.setattr(jax, "__version__", version)
        with warnings.catch_warnings(record=True) as met:
            warnings.simplefilter("always")
            engines.choose(name, env, player, 2)
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

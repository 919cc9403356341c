"""`physics.step` against `mjx.step`: the same answer, near the limits too."""

import os
import types
from typing import Any, cast

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import fused
from mjx_reinforce.envs import physics

ASSETS = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets")

# MJX's solver takes XLA long to compile and no time to run: a reference is compiled in half the
# time without optimisations, and then associates sums as they are written.
UNOPTIMIZED = {"xla_backend_optimization_level": 0}

# One row, rows in two kinematic trees, two coupled rows with fluid forces; and each integrator but
# Runge-Kutta, which the cart-pole has.
STEPS = [
    ("inverted_double_pendulum", "EULER"),
    ("reacher", "IMPLICITFAST"),
    ("swimmer", "EULER"),
]

CHAIN = """
<mujoco>
  <option timestep="0.01"/>
  <default>
    <joint axis="0 1 0" range="-0.5 0.5" limited="true"/>
    <geom contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body><joint/><geom type="sphere" size="0.1" pos="0.3 0 0"/>
      <body pos="0.5 0 0"><joint/><geom type="sphere" size="0.1" pos="0.3 0 0"/>
        <body pos="0.5 0 0"><joint/><geom type="sphere" size="0.1" pos="0.3 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <compiler angle="radian"/>
</mujoco>
"""


def load(name, **options):
    MjModel = mujoco.MjModel  # pyright: ignore[reportAttributeAccessIssue] # noqa: N806
    if name == "chain":
        model = MjModel.from_xml_string(CHAIN)
    else:
        model = MjModel.from_xml_path(os.path.join(ASSETS, f"{name}.xml"))
    for option, value in options.items():
        setattr(model.opt, option, value)
    return model, mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")


def runner(advance, model, data):
    """Returns a function of positions, velocities and controls."""

    def run(qpos, qvel, ctrl):
        end = advance(model, data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return {
            "qpos": end.qpos,
            "qvel": end.qvel,
            "qacc": end.qacc,
            "warmstart": end.qacc_warmstart,
            "joint force": end.qfrc_constraint,
            "row force": end._impl.efc_force,
            "time": end.time,
        }

    return run


def play(advance, name, args, **options):
    """Runs a batch of states in one of our functions and returns NumPy arrays."""
    _, model, data = load(name, **options)
    lanes = jax.jit(fused.vmap(runner(advance, model, data)))
    return jax.tree.map(np.asarray, lanes(*args))


def play_mjx(advance, name, args, **options):
    """Runs a batch of states in one of MJX's functions and returns NumPy arrays."""
    _, model, data = load(name, **options)
    lanes = jax.jit(jax.vmap(runner(advance, model, data)), compiler_options=UNOPTIMIZED)
    return jax.tree.map(np.asarray, lanes(*args))


def states(model, batch=192, seed=0):
    """Random states: inside, at and far past the limits, slow and fast, [batch, ...]."""
    rng = np.random.default_rng(seed)
    span = np.where(model.jnt_limited, np.abs(model.jnt_range).max(1), 1.0)
    qpos = model.qpos0 + rng.uniform(-1.3, 1.3, (batch, model.nq)) * span
    at_limit = rng.uniform(size=(batch, model.nq)) < 0.2
    qpos = np.where(at_limit & (model.jnt_limited != 0), np.sign(qpos) * span * (1 + 1e-5), qpos)
    qvel = rng.normal(size=(batch, model.nv)) * rng.choice([0.1, 1.0, 10.0], (batch, 1))
    ctrl = rng.uniform(-1, 1, (batch, model.nu))
    return [jnp.asarray(x, float) for x in (qpos, qvel, ctrl)]


def scaled_errors(actual, reference):
    """Returns the largest error of each quantity, relative to that state's largest entry."""
    errors = {}
    for name, exact in reference.items():
        entries = exact.reshape(len(exact), -1)
        scale = 1 + np.abs(entries).max(axis=1, keepdims=True, initial=0)
        difference = np.abs(actual[name].reshape(entries.shape) - entries)
        errors[name] = (difference / scale).max(initial=0)
    return errors


def assert_equal_to_mjx(ours, theirs, name, args, tolerance, **options):
    actual = play(ours, name, args, **options)
    reference = play_mjx(theirs, name, args, **options)
    errors = scaled_errors(actual, reference)
    assert max(errors.values()) < tolerance, errors
    return actual


def at_both_limits():
    """The cart past the rail and the pole past its hinge limit, pushed in and out."""
    signs = [
        [a, b, c, d] for a in (1, -1) for b in (1, -1) for c in (4, 0.1, -4) for d in (9, 0.1, -9)
    ]
    signs = jnp.array(signs, float)
    return signs[:, :2] * jnp.array([1.01, np.pi / 2 + 0.02]), signs[:, 2:], signs[:, :1] * 3


def test_step_equals_mjx_in_double_precision():
    with jax.enable_x64(True):
        random = states(load("inverted_pendulum")[0])
        args = [jnp.concatenate(pair) for pair in zip(random, at_both_limits(), strict=True)]
        actual = assert_equal_to_mjx(physics.step, mjx.step, "inverted_pendulum", args, 1e-12)
        assert actual["qpos"].dtype == np.float64
        assert (actual["row force"] > 0).all(axis=1).any()


@pytest.mark.parametrize(("name", "integrator"), STEPS)
def test_other_models_and_integrators(name, integrator):
    options = {"integrator": mjx.IntegratorType[integrator]}
    with jax.enable_x64(True):
        args = states(load(name)[0])
        actual = assert_equal_to_mjx(physics.step, mjx.step, name, args, 1e-12, **options)
        assert (actual["row force"] > 0).any()


def test_single_precision_is_no_worse_than_that_of_mjx():
    args = states(load("inverted_pendulum")[0])
    ours = play(physics.forward, "inverted_pendulum", args)
    theirs = play_mjx(mjx.forward, "inverted_pendulum", args)
    with jax.enable_x64(True):
        args = [jnp.asarray(np.asarray(x), float) for x in args]
        exact = play(physics.forward, "inverted_pendulum", args)
    our_error, their_error = scaled_errors(ours, exact), scaled_errors(theirs, exact)
    for name in ("qacc", "joint force", "row force"):
        assert our_error[name] < max(1e-6, 2 * their_error[name]), name


def test_without_constraints():
    options = {"disableflags": mjx.DisableBit.CONSTRAINT}
    with jax.enable_x64(True):
        args = states(load("inverted_pendulum")[0])
        name = "inverted_pendulum"
        assert_equal_to_mjx(physics.forward, mjx.forward, name, args, 1e-12, **options)


def test_general_models_enter_the_solver_only_if_a_row_is_active():
    """Three limits in one chain have no closed form."""
    qpos = jnp.array([[0.2, -0.2, 0.1], [0.7, -0.6, 0.8], [0.1, 0.9, 0.0]])
    args = qpos, 2 * qpos, jnp.zeros((3, 0))
    _, model, data = load("chain")
    lanes = fused.vmap(runner(physics.forward, model, data))
    actual = jax.tree.map(np.asarray, jax.jit(lanes)(*args))
    expected = play_mjx(mjx.forward, "chain", args)
    assert scaled_errors(actual, expected)["qacc"] < 1e-5
    assert np.any(expected["row force"] != 0, axis=1).tolist() == [False, True, True]
    jaxpr = jax.make_jaxpr(lanes)(*args)
    gates = [eqn for eqn in jaxpr.jaxpr.eqns if eqn.primitive.name == "cond"]
    assert len(gates) == 1
    assert "while" not in [eqn.primitive.name for eqn in jaxpr.jaxpr.eqns]


def test_a_nan_stays_in_its_lane():
    model, mx, data = load("inverted_pendulum")
    qpos, qvel, ctrl = states(model, batch=8)
    step = jax.jit(fused.vmap(runner(physics.step, mx, data)))
    clean = step(qpos, qvel, ctrl)
    for dirty in (step(qpos.at[3, 0].set(jnp.nan), qvel, ctrl), step(qpos, qvel, ctrl * jnp.nan)):
        assert np.isnan(dirty["qpos"][3]).any()
    dirty = step(qpos.at[3].set(jnp.nan), qvel, ctrl)
    for name, values in clean.items():
        np.testing.assert_array_equal(np.delete(dirty[name], 3, 0), np.delete(values, 3, 0))


def test_seeds_over_lanes():
    model, mx, data = load("inverted_pendulum")
    args = [x.reshape(3, 8, *x.shape[1:]) for x in states(model, batch=24)]
    advance = fused.vmap(runner(physics.forward, mx, data))
    nested = jax.jit(jax.vmap(advance))(*args)
    for seed in range(3):
        flat = jax.jit(advance)(*(x[seed] for x in args))
        np.testing.assert_allclose(nested["qacc"][seed], flat["qacc"], rtol=1e-5, atol=1e-4)


def test_operations_of_a_step():
    """A guard on cost that does not depend on the machine: 1,011 when this was written."""
    _, mx, data = load("inverted_pendulum")

    def state(qpos, qvel, ctrl):
        end = physics.step(mx, data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return end.qpos, end.qvel

    written = fused.scalarize(state, data.qpos, data.qvel, data.ctrl)
    assert sum(written.operations.values()) < 1050


def test_other_implementations_are_refused():
    with pytest.raises(ValueError, match="impl='jax'"):
        physics.step(cast(Any, types.SimpleNamespace(impl=mjx.Impl.C)), cast(Any, None))

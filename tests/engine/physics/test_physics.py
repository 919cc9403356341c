"""`physics.step` against `mjx.step`, and against C MuJoCo where MJX departs from it."""

import os
import types
from pathlib import Path
from typing import Any, cast

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scipy.spatial.transform import Rotation

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.physics import contacts
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

ASSETS = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets")

# MJX's solver takes XLA long to compile and no time to run: a reference is compiled in half the
# time without optimizations, and then associates sums as they are written.
UNOPTIMIZED = {"xla_backend_optimization_level": 0}

CHAIN = (Path(__file__).parent / "chain.xml").read_text("utf-8")


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
            "row force": jax_fields(end).efc_force,
            "time": end.time,
        }

    return run


def play(advance, name, args, engine=scalar.vmap, **options):
    """Runs a batch of states in one function and returns NumPy arrays."""
    _, model, data = load(name, **options)
    compiler_options = UNOPTIMIZED if engine is jax.vmap else {}
    lanes = jax.jit(engine(runner(advance, model, data)), compiler_options=compiler_options)
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
    reference = play(theirs, name, args, jax.vmap, **options)
    errors = scaled_errors(actual, reference)
    assert max(errors.values()) < tolerance, errors
    return actual


@pytest.mark.slow
def test_single_precision_is_no_worse_than_that_of_mjx():
    args = states(load("inverted_pendulum")[0])
    ours = play(physics.forward, "inverted_pendulum", args)
    theirs = play(mjx.forward, "inverted_pendulum", args, jax.vmap)
    with jax.enable_x64(True):
        args = [jnp.asarray(np.asarray(x), float) for x in args]
        exact = play(physics.forward, "inverted_pendulum", args)
    our_error, their_error = scaled_errors(ours, exact), scaled_errors(theirs, exact)
    for name in ("qacc", "joint force", "row force"):
        assert our_error[name] < max(1e-6, 2 * their_error[name]), name


@pytest.mark.slow
def test_without_constraints():
    options = {"disableflags": mjx.DisableBit.CONSTRAINT}
    with jax.enable_x64(True):
        args = states(load("inverted_pendulum")[0])
        name = "inverted_pendulum"
        assert_equal_to_mjx(physics.forward, mjx.forward, name, args, 1e-12, **options)


@pytest.mark.slow
def test_general_models_enter_the_solver_only_if_a_row_is_active():
    """Three limits in one chain have no closed form."""
    with jax.enable_x64(True):
        qpos = jnp.array([[0.2, -0.2, 0.1], [0.7, -0.6, 0.8], [0.1, 0.9, 0.0]])
        args = qpos, 2 * qpos, jnp.zeros((3, 0))
        _, model, data = load("chain")
        lanes = scalar.vmap(runner(physics.forward, model, data))
        actual = jax.tree.map(np.asarray, jax.jit(lanes)(*args))
        expected = play(mjx.forward, "chain", args, jax.vmap)
        assert scaled_errors(actual, expected)["qacc"] < 1e-12
        assert np.any(expected["row force"] != 0, axis=1).tolist() == [False, True, True]
        jaxpr = jax.make_jaxpr(lanes)(*args)
    gates = [eqn for eqn in jaxpr.jaxpr.eqns if eqn.primitive.name == "cond"]
    assert len(gates) == 1
    assert "while" not in [eqn.primitive.name for eqn in jaxpr.jaxpr.eqns]


def test_operations_of_a_step():
    """A guard on cost that does not depend on the machine: 1,011 when this was written."""
    _, mx, data = load("inverted_pendulum")

    def state(qpos, qvel, ctrl):
        end = physics.step(mx, data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return end.qpos, end.qvel

    written = scalar.scalarize(state, data.qpos, data.qvel, data.ctrl)
    assert sum(written.operations.values()) < 1050


def test_other_implementations_are_refused():
    with pytest.raises(ValueError, match="impl='jax'"):
        physics.step(cast(Any, types.SimpleNamespace(impl=mjx.Impl.C)), cast(Any, None))


# ------------------------------------------------------------------ equal to C MuJoCo, not to MJX

TUMBLERS = (Path(__file__).parent / "tumblers.xml").read_text("utf-8")


def compiled(xml):
    """Returns C MuJoCo's model and data, and MJX's."""
    model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    return model, data, mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")


@pytest.mark.slow
def test_tumbling_bodies_turn_as_in_mujoco():
    speeds = 1e-6, 1.0, 10.0
    with jax.enable_x64(True):
        model, data, mx, start = compiled(TUMBLERS)
        moving = np.outer(speeds, np.random.default_rng(0).normal(size=model.nv))
        at_rest = np.tile(data.qpos, (3, 1))

        def advance(qpos, qvel):
            end = physics.step(mx, start.replace(qpos=qpos, qvel=qvel))
            return end.qpos, end.qvel

        advance = jax.jit(jax.vmap(advance), compiler_options=UNOPTIMIZED)
        states = [(jnp.array(at_rest), jnp.array(moving))]
        for _ in range(5):
            states.append(advance(*states[-1]))
        for lane, speed in enumerate(speeds):
            data.qpos[:], data.qvel[:] = at_rest[lane], moving[lane]
            for qpos, qvel in states[1:]:
                mujoco.mj_step(model, data)  # pyright: ignore[reportAttributeAccessIssue]
                np.testing.assert_allclose(qpos[lane], data.qpos, rtol=0, atol=1e-12)
                np.testing.assert_allclose(qvel[lane], data.qvel, rtol=0, atol=1e-12 * (1 + speed))


def test_rotation_rate_at_every_angle():
    """Against the derivative of the rotation's logarithm, in closed form in double precision."""
    axis, velocity = np.array([2.0, -1.0, 2.0]) / 3, np.array([0.3, 0.5, -0.7])
    angles = np.array([0.0, 1e-20, 1e-9, 1e-5, 1e-3, 0.0999, 0.1001, 1.0, 3.1, 3.2, 6.0, 9.0])
    principal = (angles + np.pi) % (2 * np.pi) - np.pi
    half, small = principal / 2, np.abs(principal) < 1e-4
    cotangent = np.where(small, 1 - half**2 / 3, half / np.tan(np.where(small, 1, half)))
    along = axis * (axis @ velocity)
    across = np.cross(axis, velocity)
    expected = along + cotangent[:, None] * (velocity - along) + principal[:, None] / 2 * across
    for double, tolerance in ((False, 1e-6), (True, 1e-14)):
        with jax.enable_x64(double):
            rate = jax.vmap(
                lambda x: physics._rotation_rate(x * jnp.array(axis), jnp.array(velocity))
            )
            found = jax.jit(rate)(jnp.array(angles))
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_axes_that_cross_push_across_also_in_single_precision():
    """As in a planar Hopper: the distance is zero, of which rounding leaves up to 1e-6."""
    rng = np.random.default_rng(0)
    pivot = np.stack([rng.uniform(-3, 3, 200), np.zeros(200), rng.uniform(0, 2, 200)], axis=1)
    tilt = rng.uniform(0, np.pi, 200)[:, None] + [0.0, 1.0]
    turn = Rotation.from_euler("y", tilt.reshape(-1, 1)).as_matrix().reshape(200, 2, 3, 3)
    along = rng.uniform(-0.2, 0.2, (200, 2, 1))
    pos = jnp.asarray(pivot[:, None] - along * turn[..., 2], jnp.float32)
    size = jnp.array([[0.05, 0.3, 0], [0.04, 0.3, 0]])

    @jax.vmap
    def collide(pos, mat):
        data = types.SimpleNamespace(geom_xpos=pos, geom_xmat=mat)
        model = types.SimpleNamespace(geom_size=size)
        return contacts.capsule_capsule(model, data, None, np.array([[0, 1]]))

    dist, _, frame = collide(pos, jnp.asarray(turn, jnp.float32))
    np.testing.assert_allclose(dist, -0.09, atol=1e-6)
    np.testing.assert_allclose(np.abs(frame[:, 0, 0]), np.tile([0, 1, 0], (200, 1)), atol=1e-5)

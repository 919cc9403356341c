"""Joint limits in closed form: against C MuJoCo's solution, and all sets of active rows."""

import itertools
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce.engine.physics import limits, newton, step
from mjx_reinforce.engine.physics.mjx_internals import jax_fields

XML = """
<mujoco><compiler angle="radian"/><option iterations="200" tolerance="1e-12"/><worldbody>
  <body><joint axis="0 1 0" range="-0.3 0.4" limited="true" margin="0.02"/>
    <geom size="0.05 0.3" type="capsule" pos="0.2 0 0" contype="0" conaffinity="0"/>
    <body pos="0.4 0 0"><joint axis="0 1 0" range="-0.5 0.2" limited="true"/>
      <geom size="0.05 0.2" type="capsule" pos="0.1 0 0.1" contype="0" conaffinity="0"/>
      <body pos="0.2 0 0.1"><joint type="slide" axis="1 0 0"/>
        <geom size="0.05" contype="0" conaffinity="0"/></body></body></body>
  <body pos="0 1 0"><joint type="slide" axis="0 0 1" range="-0.1 0.1" limited="true"/>
    <geom size="0.1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)  # pyright: ignore
IN_JAX = mjx.put_model(MODEL, impl="jax")
#: Past limits: none, each, both of the first tree (two ways), all; and within the margin alone.
STATES = [
    [0, 0, 0, 0],
    [0.45, 0, 0, 0],
    [0, 0.3, 0, 0],
    [0.45, 0.3, 0, 0],
    [-0.35, 0.25, 0.1, -0.2],
    [-0.35, -0.6, 0, 0.2],
    [0.39, 0, 0, 0],
]


def forward(qpos, qvel):
    data = mujoco.MjData(MODEL)  # pyright: ignore
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(MODEL, data)  # pyright: ignore
    return data


@pytest.fixture(scope="module")
def solve():
    def both(data):
        return limits.solve_limits(IN_JAX, data), limits.past_limit(IN_JAX, data)

    return jax.jit(both)


def test_the_acceleration_is_that_of_c(solve):
    for qpos, qvel in itertools.product(STATES, [(0, 0, 0, 0), (3, -2, 1, -4), (-3, 5, 0, 4)]):
        data = forward(qpos, qvel)
        (qacc, torque, force), past = solve(mjx.put_data(MODEL, data, impl="jax"))
        scale = 1 + np.abs(data.qacc).max()
        np.testing.assert_allclose(qacc / scale, data.qacc / scale, atol=2e-5)
        np.testing.assert_allclose(torque, data.qfrc_constraint, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(sum(force), sum(data.efc_force), rtol=1e-3, atol=1e-3)
        assert bool(past) == (data.nefc > 0)


def test_a_nan_is_past_the_limit(solve):
    data = mjx.put_data(MODEL, forward([0, 0, 0, 0], [0, 0, 0, 0]), impl="jax")
    assert not limits.past_limit(IN_JAX, data)
    assert limits.past_limit(IN_JAX, data.replace(qpos=data.qpos.at[1].set(jnp.nan)))
    assert not limits.past_limit(IN_JAX, data.replace(qpos=data.qpos.at[2].set(9.0)))  # unlimited


@pytest.mark.parametrize("size", [1, 2])
def test_the_forces_are_those_of_the_only_consistent_set(size):
    """Of random positive definite problems; the active rows are found by trying all sets."""
    rng, reached = np.random.default_rng(0), set()
    for _ in range(200):
        root = rng.standard_normal((size, size))
        matrix, target = root @ root.T, rng.standard_normal(size)
        mass = rng.uniform(0.5, 2, size)  # rows are scaled by it, and the matrix is not symmetric
        matrix = mass[:, None] * matrix
        found = np.array(limits._complementary(matrix.tolist(), target.tolist()))
        consistent = []
        for active in itertools.product([False, True], repeat=size):
            rows = np.flatnonzero(active)
            force = np.zeros(size)
            system = np.eye(rows.size) + matrix[np.ix_(rows, rows)]
            force[rows] = np.linalg.solve(system, target[rows])
            if np.allclose(force, np.maximum(0, target - matrix @ force), atol=1e-9):
                consistent.append(active)
                np.testing.assert_allclose(found, force, rtol=1e-4, atol=1e-5)
        assert len(consistent) == 1
        reached |= set(consistent)
    assert len(reached) == 2**size


def test_only_two_limits_to_a_tree_are_supported():
    for old, new, supported in (
        ("", "", True),
        ('<joint type="slide" axis="1 0 0"/>', '<joint range="-1 1" limited="true"/>', False),
        ('<joint axis="0 1 0" range="-0.5 0.2" limited="true"/>', "", True),
        ('contype="0" conaffinity="0"', "", False),
        ('range="-0.3 0.4"', 'range="-0.3 0.4" frictionloss="1"', False),
    ):
        xml = XML.replace(old, new) if old else XML
        model = mjx.put_model(mujoco.MjModel.from_xml_string(xml), impl="jax")  # pyright: ignore
        data = mjx.make_data(model, impl="jax")
        assert limits.supports(model, data) == supported, new


def test_as_many_rows_of_friction_are_no_limits():
    """With elliptic cones too, of no contact, with which MJX's solver fails."""
    friction = XML.replace('limited="true"', 'limited="true" frictionloss=".3"')
    option = ' cone="elliptic"><flag limit="disable"/></option><worldbody>'
    friction = friction.replace("/><worldbody>", option)
    model = mujoco.MjModel.from_xml_string(friction)  # pyright: ignore
    model.opt.tolerance = 0
    data = mujoco.MjData(model)  # pyright: ignore
    data.qpos[:], data.qvel[:] = STATES[4], (3, -2, 1, -4)
    mujoco.mj_forward(model, data)  # pyright: ignore
    with jax.enable_x64(True):
        in_jax, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")
        qacc = np.asarray(jax.jit(lambda data: step.solve_constraints(in_jax, data).qacc)(start))
    assert data.nefc == limits._limited_joints(in_jax).size
    np.testing.assert_allclose(qacc, data.qacc, rtol=1e-9)


@pytest.mark.slow
def test_rows_are_those_of_the_limited_joints():
    data = forward(STATES[4], (0, 0, 0, 0))
    rows = jax.jit(lambda data: jax_fields(mjx.make_constraint(IN_JAX, data)).efc_J)
    jacobian = rows(mjx.put_data(MODEL, data, impl="jax"))
    assert limits._limited_joints(IN_JAX).tolist() == [0, 1, 3]
    assert np.argmax(np.abs(jacobian), axis=1).tolist() == [0, 1, 3]
    assert limits._coupled_rows(IN_JAX, np.array([0, 1, 3])) == [[0, 1], [2]]


# -------------------------------------------------------------------------------------------------
# Which solver finds the constraint forces, and where none is entered.

SMOOTH = np.float32([3.0, 4.0])


def data_of(rows=((0.0, 0.0), (0.0, 0.0)), dist=(0.1,), margin=(0.0,), ne=0, nf=0, nl=1):
    """Two rows, one of a limit and one of a contact."""
    contact = types.SimpleNamespace(
        dist=jnp.float32(dist), includemargin=jnp.float32(margin), dim=np.array([3])
    )
    fields = types.SimpleNamespace(
        efc_J=jnp.float32(rows), efc_force=jnp.ones(2), ne=ne, nf=nf, nl=nl, contact=contact
    )
    return types.SimpleNamespace(
        _impl=fields,
        qacc_smooth=jnp.asarray(SMOOTH),
        qfrc_constraint=jnp.ones(2),
        replace=lambda **changed: changed.values(),
    )


@pytest.fixture
def chosen(monkeypatch):
    """Solves data; what solves says its name by the acceleration."""

    def solution(number):
        return jnp.full(2, number), jnp.full(2, number), jnp.full(2, number)

    def of(data, *, closed=False, past=False, ours=True):
        monkeypatch.setattr(limits, "supports", lambda *_: closed)
        monkeypatch.setattr(limits, "past_limit", lambda *_: jnp.array(past))
        monkeypatch.setattr(limits, "solve_limits", lambda *_: solution(1.0))
        monkeypatch.setattr(newton, "supports", lambda *_: ours)
        monkeypatch.setattr(newton, "solve_newton", None)
        monkeypatch.setattr(step.touching, "solve_touching", lambda *_: solution(2.0))
        named = dict(zip(("qacc", "qfrc_constraint", "force"), solution(3.0), strict=True))
        force = types.SimpleNamespace(efc_force=named.pop("force"))
        theirs = types.SimpleNamespace(**named, _impl=force)
        monkeypatch.setattr(step.mjx, "solve", lambda *_: theirs)
        with_force = lambda found, efc_force: [*found, efc_force]  # noqa: E731
        monkeypatch.setattr(step, "with_fields", with_force)
        return [np.asarray(x).tolist() for x in step.solve_constraints(None, data)]  # pyright: ignore

    return of


NONE = [SMOOTH.tolist(), [0, 0], [0, 0]]


@pytest.mark.parametrize("past", [False, True])
def test_limits_alone_have_a_closed_form(chosen, past):
    rows = ((1.0, 0.0), (0.0, 0.0))  # of a limit that is not the closed form's to judge
    assert chosen(data_of(rows), closed=True, past=past) == ([[1, 1]] * 3 if past else NONE)


@pytest.mark.parametrize(
    ("changes", "active"),
    [
        ({}, False),
        ({"dist": [0.0]}, False),
        ({"dist": [-0.01]}, True),
        ({"dist": [0.1], "margin": [0.2]}, True),
        ({"dist": [np.nan]}, True),
        ({"dist": []}, False),
        ({"rows": [[0, 0.5], [0, 0]]}, True),
        ({"rows": [[np.nan, 0], [0, 0]]}, True),
        ({"rows": [[0, 0], [0.5, 0]]}, False),  # a contact's row, which is apart
    ],
)
def test_the_solver_is_entered_where_a_row_is_active(chosen, changes, active):
    changes.setdefault("margin", [0.0] * len(changes.get("dist", [0])))
    assert chosen(data_of(**changes)) == ([[2, 2]] * 3 if active else NONE)


@pytest.mark.parametrize("kind", ["ne", "nf"])
def test_equalities_and_friction_are_always_active(chosen, kind):
    assert chosen(data_of(**{kind: 1, "nl": 0})) == [[2, 2]] * 3


def test_mjx_solves_what_newton_does_not(chosen):
    assert chosen(data_of(dist=[-1.0]), ours=False) == [[3, 3]] * 3

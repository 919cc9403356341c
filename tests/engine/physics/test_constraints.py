"""Which solver finds the constraint forces, and where none is entered."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.engine.physics import limits, newton, step

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
def solve(monkeypatch):
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
def test_limits_alone_have_a_closed_form(solve, past):
    rows = ((1.0, 0.0), (0.0, 0.0))  # of a limit that is not the closed form's to judge
    assert solve(data_of(rows), closed=True, past=past) == ([[1, 1]] * 3 if past else NONE)


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
def test_the_solver_is_entered_where_a_row_is_active(solve, changes, active):
    changes.setdefault("margin", [0.0] * len(changes.get("dist", [0])))
    assert solve(data_of(**changes)) == ([[2, 2]] * 3 if active else NONE)


@pytest.mark.parametrize("kind", ["ne", "nf"])
def test_equalities_and_friction_are_always_active(solve, kind):
    assert solve(data_of(**{kind: 1, "nl": 0})) == [[2, 2]] * 3


def test_mjx_solves_what_newton_does_not(solve):
    assert solve(data_of(dist=[-1.0]), ours=False) == [[3, 3]] * 3

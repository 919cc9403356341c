"""Pairs one after the other: the contacts of all pairs at once, wherever geoms touch."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.engine.physics import contacts

GEOMS = np.array([[0, 1], [1, 2], [3, 0], [2, 3]])
#: Geoms 0 and 1 overlap, 2 is within its margin of 1, 3 is apart from all but 2.
PLACES = np.float32([[0, 0, 0], [0.4, 0.1, 0], [1.2, 0, 0.3], [3.0, 1.0, -2.0]])


def collide(model, data, key, geoms):
    """Two contacts a pair, of spheres with a number of their own in the geom's size."""
    del key
    away = data.geom_xpos[geoms[:, 1]] - data.geom_xpos[geoms[:, 0]]
    radii = model.geom_size[geoms].sum(axis=(1, 2))
    dist = jnp.linalg.norm(away, axis=1) - radii
    turned = jnp.einsum("pij,pj->pi", data.geom_xmat[geoms[:, 0]], away)
    return (
        jnp.repeat(dist, 2),
        jnp.repeat(turned, 2, axis=0) * jnp.tile(jnp.array([[1.0], [2.0]]), (len(geoms), 1)),
        jnp.repeat(data.geom_xmat[geoms[:, 1]], 2, axis=0),
    )


collide.ncon = 2  # pyright: ignore[reportFunctionMemberAccess]


def model_of(num_pairs=0, margins=(0.0, 0.0, 0.2, 0.0)):
    size = np.float32([[0.3], [0.2], [0.45], [0.5]])
    rbound = size[:, 0] + np.float32([0.0, 0.0, 0.05, 0.0])
    return types.SimpleNamespace(
        npair=num_pairs, geom_rbound=rbound, geom_margin=np.float32(margins), geom_size=size
    )


def data_of(places=PLACES):
    mats = np.random.default_rng(0).normal(size=(4, 3, 3)).astype(np.float32)
    return types.SimpleNamespace(geom_xpos=jnp.asarray(places), geom_xmat=jnp.asarray(mats))


@pytest.fixture(autouse=True)
def in_turn(monkeypatch):
    monkeypatch.setattr(contacts, "by_engine", lambda one, many, *rows, may_unroll: one(*rows))


def test_contacts_near_are_those_of_all_at_once_and_others_are_apart():
    one, model, data = contacts.one_by_one(collide), model_of(), data_of()
    assert one.ncon == 2  # pyright: ignore[reportFunctionMemberAccess]
    got, want = one(model, data, None, GEOMS), collide(model, data, None, GEOMS)
    near = np.array([True, True, True, True, False, False, False, False])
    for x, exact in zip(got, want, strict=True):
        assert (x.shape, x.dtype) == (exact.shape, exact.dtype)
        np.testing.assert_allclose(x[near], exact[near], rtol=1e-6)
    assert not any(np.any(x[~near]) for x in got[1:])
    gap = np.linalg.norm(PLACES[[3, 2]] - PLACES[[0, 3]], axis=1) - [0.8, 1.0]
    np.testing.assert_allclose(got[0][~near], np.repeat(gap, 2), rtol=1e-5)


def test_a_geom_within_its_margin_is_collided():
    """And with a smaller margin it is not."""
    gap = {}
    for margins in ((0.0, 0.0, 0.2, 0.0), (0.0, 0.2, 0.0, 0.0), (0.0, 0.05, 0.05, 0.0)):
        got = contacts.one_by_one(collide)(model_of(margins=margins), data_of(), None, GEOMS[1:2])
        gap[margins] = float(np.abs(got[1]).max())
    first, second, none = gap.values()
    assert first == second > 0 == none


def test_a_nan_reaches_the_contacts():
    places = PLACES.copy()
    places[0] = np.nan
    dist, *_ = contacts.one_by_one(collide)(model_of(), data_of(places), None, GEOMS)
    np.testing.assert_array_equal(
        np.isnan(dist), [True] * 2 + [False] * 2 + [True] * 2 + [False] * 2
    )


def test_pairs_with_margins_of_their_own_go_to_mjx(monkeypatch):
    monkeypatch.setattr(contacts, "by_engine", lambda *_, **__: pytest.fail("one after the other"))
    model, data = model_of(num_pairs=1), data_of()
    got = contacts.one_by_one(collide)(model, data, None, GEOMS)
    jax.tree.map(np.testing.assert_array_equal, got, collide(model, data, None, GEOMS))

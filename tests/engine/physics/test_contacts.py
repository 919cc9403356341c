"""Contacts of every pair of types of geoms that is right, in many poses, against C MuJoCo."""

import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scipy.spatial.transform import Rotation

from mjx_reinforce.engine.physics import contacts
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.envs import models

PAIR = """
<mujoco>
  <worldbody><geom type="{}"/><body><freejoint/><geom type="{}"/></body>
    <body pos="9 9 9"><joint name="j"/><geom size=".1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><motor joint="j"/></actuator>
</mujoco>"""
GEOMS = {
    "plane": 'plane" size="3 3 1',
    "sphere": 'sphere" size=".1',
    "capsule": 'capsule" size=".08 .2',
    "ellipsoid": 'ellipsoid" size=".2 .15 .1',
    "cylinder": 'cylinder" size=".15 .1',
    "box": 'box" size=".2 .15 .1',
}
HALF = np.array([0.2, 0.15, 0.1])
#: The point of a geom that is farthest along a direction, both in its own frame.
FARTHEST = {
    "sphere": lambda n: 0.1 * n,
    "capsule": lambda n: 0.08 * n + [0, 0, 0.2 * np.sign(n[2])],
    "ellipsoid": lambda n: HALF**2 * n / np.linalg.norm(HALF * n),
    "cylinder": lambda n: (
        np.sign(n) * [0, 0, 0.1] + n * [0.15, 0.15, 0] / max(np.hypot(*n[:2]), 1e-9)
    ),
    "box": lambda n: HALF * np.sign(n),
    "plane": lambda n: np.zeros(3),
}
#: C's search for the contact of a capsule and a cylinder ends at 1e-6.
TOLERANCE = {("cylinder", "capsule"): 1e-5}


def poses(first, second):
    """Flat, on edge, nearly flat and deep, shallow, and side by side; then ``others``: [65, 7]."""
    up = np.eye(3)[2]
    across = up if first == "plane" else np.eye(3)[0]
    lying = Rotation.from_euler("y", 90 if second == "capsule" else 0, degrees=True)
    tilted = Rotation.from_euler("xyz", [25, -35, 15], degrees=True)
    nearly = Rotation.from_euler("xyz", [1, 2, 30], degrees=True) * lying
    aside = Rotation.from_euler("z", 20, degrees=True) * lying
    cases = [
        (lying, up, 0.002),
        (tilted, up, 0.004),
        (nearly, up, 0.016),
        (nearly, up, 0.0005),
        (aside, across, 0.004),
    ]
    rows = []
    for turn, along, depth in cases:
        meets = turn.apply(FARTHEST[second](turn.inv().apply(-along)))
        place = FARTHEST[first](along) - depth * along - meets + [0.01, 0.02, 0] * (1 - along)
        rows.append([*place, *turn.as_quat(scalar_first=True)])
    return np.concatenate([rows, others(first, second)])


#: Pairs whose contacts are those of C also where the geoms are apart: they have a margin of 10 m,
#: and their planes are tilted.
ROUND = [
    *(("plane", x) for x in ("sphere", "capsule")),
    *(("sphere", x) for x in ("sphere", "capsule")),
    ("capsule", "capsule"),
]


def others(first, second):
    """Random poses of round geoms, for capsules also chosen ones, [60, 7]; far away for others."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([0.4 * rng.normal(size=(60, 3)), rng.normal(size=(60, 4))], axis=1)
    if (first, second) not in ROUND:
        rows[:, 2] = 50
    elif second == "capsule":
        rows[10:20, 3:] = [1, 0, 0, 0] + 0.01 * rows[10:20, 3:]  # nearly parallel, and on end
        lying = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
        # Crossing, with no distance between the axes, and end-on.
        rows[:3] = [[0.15, 0, 0, *lying], [0, 0, 0, *lying], [0, 0.3, 0.5, *lying]]
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return rows


def compiled(first, second):
    xml = PAIR.format(GEOMS[first], GEOMS[second])
    return mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]


RIGHT = [
    *(("plane", x) for x in ("box", "cylinder", "sphere", "capsule", "ellipsoid")),
    *(("cylinder", x) for x in ("sphere", "capsule")),
    *(("sphere", x) for x in ("sphere", "capsule")),
    ("capsule", "capsule"),
]


@pytest.fixture(scope="module")
def all_pairs():
    """A model of all pairs, each of which meets only within itself, and MJX's contacts of poses."""
    bodies = ""
    for k, pair in enumerate(RIGHT):
        options = f'contype="{1 << k}" conaffinity="{1 << k}" margin="{10 * (pair in ROUND)}"'
        tilt = 'euler="20 30 0"' if pair in ROUND and pair[0] == "plane" else ""
        one, other = f'<geom type="{GEOMS[pair[0]]}" {options} {tilt}/>', GEOMS[pair[1]]
        bodies += f'{one}<body><freejoint/><geom type="{other}" {options}/></body>'
    text = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)  # pyright: ignore[reportAttributeAccessIssue]
    qpos = np.concatenate([poses(*pair) for pair in RIGHT], axis=1)
    with jax.enable_x64(True):
        mx = mjx.put_model(model, impl="jax")
        start = mjx.make_data(model, impl="jax")

        def collide(place):
            return jax_fields(contacts.fwd_position(mx, start.replace(qpos=place))).contact

        lowered = jax.jit(jax.vmap(collide)).lower(jnp.asarray(qpos))
        found = lowered.compile()(jnp.asarray(qpos))
    found = jax.tree.map(np.asarray, found)
    return types.SimpleNamespace(model=model, qpos=qpos, found=found, text=lowered.as_text())


@pytest.fixture(scope="module")
def theirs(all_pairs):
    """C's contacts: of each pose, rows of a pair's number, distance, place and frame."""
    data, rows = mujoco.MjData(all_pairs.model), []  # pyright: ignore[reportAttributeAccessIssue]
    for place in all_pairs.qpos:
        data.qpos[:] = place
        mujoco.mj_forward(all_pairs.model, data)  # pyright: ignore[reportAttributeAccessIssue]
        parts = ((c.geom1 % len(RIGHT), [c.dist], c.pos, c.frame) for c in data.contact)
        rows.append([(number, np.concatenate(row)) for number, *row in parts])
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("pair", RIGHT, ids="-".join)
def test_contacts_are_those_of_mujoco(all_pairs, theirs, pair):
    number, found, touching = RIGHT.index(pair), all_pairs.found, 0
    for i, rows in enumerate(theirs):
        near = np.inf if pair in ROUND else 0
        own = found.geom[i, :, 0] % len(RIGHT) == number
        touches = np.flatnonzero((found.dist[i] < near) & own)
        ours = [
            np.concatenate([found.dist[i, k, None], found.pos[i, k], found.frame[i, k].ravel()])
            for k in touches
        ]
        exact = [row for of, row in rows if of == number]
        assert len(ours) == len(exact), (i, ours, exact)
        touching += bool(ours)
        key = lambda row: tuple(np.round(row[:4], 4) + 0.0)  # noqa: E731
        for mine, row in zip(sorted(ours, key=key), sorted(exact, key=key), strict=True):
            np.testing.assert_allclose(mine, row, rtol=0, atol=TOLERANCE.get(pair, 1e-12))
    assert touching >= 4


def test_parallel_capsules_meet_at_the_middle_of_where_they_do_in_c():
    """C has contacts at both ends of their overlap."""
    model = compiled("capsule", "capsule")
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:7] = [0.1, 0, 0.3, 1, 0, 0, 0]
    mujoco.mj_forward(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    first, second = data.contact
    with jax.enable_x64(True):
        place = types.SimpleNamespace(
            geom_xpos=jnp.array(data.geom_xpos[:2]),
            geom_xmat=jnp.array(data.geom_xmat[:2].reshape(2, 3, 3)),
        )
        shape = types.SimpleNamespace(geom_size=jnp.array(model.geom_size[:2]))
        dist, pos, _ = contacts.capsule_capsule(shape, place, None, np.array([[0, 1]]))
    np.testing.assert_allclose(dist, first.dist, atol=1e-12)
    np.testing.assert_allclose(pos[0], (first.pos + second.pos) / 2, atol=1e-12)


@pytest.mark.slow
def test_the_search_along_a_capsule_is_written_out(all_pairs):
    """A loop in XLA stalls jaxlib 0.10.2."""
    assert "stablehlo.while" not in all_pairs.text


def test_pairs_that_mjx_gets_wrong_are_refused_if_they_can_meet():
    for pair in contacts.UNLIKE_C:
        model = compiled(*(kind.name.lower() for kind in pair))
        with pytest.raises(ValueError, match="which MJX gets wrong; keep that pair apart"):
            models.to_mjx(model, "pair")
        model.geom_contype[0] = model.geom_conaffinity[0] = 0
        models.to_mjx(model, "pair")


# -------------------------------------------------------------------------------------------------
# Pairs one after the other: the contacts of all pairs at once, wherever geoms touch.

IN_TURN = np.array([[0, 1], [1, 2], [3, 0], [2, 3]])
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
    got, want = one(model, data, None, IN_TURN), collide(model, data, None, IN_TURN)
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
        got = contacts.one_by_one(collide)(model_of(margins=margins), data_of(), None, IN_TURN[1:2])
        gap[margins] = float(np.abs(got[1]).max())
    first, second, none = gap.values()
    assert first == second > 0 == none


def test_a_nan_reaches_the_contacts():
    places = PLACES.copy()
    places[0] = np.nan
    dist, *_ = contacts.one_by_one(collide)(model_of(), data_of(places), None, IN_TURN)
    np.testing.assert_array_equal(
        np.isnan(dist), [True] * 2 + [False] * 2 + [True] * 2 + [False] * 2
    )


def test_pairs_with_margins_of_their_own_go_to_mjx(monkeypatch):
    monkeypatch.setattr(contacts, "by_engine", lambda *_, **__: pytest.fail("one after the other"))
    model, data = model_of(num_pairs=1), data_of()
    got = contacts.one_by_one(collide)(model, data, None, IN_TURN)
    jax.tree.map(np.testing.assert_array_equal, got, collide(model, data, None, IN_TURN))

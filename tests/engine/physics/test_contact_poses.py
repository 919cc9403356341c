"""Contacts of two geoms in poses of many families, and in all that ever failed, against C MuJoCo's.

``python -m experiments.checks.contacts`` compares as many poses as one likes. ``poses.csv`` has
those in which MJX's contacts, or ours of before, differed: types of geoms, margin, family, sizes,
and the place and quaternion of the second geom in the first's frame.
"""

import csv
import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scipy.spatial.transform import Rotation

from experiments.checks import contacts as checks
from mjx_reinforce.engine.physics import contacts, mjx_internals
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.envs import models

#: Pairs whose functions are ours alone, and their margins.
PAIRS = {
    ("sphere", "box"): 0.02,
    ("capsule", "box"): 0.02,
    ("box", "box"): 0.0,
    ("plane", "cylinder"): 0.0,
    ("capsule", "capsule"): 0.02,
}


@functools.cache
def two_geoms(first, second):
    return checks.TwoGeoms(first, second, PAIRS[first, second])


def pinned(pair):
    with (Path(__file__).parent / "poses.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if tuple(row[:2]) == pair]
    numbers = np.array([row[4:] for row in rows], float).reshape(-1, 13)
    for row in numbers:
        turn = Rotation.from_quat(row[9:], scalar_first=True).as_matrix()
        place = np.stack([np.zeros(3), row[6:9]])
        yield checks.Pose(row[:6].reshape(2, 3), place, np.stack([np.eye(3), turn]))


def along_x(half, height, aside):
    """A capsule of a half length along x, and a box above it, as the census of models had them."""
    sizes = np.array([[0.02, half, 0], [0.2, 0.15, 0.1]])
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    places = np.array([[0, aside, height], [0, 0, 1]])
    return checks.Pose(sizes, places, np.stack([turn, np.eye(3)]))


#: Longer than the box, through it, and inside it.
CENSUS = [along_x(2, 0.881, 0.07), along_x(2, 1, 0.07), along_x(0.1, 0.881, 0), along_x(0.1, 1, 0)]


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_contacts_are_those_of_c(pair):
    with jax.enable_x64(True):
        geoms = two_geoms(*pair)
        sample = list(checks.outcomes(geoms, 1, seed=5))
        poses = [*pinned(pair), *(CENSUS if pair == ("capsule", "box") else [])]
        found = geoms.by_us([*poses, *(x.pose for x in sample)])[: len(poses)]
    for number, (pose, ours) in enumerate(zip(poses, found, strict=True)):
        assert checks.error(ours, geoms.by_c(pose)) < checks.EQUAL, number
    sample = [x for x in sample if x.decided and not is_known(pair, x.pose)]
    assert [(x.family, x.error) for x in sample if not x.error < checks.EQUAL] == []
    assert sum(x.touches for x in sample) > 60


def is_collided(pair):
    """Whether MJX collides two geoms, and the product accepts it."""
    types = tuple(mjx.GeomType[x.upper()] for x in pair)
    return mjx_internals.has_collider(*types) and types not in contacts.UNLIKE_C


def is_known(pair, pose):
    """Parallel capsules and cylinders sunk in a plane, see contacts.py."""
    if pair == ("capsule", "capsule"):
        return np.linalg.norm(np.cross(*pose.mat[:, :, 2])) < 1.1e-4
    radius, half = pose.size[1, :2]
    needed = 6 * radius * half / np.hypot(3 * radius, 4 * half)
    axis, place = pose.mat[0].T @ pose.mat[1, :, 2], pose.mat[0].T @ (pose.pos[1] - pose.pos[0])
    lowest = place[2] - half * abs(axis[2]) - radius * np.hypot(*axis[:2])
    return pair == ("plane", "cylinder") and lowest < -0.99 * needed


def test_what_is_not_cs_is_refused():
    """Of the pairs that MJX collides, if they can meet."""
    kinds = itertools.combinations_with_replacement(checks.TYPES, 2)
    pairs = {pair: tuple(mjx.GeomType[x.upper()] for x in pair) for pair in kinds}
    refused = {pair for pair, types in pairs.items() if types in contacts.UNLIKE_C}
    assert len(refused) == len(contacts.UNLIKE_C)
    for first, second in refused:
        with pytest.raises(ValueError, match=rf"{second} on {first}, .* MJX finds .*; keep"):
            models.to_mjx(checks.TwoGeoms(first, second).model, "pair")


@pytest.mark.parametrize("pair", [("sphere", "box"), ("capsule", "box"), ("box", "box")])
def test_margins_of_boxes(pair):
    model = checks.TwoGeoms(*pair, margin=0.01).model
    if pair == ("box", "box"):
        with pytest.raises(ValueError, match=r"box on box .*margin.*; remove margin and gap"):
            models.to_mjx(model, "pair")
    else:
        models.to_mjx(model, "pair")


#: Under elliptic cones MJX's solver multiplies all contacts, also those that are none, by zero.
ELLIPTIC = """
<mujoco>
  <option cone="elliptic" timestep=".004" tolerance="0"/>
  <worldbody>
    <geom type="box" size=".3 .3 .1"/>
    <body pos="0 0 .199"><freejoint/><geom type="box" size=".1 .12 .1"/></body>
    <body pos=".6 0 .3" euler="0 20 30"><freejoint/>
      <geom type="capsule" size=".03 .1"/><geom pos="0 .1 0" size=".04"/></body>
    <body pos="0 .21 .129" euler="0 90 0"><freejoint/><geom type="capsule" size=".03 .1"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.slow
def test_elliptic_cones_with_contacts_that_are_none():
    model = mujoco.MjModel.from_xml_string(ELLIPTIC)
    data = mujoco.MjData(model)
    with jax.enable_x64(True):
        converted = models.to_mjx(model, "boxes")
        start = models.make_data(model)
        step = jax.jit(jax.vmap(functools.partial(physics.step, converted)))
        ours = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), start)
        touching = 0
        for _ in range(15):
            mujoco.mj_step(model, data)
            ours = step(ours)
            touching = max(touching, data.ncon)
            for qpos, qvel in zip(ours.qpos, ours.qvel, strict=True):
                np.testing.assert_allclose(qpos, data.qpos, atol=1e-7)
                np.testing.assert_allclose(qvel, data.qvel, atol=1e-6)
    assert touching >= 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "pair",
    [x for x in itertools.combinations_with_replacement(checks.TYPES, 2) if is_collided(x)],
    ids="-".join,
)
def test_contacts_that_are_none_are_finite(pair):
    """The solver reads their places and frames as well."""
    with jax.enable_x64(True):
        geoms = checks.TwoGeoms(*pair)
        shown = geoms.slots([x.pose for x in checks.outcomes(geoms, 1, seed=6)])
    assert np.isfinite(shown).all()
    if pair == ("plane", "capsule"):
        return  # C's own frame of a capsule upright on a tilted plane is not orthonormal
    frames = shown[..., 4:].reshape(-1, 3, 3)
    products = frames @ frames.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-6)

"""Contacts of every pair of types of geoms that is right, in five poses, against C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_reinforce.envs import models
from mjx_reinforce.physics import contacts
from mjx_reinforce.physics.mjx_internals import jax_fields

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
    """Flat, on edge, nearly flat and deep, the same and shallow, and side by side: [5, 7]."""
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
    return np.array(rows)


def compiled(first, second):
    xml = PAIR.format(GEOMS[first], GEOMS[second])
    return mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]


RIGHT = [
    *(("plane", x) for x in ("box", "cylinder", "sphere", "capsule", "ellipsoid")),
    *(("cylinder", x) for x in ("sphere", "capsule")),
    *(("sphere", x) for x in ("sphere", "capsule")),
    ("capsule", "capsule"),
]


@pytest.mark.parametrize("pair", RIGHT, ids="-".join)
def test_contacts_are_those_of_mujoco(pair):
    model, qpos = compiled(*pair), poses(*pair)
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    with jax.enable_x64(True):
        mx = models.to_mjx(model, "pair")
        start = models.make_data(mx)

        def collide(place):
            found = contacts.fwd_position(mx, start.replace(qpos=jnp.append(place, 0.0)))
            return jax_fields(found).contact

        unoptimized = {"xla_backend_optimization_level": 0}
        found = jax.jit(jax.vmap(collide), compiler_options=unoptimized)(qpos)
        found = jax.tree.map(np.asarray, found)
    touching = 0
    for i, place in enumerate(qpos):
        data.qpos[:7] = place
        mujoco.mj_forward(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        touches = np.flatnonzero(found.dist[i] < 0)
        ours = [
            np.concatenate([found.dist[i, k, None], found.pos[i, k], found.frame[i, k].ravel()])
            for k in touches
        ]
        theirs = [np.concatenate([[c.dist], c.pos, c.frame]) for c in data.contact]
        assert len(ours) == len(theirs), (i, ours, theirs)
        touching += bool(ours)
        key = lambda row: tuple(np.round(row[:4], 4) + 0.0)  # noqa: E731
        for mine, exact in zip(sorted(ours, key=key), sorted(theirs, key=key), strict=True):
            np.testing.assert_allclose(mine, exact, rtol=0, atol=TOLERANCE.get(pair, 1e-12))
    assert touching >= 4


def test_the_search_along_a_capsule_is_written_out():
    """A loop in XLA stalls jaxlib 0.10.2."""
    mx = models.to_mjx(compiled("cylinder", "capsule"), "pair")
    program = jax.jit(lambda data: contacts.fwd_position(mx, data)).lower(models.make_data(mx))
    assert "stablehlo.while" not in program.as_text()


@pytest.mark.parametrize("pair", contacts.UNLIKE_C)
def test_pairs_that_mjx_gets_wrong_are_refused_if_they_can_meet(pair):
    names = [kind.name.lower() for kind in pair]
    model = compiled(*names)
    with pytest.raises(ValueError, match="which MJX gets wrong; keep that pair apart"):
        models.to_mjx(model, "pair")
    model.geom_contype[0] = model.geom_conaffinity[0] = 0
    models.to_mjx(model, "pair")

"""Contacts of every pair of types of geoms that is right, in many poses, against C MuJoCo."""

import contextlib
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scenes import SCENE
from scipy.spatial.transform import Rotation

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import contact_rows, contacts, rows
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact
from mjx_reinforce.engine.scalar import writing_out
from mjx_reinforce.envs import models
from mjx_reinforce.envs.refusals import UnsupportedError

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
        start = contacts.make_data(model, None)

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
    for i, found_by_c in enumerate(theirs):
        near = np.inf if pair in ROUND else 0
        own = found.geom[i, :, 0] % len(RIGHT) == number
        touches = np.flatnonzero((found.dist[i] < near) & own)
        ours = [
            np.concatenate([found.dist[i, k, None], found.pos[i, k], found.frame[i, k].ravel()])
            for k in touches
        ]
        exact = [row for of, row in found_by_c if of == number]
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


@pytest.mark.parametrize("pair", ["sphere-ellipsoid", "cylinder-cylinder"])
def test_pairs_that_mjx_gets_wrong_are_refused_if_they_can_meet(pair):
    model = compiled(*pair.split("-"))
    with pytest.raises(UnsupportedError, match=r"which MJX finds in ten steps.*; keep those apart"):
        models.to_mjx(model, "pair")
    model.geom_contype[0] = model.geom_conaffinity[0] = 0
    models.to_mjx(model, "pair")


# -------------------------------------------------------------------------------------------------
# Which degrees of freedom a contact couples.


@pytest.mark.slow
def test_what_no_contact_couples_is_zero_in_every_jacobian():
    """Against MJX's rows with all contacts touching, at random poses."""
    env = envs.make("Ant-v5")
    model = mjx.put_model(env.mj_model, impl="jax")
    couplings = contact_rows.couplings(model)

    @jax.jit
    def jacobians(qpos):
        data = mjx.make_data(env.mj_model, impl="jax").replace(qpos=qpos)
        data = mjx.collision(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))
        contact = jax_fields(data).contact
        touching = contact.replace(dist=jnp.full_like(contact.dist, -0.01))
        data = mjx.make_constraint(model, with_contact(data, touching, contact.dim))
        return jax_fields(data).efc_J

    fields = jax_fields(mjx.make_data(env.mj_model, impl="jax"))
    others = fields.ne + fields.nf + fields.nl
    division = contact_rows.blocks(others, fields.contact.dim, couplings)
    rng, first = np.random.default_rng(0), others
    poses = env.mj_model.qpos0 + 0.1 * rng.standard_normal((3, model.nq))
    rows = sum(np.abs(jacobians(pose)) for pose in poses)
    for group in division.groups:
        last = first + group.contacts * len(group.pyramid)
        block = np.asarray(rows[first:last]).reshape(group.contacts, -1, model.nv).max(1)
        found = (block[:, :, None] * block[:, None, :]).max(0) > 0
        assert not np.any(found & ~group.coupling)
        first = last
    assert first == len(rows)


def test_two_legs_of_ant_meet_in_no_contact():
    """Each touches the floor alone: of 105 entries of the Hessian 24 are zero."""
    model = mjx.put_model(envs.make("Ant-v5").mj_model, impl="jax")
    ((dim, coupled),) = contact_rows.couplings(model).items()
    assert (dim, np.tril(coupled).sum()) == (3, 105 - 24)


# -------------------------------------------------------------------------------------------------
# Constraint rows, at once and one contact after the other, against C MuJoCo's.

MODEL = mujoco.MjModel.from_xml_string(SCENE)  # pyright: ignore
MODEL.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def random_state(seed):
    """C's data of a random state in which something touches."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(MODEL)  # pyright: ignore
    data.qpos[:] = MODEL.qpos0 + 0.15 * rng.standard_normal(MODEL.nq)
    data.qpos[8] -= 0.25  # the cylinder touches
    data.qvel[:] = rng.standard_normal(MODEL.nv)
    mujoco.mj_forward(MODEL, data)  # pyright: ignore
    return data


@pytest.fixture(scope="module", params=[writing_out, contextlib.nullcontext])
def made(request):
    """Makes the rows of C's data: Jacobian, reference, mass, position."""
    model = mjx.put_model(MODEL, impl="jax")

    @jax.jit
    def make(data):
        fields = jax_fields(rows.make_constraint(model, data))
        return fields.efc_J, fields.efc_aref, fields.efc_D, fields.efc_pos

    def of(data):
        with request.param():
            return [np.asarray(x) for x in make(mjx.put_data(MODEL, data, impl="jax"))]

    return of


@pytest.mark.parametrize("seed", range(4))
def test_rows_are_those_of_c(made, seed):
    """Each of C's rows that is not zero is among ours, which has more rows of zeros than C."""
    data = random_state(seed)
    jacobian, reference, mass, position = made(data)
    theirs = data.efc_J.reshape(data.nefc, MODEL.nv)
    ours = set(np.flatnonzero(np.any(np.abs(jacobian) > 1e-5, axis=1)).tolist())
    some = np.any(np.abs(theirs) > 1e-5, axis=1)
    assert len(ours) == some.sum() > 6
    of_c = (theirs, data.efc_aref, data.efc_D, data.efc_pos)
    for row, aref, d, pos in zip(*(x[some] for x in of_c), strict=True):
        distance = np.abs(jacobian - row).max(axis=1)
        place = min(ours, key=lambda i: distance[i] + abs(reference[i] - aref))
        ours.remove(place)
        np.testing.assert_allclose(jacobian[place], row, atol=1e-5)
        np.testing.assert_allclose(reference[place], aref, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(mass[place], d, rtol=1e-3)
        np.testing.assert_allclose(position[place], pos, atol=1e-5)


def test_states_reach_limits_and_contacts_of_every_dimension():
    """What the test above compares."""
    found = {int(dim) for seed in range(4) for dim in random_state(seed).contact.dim}
    assert found >= {1, 3, 4, 6}
    kinds = {int(kind) for seed in range(4) for kind in random_state(seed).efc_type}
    assert int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT) in kinds


HELD = """
<mujoco><worldbody>
  <body name="a" pos="0 0 1">
    <freejoint/><geom size=".1"/><site name="a" pos=".1 .02 0" euler="20 0 0"/>
  </body>
  <body name="b" pos=".5 0 1">
    <joint type="ball"/><geom size=".1"/><site name="b" pos="-.1 .02 .01"/>
    <body name="c" pos=".3 0 0"><joint axis="0 1 0"/><geom size=".05"/></body>
  </body>
  <body name="hand" mocap="true" pos=".9 .3 1" euler="0 60 0"/>
</worldbody><equality>
  <weld site1="a" site2="b" torquescale=".4"/><connect body1="a" body2="c" anchor=".1 0 .02"/>
  <weld body1="c" body2="hand" relpose=".1 0 0 1 0 0 0"/>
</equality></mujoco>
"""


@pytest.mark.slow
def test_connects_and_welds_ask_for_what_c_asks():
    """With the change of the Jacobian, which MJX leaves out."""
    model = mujoco.MjModel.from_xml_string(HELD)  # pyright: ignore
    data, rng = mujoco.MjData(model), np.random.default_rng(0)  # pyright: ignore
    mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 0.3)  # pyright: ignore
    data.qvel[:] = 3 * rng.standard_normal(model.nv)
    mujoco.mj_forward(model, data)  # pyright: ignore
    with jax.enable_x64(True):
        ours, start = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")

        @jax.jit
        def both(data):
            made = rows.make_constraint(ours, data), mjx.make_constraint(ours, data)
            return [jax_fields(each).efc_aref for each in made]

        found, plain = both(start)
    connect_first = [*range(6, 9), *range(6), *range(9, 15)]
    theirs = data.efc_aref[connect_first]
    np.testing.assert_allclose(found[:15], theirs, rtol=1e-10, atol=1e-10)
    assert np.abs(found[:15] - plain[:15]).max() > 1


STILL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/><geom name="post" size=".2"/>
    <body mocap="true" pos="0 0 .05">
      <geom name="tray" type="box" size=".1 .1 .1"/>
      <body pos="0 0 .2"><joint axis="0 1 0"/><geom type="capsule" size=".06 .1"/></body>
    </body>
    <body mocap="true" pos=".1 0 .05"><geom type="box" size=".1 .1 .1"/></body>
    <body pos=".1 0 .2"><freejoint/><geom size=".06"/></body>
  </worldbody>
  <contact><pair geom1="floor" geom2="tray"/><pair geom1="floor" geom2="post"/></contact>
</mujoco>"""


@pytest.mark.slow
def test_bodies_that_nothing_moves_do_not_touch():
    """C leaves out contacts of mocap bodies with the world and with each other."""
    model = mujoco.MjModel.from_xml_string(STILL)  # pyright: ignore
    data = mujoco.MjData(model)  # pyright: ignore
    mujoco.mj_forward(model, data)  # pyright: ignore
    is_included = data.contact.exclude == 0
    assert not is_included.all()
    ours, start = mjx.put_model(model, impl="jax"), contacts.make_data(model, None)
    found = jax.jit(lambda data: contacts.fwd_position(ours, data))(start)
    contact = jax_fields(found).contact
    geoms = np.asarray(contact.geom)[np.asarray(contact.dist) < 0]
    assert {*map(tuple, geoms)} == {*map(tuple, data.contact.geom[is_included])}

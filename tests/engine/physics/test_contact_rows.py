"""Products with the Jacobian, at once and by contact, against NumPy's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from scenes import SCENE

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import contact_rows, rows, touching
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact

DIMS = np.array([3, 1, 6, 4, 3, 1])
NV = 5
#: Any contact may couple any degrees of freedom.
ANY = np.ones((NV, NV), bool)


@pytest.fixture(params=["in turn", "at once"])
def division(request, monkeypatch):
    def choose(one, whole, *operands, may_unroll):
        return (one if request.param == "in turn" else whole)(*operands)

    monkeypatch.setattr(contact_rows, "by_engine", choose)
    return contact_rows.blocks(2, DIMS, dict.fromkeys((1, 3, 4, 6), ANY))


def rows_of(division):
    """Which contact, in the order of the groups, each row is of; -1 for those of none."""
    sizes = [len(group.pyramid) for group in division.groups for _ in range(group.contacts)]
    return np.r_[[-1] * division.others, np.repeat(np.arange(len(sizes)), sizes)]


def jacobian_of(division):
    """Random rows; those of a contact are the edges of a pyramid."""
    rng, parts = np.random.default_rng(0), []
    for group in division.groups:
        bases = rng.standard_normal((group.contacts, group.pyramid.shape[1], NV))
        parts.append((group.pyramid @ bases).reshape(-1, NV))
    return np.concatenate([rng.standard_normal((division.others, NV)), *parts])


def problem(division, pushing):
    """Random rows, of which those of contacts that do not push have no mass and no force."""
    rng, contact = np.random.default_rng(0), rows_of(division)
    pushes = (contact < 0) | np.isin(contact, pushing)
    jacobian, force = jacobian_of(division), rng.standard_normal(len(contact))
    mass = rng.uniform(1, 2, len(contact)) * pushes
    mass[5] = 0  # a row of a contact that pushes by its others
    return jacobian, mass, force * pushes


def with_bases(division, rows, touching=True):
    touches = jnp.broadcast_to(jnp.asarray(touching), len(DIMS))
    return contact_rows.with_bases(division, jnp.asarray(rows), touches)


def test_rows_of_a_contact_are_two_for_each_direction_of_friction():
    couplings = dict.fromkeys((1, 3, 4, 6), ANY)
    made = contact_rows.blocks(7, DIMS, couplings, may_unroll=False)
    sizes = [(group.contacts, group.pyramid.shape) for group in made.groups]
    assert sizes == [(2, (1, 1)), (2, (4, 3)), (1, (6, 4)), (1, (10, 6))]
    assert (made.others, made.may_unroll) == (7, False)
    (group,) = contact_rows.blocks(0, np.array([3]), couplings).groups
    np.testing.assert_array_equal(group.pyramid, [[1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1]])


@pytest.mark.parametrize("pushing", [[], [2, 3, 5], range(6)])
def test_weighted(division, pushing):
    rows, mass, force = problem(division, [*pushing])
    start = np.eye(NV) + 1
    jacobian = with_bases(division, rows)
    made = contact_rows.weighted(
        division, jnp.asarray(start), jacobian, jnp.asarray(mass), jnp.asarray(force)
    )
    np.testing.assert_allclose(made[0], start + rows.T @ np.diag(mass) @ rows, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(made[1], rows.T @ force, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("touching", [[], [0, 2, 4], range(6)])
def test_along(division, touching):
    """Rows of contacts that do not touch are zero."""
    rows, direction = jacobian_of(division), np.arange(1.0, NV + 1)
    contact = rows_of(division)
    touches = np.isin(np.arange(6), [*touching])
    rows[(contact >= 0) & ~touches[contact]] = 0
    jacobian = with_bases(division, rows, touches)
    made = contact_rows.along(division, jacobian, jnp.asarray(direction), jnp.asarray(touches))
    np.testing.assert_allclose(made, rows @ direction, rtol=1e-5, atol=1e-5)


def test_a_contact_that_does_not_touch_costs_no_product(monkeypatch):
    """Its rows are not read: they may hold anything."""
    monkeypatch.setattr(contact_rows, "by_engine", lambda one, _, *x, may_unroll: one(*x))
    division = contact_rows.blocks(0, np.array([3, 3]), {3: ANY})
    rows, touching = jnp.ones((8, NV)).at[4:].set(jnp.nan), jnp.array([True, False])
    jacobian = contact_rows.with_bases(division, rows, touching)
    made = contact_rows.along(division, jacobian, jnp.ones(NV), touching)
    np.testing.assert_array_equal(made, [NV] * 4 + [0] * 4)


@pytest.mark.parametrize("env_id", ["Ant-v5", pytest.param("Humanoid-v5", marks=pytest.mark.slow)])
def test_what_no_contact_couples_is_zero_in_every_jacobian(env_id):
    """Against MJX's rows with all contacts touching, at random poses."""
    env = envs.make(env_id)
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
        assert not np.any(found & ~group.coupled)
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


def in_turn(one, whole, *operands, may_unroll):
    return one(*operands)


def at_once(one, whole, *operands, may_unroll):
    return whole(*operands)


@pytest.fixture(scope="module", params=[in_turn, at_once])
def made(request):
    """Makes the rows of C's data: Jacobian, reference, mass, position."""
    model = mjx.put_model(MODEL, impl="jax")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "by_engine", request.param)

        @jax.jit
        def make(data):
            fields = jax_fields(rows.make_constraint(model, data))
            return fields.efc_J, fields.efc_aref, fields.efc_D, fields.efc_pos

        def of(data):
            return [np.asarray(x) for x in make(mjx.put_data(MODEL, data, impl="jax"))]

        of(random_state(0))
        yield of


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


def test_a_disabled_constraint_has_no_row():
    disabled = mjx.put_model(MODEL, impl="jax")
    flag = mjx.DisableBit.CONSTRAINT
    disabled = disabled.replace(opt=disabled.opt.replace(disableflags=flag))
    data = mjx.put_data(MODEL, random_state(0), impl="jax")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "by_engine", lambda *_, **__: pytest.fail("it makes rows"))
        assert jnp.size(jax_fields(rows.make_constraint(disabled, data)).efc_J) == 0


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


# -------------------------------------------------------------------------------------------------
# Contacts that touch are brought together, and what is found for them goes back.


def contacts_of(env_id):
    data = mjx.make_data(envs.make(env_id).mj_model, impl="jax")
    contact = jax_fields(data).contact
    size = len(contact.dim)
    return contact.replace(
        dist=-1.0 - jnp.arange(size), pos=jnp.arange(3 * size, dtype=float).reshape(size, 3)
    )


def test_those_that_touch_come_first_in_their_order():
    contacts, room = contacts_of("Ant-v5"), 6
    pack = jax.jit(lambda touches: touching._pack(contacts, touches, room))
    random = np.random.default_rng(0)
    for chance in np.repeat([0.0, 0.1, 0.3, 1.0], 20):
        touches = random.random(len(contacts.dim)) < chance
        packed, count = pack(touches)
        chosen = np.flatnonzero(touches)[:room]
        assert count == touches.sum()
        np.testing.assert_array_equal(packed.dist[: len(chosen)], contacts.dist[chosen])
        np.testing.assert_array_equal(packed.pos[: len(chosen)], contacts.pos[chosen])
        assert np.all(packed.dist[len(chosen) :] == np.inf)


def test_values_go_back_to_the_contacts_that_touch():
    random = np.random.default_rng(1)
    unpack = jax.jit(touching._unpack)
    for _ in range(20):
        touches = random.random(25) < 0.15
        chosen = np.flatnonzero(touches)[:6]
        values = random.standard_normal((6, 4))
        expected = np.zeros((25, 4), np.float32)
        expected[chosen] = values[: len(chosen)]
        if len(chosen) == touches.sum():  # there is room
            given = unpack(values.astype(np.float32), touches)
            np.testing.assert_array_equal(given, expected.reshape(-1))


@pytest.mark.parametrize(
    ("env_id", "contacts"),
    [("Hopper-v5", 3), ("Pusher-v5", None)],
    ids=["all have room", "few rows would be saved"],
)
def test_where_it_is_not_worth_it_the_solver_has_the_data_as_it_is(env_id, contacts):
    env, asked = envs.make(env_id), []
    data = mjx.make_data(env.mj_model, impl="jax")
    contact = jax_fields(data).contact
    few = jax.tree.map(lambda x: x[:contacts], contact)
    data = with_contact(data, few, contact.dim[:contacts])
    touching.solve_touching(lambda *given: asked.extend(given), env.model, data)
    assert asked[0] is env.model
    assert asked[1] is data

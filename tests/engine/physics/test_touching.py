"""Contacts that touch are brought together, and what is found for them goes back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx

from mjx_reinforce import envs
from mjx_reinforce.engine.physics import touching
from mjx_reinforce.engine.physics.mjx_internals import jax_fields, with_contact


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

"""Machine code visits pairs of geoms, contacts and rows in loops, and skips what is apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import FEET, Scene

from mjx_reinforce.engine.physics import touching
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.engine.play import available
from mjx_reinforce.engine.play.program import machine_map

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)
pytestmark = [pytest.mark.cpu, pytest.mark.slow]


def forwards(env):
    """What the physics makes of 64 random states, by machine code and by ``vmap``."""
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64)).info
    in_machine_code = machine_map(env.forward, jax.tree.map(lambda x: x[0], starts))
    both = in_machine_code, jax.vmap(env.forward)
    return tuple(np.asarray(jax.jit(mapped)(starts)) for mapped in both)


def assert_equal(ours, theirs):
    scale = 1 + np.abs(theirs).max(axis=1)
    assert np.max(np.abs(ours - theirs).max(axis=1) / scale) < 1e-11


def test_contacts(monkeypatch):
    """Where there is room in `touching` for those that touch, and where there is not."""
    room = 2
    monkeypatch.setattr(touching, "_room", lambda model: room)
    with jax.enable_x64(True):
        env = Scene(FEET)
        ours, theirs = forwards(env)
    jax.clear_caches()
    dims = jax_fields(env.data).contact.dim
    touches = theirs[:, -len(dims) :]
    assert sorted(np.unique(dims)) == [1, 3, 4, 6]
    for dim in np.unique(dims):
        assert 0 < touches[:, dims == dim].mean() < 1, dim
    most = np.max([touches[:, dims == dim].sum(axis=1) for dim in np.unique(dims)], axis=0)
    assert {room - 1, room, room + 1} <= {*most.astype(int)}
    np.testing.assert_array_equal(ours[:, -len(dims) :], touches)
    assert_equal(ours, theirs)


#: Models made for MJX say how many pairs and contacts to look at: those that are nearest.
NEAREST = """
<mujoco>
  <custom>
    <numeric name="max_geom_pairs" data="2"/><numeric name="max_contact_points" data="3"/>
  </custom>
  <worldbody><geom type="plane" size="5 5 1"/>{}</worldbody>
</mujoco>""".format(
    "".join(
        f"""<body pos="{x} 0 0"><joint type="slide" axis="1 0 0"/>
        <joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.15"/></body>"""
        for x in (0.0, 0.2, 0.4)
    )
)


def test_the_nearest_pairs_and_contacts():
    with jax.enable_x64(True):
        ours, theirs = forwards(Scene(NEAREST))
    jax.clear_caches()
    assert {1, 2, 3} <= {*theirs[:, -3:].sum(axis=1).astype(int)}
    assert_equal(ours, theirs)


BALL = """
<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1"/></body>
</worldbody></mujoco>"""


class LostBall(Scene):
    """Where the ball is NaN, its acceleration and the force on it are."""

    def forward(self, info):
        qpos, *others = info
        return super().forward((jnp.where(qpos > 0.1, jnp.nan, qpos), *others))


def test_a_nan_gets_to_the_acceleration():
    ours, theirs = forwards(LostBall(BALL))
    assert 0 < np.isnan(theirs).any(axis=1).sum() < 64
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))

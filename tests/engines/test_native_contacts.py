"""Machine code visits pairs of geoms, contacts and rows in loops, and skips what is apart."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act
from scenes import MANY_FEET, SCENE, Scene

from mjx_reinforce.engines import episode, rollouts
from mjx_reinforce.engines.native import available, rollout
from mjx_reinforce.physics import touching
from mjx_reinforce.physics.mjx_internals import jax_fields

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


def played(env):
    """What 64 states show after a step, by machine code and by ``vmap``."""
    actor, act, distribution = actor_and_act(env, ())

    def play(engine):
        roll = lambda key: engine(  # noqa: E731
            env, act, actor, distribution, key, num_episodes=64, horizon=2
        )
        return np.asarray(jax.jit(roll)(jax.random.key(0)).observation[1])

    return play(rollout.rollout), play(rollouts.rollout)


@pytest.mark.cpu
@pytest.mark.parametrize(("xml", "room"), [(SCENE, 2), (MANY_FEET, 3)], ids=["all kinds", "feet"])
def test_contacts(xml, room, monkeypatch):
    """Where there is room in `touching` for those that touch, and where there is not."""
    monkeypatch.setattr(touching, "_room", lambda model: room)
    with jax.enable_x64(True):
        env = Scene(xml)
        ours, theirs = played(env)
        keys = episode.episode_keys(jax.random.key(0), len(theirs))
        starts, _ = jax.vmap(functools.partial(episode.begin, env))(keys)
        forward = jax.jit(jax.vmap(env.forward, in_axes=(0, None)))
        moved = [np.asarray(forward(starts.info, x)) for x in (1e-15, 1e-14, 1e-13, -1e-13, -1e-12)]
    jax.clear_caches()
    # A capsule in a cylinder jumps between ways out in some of these states, for any rounding.
    scale = 1 + np.abs(theirs).max(axis=1)
    steady = [np.abs(x - theirs).max(axis=1) / scale < 1e-9 for x in moved]
    steady = np.all(steady, axis=0)
    assert steady.sum() > 48
    ours, theirs = ours[steady], theirs[steady]
    dims = jax_fields(env.data).contact.dim
    touches = theirs[:, -len(dims) :]
    for dim in np.unique(dims):
        assert 0 < touches[:, dims == dim].mean() < 1, dim
    most = np.max([touches[:, dims == dim].sum(axis=1) for dim in np.unique(dims)], axis=0)
    assert {room - 1, room, room + 1} <= {*most.astype(int)}
    np.testing.assert_array_equal(ours[:, -len(dims) :], touches)
    assert np.max(np.abs(ours - theirs).max(axis=1) / scale[steady]) < 1e-11


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


@pytest.mark.cpu
def test_the_nearest_pairs_and_contacts():
    with jax.enable_x64(True):
        env = Scene(NEAREST)
        ours, theirs = played(env)
    jax.clear_caches()
    touches = theirs[:, -3:].sum(axis=1)
    assert {1, 2, 3} <= {*touches.astype(int)}
    scale = 1 + np.abs(theirs).max(axis=1)
    assert np.max(np.abs(ours - theirs).max(axis=1) / scale) < 1e-11


BALL = """
<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1"/></body>
</worldbody></mujoco>"""


class LostBall(Scene):
    """Where the ball is NaN, only its acceleration and the force on it show that."""

    def reset(self, rng):
        state = super().reset(rng)
        qpos, *others = state.info
        return state.replace(info=(jnp.where(qpos > 0.1, jnp.nan, qpos), *others))


def test_a_nan_gets_to_the_acceleration():
    env = LostBall(BALL)
    actor, act, distribution = actor_and_act(env, ())

    def broken(engine):
        roll = lambda key: engine(  # noqa: E731
            env, act, actor, distribution, key, num_episodes=64, horizon=2
        )
        return np.asarray(jax.jit(roll)(jax.random.key(0)).nonfinite)

    ours, theirs = broken(rollout.rollout), broken(rollouts.rollout)
    assert 0 < theirs.sum() < 64
    np.testing.assert_array_equal(ours, theirs)

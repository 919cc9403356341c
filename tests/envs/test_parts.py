"""The parts of a robot's task: each beside an independent computation."""

import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_reinforce.envs import parts
from mjx_reinforce.envs.state import Before

ROBOT = """
<mujoco>
  <option gravity="0 0 -9"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 0.4" simple="false">
      <freejoint/>
      <geom type="box" size="0.1 0.07 0.05" pos="0.01 0 0.02"/>
      <body name="leg" pos="0.1 0 0">
        <joint name="hip" axis="0 1 0" damping="0.3" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03" friction="0.7 0.01 0.001"/>
        <body pos="0 0 -0.2">
          <joint name="knee" axis="0 1 0" damping="0.3" armature="0.01"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="hip" kp="20" kv="0.5" ctrlrange="-1 1" forcerange="-8 8"/>
    <motor joint="knee" gear="5" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
KEYS = jax.random.split(jax.random.key(0), 2000)


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ROBOT)


def drawn(function, *arguments, **options):
    """Returns what a function draws with each of many keys."""
    return jax.vmap(lambda key: function(key, *arguments, **options))(KEYS)


def assert_uniform(samples, low, high):
    """Asserts that samples [N, ...] fill the interval evenly: the ends, the mean, the deviation."""
    samples, width = np.asarray(samples, float), np.subtract(high, low)
    rounding = 1e-6 * np.maximum(np.abs(low), np.abs(high))
    assert np.all((samples >= low - rounding) & (samples <= high + rounding))
    np.testing.assert_allclose(samples.min(0), low, atol=0.01 * np.max(width))
    np.testing.assert_allclose(samples.max(0), high, atol=0.01 * np.max(width))
    np.testing.assert_allclose(samples.mean(0), np.add(low, high) / 2, atol=0.03 * np.max(width))
    np.testing.assert_allclose(samples.std(0), width / 12**0.5, atol=0.02 * np.max(width))


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [float, int, bool])
def test_a_history_drops_the_oldest_and_shows_each_by_its_age(shape, dtype):
    numbers = np.random.default_rng(0).integers(0, 2 if dtype is bool else 99, (9, *shape))
    entries = jnp.asarray(numbers.astype(dtype))
    history = parts.history(entries[0], 4)
    assert (history.shape, history.dtype) == ((4, *shape), entries.dtype)
    for number, entry in enumerate(entries):
        history = parts.append(history, entry)
        for delay in range(4):
            late = entries[max(number - delay, 0)]
            for num_steps in (delay, jnp.array(delay)):
                delayed = parts.delayed(history, num_steps)
                assert delayed.dtype == entries.dtype
                np.testing.assert_array_equal(delayed, late)


def test_a_delay_may_differ_from_number_to_number():
    history = jnp.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(parts.delayed(history, jnp.array([0, 3, 1])), [9, 1, 8])
    np.testing.assert_array_equal(parts.delayed(history, jnp.array(99)), history[0])


def test_a_number_that_is_none_stays_where_it_is():
    history = jnp.array([1.0, jnp.nan, 3.0])
    late = [float(parts.delayed(history, jnp.array(delay))) for delay in range(3)]
    np.testing.assert_array_equal(late, [3, np.nan, 1])


@pytest.mark.parametrize("delay", [3, -1])
def test_a_delay_beyond_the_history_is_refused(delay):
    with pytest.raises(ValueError, match=f"has no entry {delay} env steps before the newest"):
        parts.delayed(parts.history(0.0, 3), delay)
    with pytest.raises(ValueError, match="a length of at least 1, got 0"):
        parts.history(0.0, 0)


def test_noise_has_its_width():
    width = np.array([0.1, 2.0])
    samples = drawn(parts.uniform_noise, width)
    assert_uniform(samples / width, [-1, -1], [1, 1])
    normal = np.asarray(drawn(parts.normal_noise, width))
    np.testing.assert_allclose(normal.std(0), width, rtol=0.04)
    np.testing.assert_allclose(normal.mean(0), 0, atol=0.1)
    for noise in (samples, normal):
        assert abs(np.corrcoef(noise.T)[0, 1]) < 0.06
    assert parts.uniform_noise(KEYS[0], 0.1).shape == parts.normal_noise(KEYS[0], 0.1).shape == ()


def test_commands_are_uniform_and_rest_as_often_as_asked():
    low, high = np.array([0.0, -0.3]), np.array([1.0, 0.3])
    assert_uniform(drawn(parts.command, low, high), low, high)
    commands = np.asarray(drawn(parts.command, low, high, rest_share=0.2))
    rests = np.all(commands == 0, axis=1)
    assert rests.mean() == pytest.approx(0.2, abs=0.03)
    assert not np.any(commands[~rests] == 0)
    assert_uniform(commands[~rests], low, high)


def test_a_period_is_over_each_multiple_of_it():
    assert [bool(parts.is_due(step, 3)) for step in range(7)] == [1, 0, 0, 1, 0, 0, 1]


def test_pushes_are_uniform_where_they_are_due(model):
    assert_uniform(drawn(parts.push, 0.5, True), [-0.5, -0.5], [0.5, 0.5])
    assert not np.any(drawn(parts.push, 0.5, False))
    change = parts.push_velocity(model, jnp.array([0.3, -0.2]))
    np.testing.assert_allclose(change, [0.3, -0.2, 0, 0, 0, 0, 0, 0])


def test_only_a_free_body_is_pushed():
    slides = mujoco.MjModel.from_xml_string(ROBOT.replace("<freejoint/>", '<joint type="slide"/>'))
    with pytest.raises(ValueError, match="the model's first joint is none; return a change"):
        parts.push_velocity(slides, jnp.zeros(2))


@pytest.mark.parametrize("body", ["trunk", "leg"])
def test_sensors_in_a_body_are_those_of_c(model, body):
    rng = np.random.default_rng(1)
    data: Any = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nv)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    names = ("xmat", "cvel", "xpos", "subtree_com")
    fields = {name: jnp.asarray(getattr(data, name)) for name in names}
    view = Before(fields | {"xmat": fields["xmat"].reshape(-1, 3, 3)}, model, {})
    velocity = np.zeros(6)
    number = model.body(body).id
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, number, velocity, 1)
    np.testing.assert_allclose(parts.angular_velocity(view, body), velocity[:3], atol=1e-5)
    np.testing.assert_allclose(parts.linear_velocity(view, body), velocity[3:], atol=1e-5)
    down = data.body(body).xmat.reshape(3, 3).T @ [0, 0, -1]
    np.testing.assert_allclose(parts.gravity(view, body), down, atol=1e-6)


@pytest.mark.parametrize(
    ("gravity", "direction"), [((0, 0, 0), (0, 0, 0)), ((3, 0, -4), (0.6, 0, -0.8))]
)
def test_gravity_is_that_of_the_model(model, gravity, direction):
    tilted = SimpleNamespace(opt=SimpleNamespace(gravity=np.array(gravity, float)))
    view: Any = SimpleNamespace(mj_model=tilted, body=lambda name: SimpleNamespace(xmat=jnp.eye(3)))
    np.testing.assert_allclose(parts.gravity(view, "trunk"), direction, atol=1e-6)


def test_terms_of_a_reward():
    assert parts.tracking(0.5, 0.5) == pytest.approx(np.exp(-1))
    # legged_gym: exp(-sum of squares / tracking_sigma), which is 0.25.
    assert parts.tracking(np.array([0.3, -0.1]), 0.5) == pytest.approx(np.exp(-0.1 / 0.25))
    poses = {1: (0, 0, -1), 0.5: (0.6, 0.8, 0), 0: (0, 0, 1)}
    assert [float(parts.upright(jnp.array(x, float))) for x in poses.values()] == [*poses]
    assert parts.action_rate(jnp.array([1.0, 0]), jnp.array([0, 3.0])) == 5
    assert parts.effort(jnp.array([4.0, -3.0]), [8, 3]) == pytest.approx((0.25 + 1) / 2)


def test_a_reward_is_the_sum_of_weighted_terms():
    reward, metrics = parts.weighted({"track": 2, "rate": -0.5}, {"rate": 3.0, "track": 1.0})
    assert (float(reward), metrics) == (0.5, {"reward_track": 2.0, "reward_rate": -1.5})
    wrong = {"track": 1, "tilt": 1}
    message = "the same names: no weight for the term 'rate', no term for the weight 'tilt'"
    with pytest.raises(ValueError, match=re.escape(message)):
        parts.weighted(wrong, {"track": 1.0, "rate": 1.0})

"""The parts of a robot's task: each beside an independent computation."""

import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot import ROBOT, Robot

from mjx_reinforce.engine import rollout
from mjx_reinforce.envs import models, parts
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco
from mjx_reinforce.envs.state import Before

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


def fields_of(draw, model, *arguments, **options):
    """Returns the fields of the model in many draws, each [N, ...] as in mjModel."""
    fields = drawn(draw, model, *arguments, **options)
    for name, samples in fields.items():
        assert name in models.RANDOM
        assert samples.shape[1:] == getattr(model, name).shape
    return {name: np.asarray(samples, float) for name, samples in fields.items()}


def test_all_geoms_have_the_friction_that_is_drawn(model):
    coefficients = fields_of(parts.friction, model, 0.4, 1.0)["geom_friction"]
    assert_uniform(coefficients[:, 0, 0], 0.4, 1.0)
    np.testing.assert_array_equal(np.ptp(coefficients[..., 0], axis=1), 0)
    np.testing.assert_allclose(coefficients[0, :, 1:], model.geom_friction[:, 1:], rtol=1e-6)


def test_a_body_with_another_mass_is_one_of_another_density(model):
    fields = fields_of(parts.masses, model, 0.9, 1.1)
    factors = fields["body_mass"][:, 1:] / model.body_mass[1:]
    assert_uniform(factors, np.full(3, 0.9), np.full(3, 1.1))
    assert np.abs(np.corrcoef(factors.T) - np.eye(3)).max() < 0.1
    # MuJoCo computes them from the geoms of a model with another density.
    first = model.geom("floor").id + 1
    spec = mujoco.MjSpec.from_string(ROBOT)
    for geom, factor in zip(spec.geoms[first:], factors[0], strict=True):
        geom.density = 1000 * factor
    expected = spec.compile()
    np.testing.assert_allclose(fields["body_mass"][0], expected.body_mass, rtol=1e-5)
    np.testing.assert_allclose(fields["body_inertia"][0], expected.body_inertia, rtol=1e-5)


def test_the_center_of_the_root_moves_and_no_other(model):
    width = np.array([0.05, 0.02, 0.0])
    shifts = fields_of(parts.centers, model, width)["body_ipos"] - model.body_ipos
    assert_uniform(shifts[:, 1, :2], -width[:2], width[:2])
    np.testing.assert_allclose(np.delete(shifts, 1, axis=1), 0, atol=1e-8)
    np.testing.assert_allclose(shifts[:, 1, 2], 0, atol=1e-8)


@pytest.mark.parametrize(
    ("part", "field"), [(parts.armature, "dof_armature"), (parts.damping, "dof_damping")]
)
def test_joints_differ(model, part, field):
    samples = fields_of(part, model, 0.5, 1.5)[field]
    assert_uniform(samples[:, 6:] / getattr(model, field)[6:], [0.5, 0.5], [1.5, 1.5])
    assert not samples[:, :6].any()


#: A position servo, a motor, a velocity servo, and a servo of gains that do not belong together.
ACTUATORS = """
    <velocity joint="knee" kv="3"/>
    <general joint="hip" gainprm="2" biastype="affine" biasprm="0.5 -20 -0.4"/>
  </actuator>"""
#: What is multiplied of gain, constant, angle and speed, of each actuator.
MULTIPLIED = {
    "stiffness": ["gain angle", "", "", "gain angle"],
    "damping": ["speed", "", "gain speed", "speed"],
    "strength": ["gain angle speed", "gain", "gain speed", "gain constant angle speed"],
}


@pytest.mark.parametrize("quantity", MULTIPLIED)
def test_actuators_differ_in_what_belongs_together(quantity):
    model = mujoco.MjModel.from_xml_string(ROBOT.replace("</actuator>", ACTUATORS))
    fields = fields_of(parts.actuators, model, **{quantity: (0.5, 1.5)})
    gains, biases = fields["actuator_gainprm"], fields["actuator_biasprm"]
    assert not gains[..., 1:].any()
    assert not biases[..., 3:].any()
    samples = np.concatenate([gains[..., :1], biases[..., :3]], axis=-1)
    unchanged = np.c_[model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3]]
    all_factors = []
    for number, words in enumerate(MULTIPLIED[quantity]):
        is_multiplied = np.isin(["gain", "constant", "angle", "speed"], words.split())
        assert np.all(unchanged[number][is_multiplied])
        factors = samples[:, number, is_multiplied] / unchanged[number][is_multiplied]
        rest = np.broadcast_to(unchanged[number][~is_multiplied], (len(KEYS), sum(~is_multiplied)))
        np.testing.assert_allclose(samples[:, number, ~is_multiplied], rest, rtol=1e-6)
        if words:
            np.testing.assert_allclose(factors, factors[:, :1].repeat(sum(is_multiplied), 1))
            assert_uniform(factors[:, 0], 0.5, 1.5)
            all_factors.append(factors[:, 0])
    assert np.abs(np.corrcoef(all_factors) - np.eye(len(all_factors))).max() < 0.1


def test_actuators_without_ranges_are_the_model(model):
    for name, field in parts.actuators(KEYS[0], model).items():
        np.testing.assert_allclose(field, getattr(model, name), rtol=1e-6)


def test_a_muscle_is_refused():
    text = ROBOT.replace("</actuator>", '<muscle joint="hip" lengthrange="0 1"/></actuator>')
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ValueError, match=r"varies motors and servos.* yourself.* none: \[2\]$"):
        parts.actuators(KEYS[0], model)


def test_no_two_parts_write_the_same_field(model):
    """Joined by ``|``, one would be lost."""
    key = KEYS[0]
    ranges = [part(key, model, 0.9, 1.1) for part in (parts.friction, parts.masses)]
    ranges += [part(key, model, 0.9, 1.1) for part in (parts.armature, parts.damping)]
    ranges += [parts.centers(key, model, 0.1), parts.actuators(key, model)]
    fields = [name for drawn_fields in ranges for name in drawn_fields]
    assert len(fields) == len({*fields}) == 8


STEPS = 12


class Fixed:
    """No noise: the policy's output is the action."""

    def noise(self, key, shape):
        return jnp.zeros((*shape, 2))

    def sample(self, outputs, noise):
        return outputs

    mode = staticmethod(lambda outputs: outputs)


def act(params, observation):
    """Returns an action that depends on all that is observed."""
    return jnp.tanh(observation @ params)


@pytest.fixture(scope="module")
def robot():
    return Robot()


def params_of(env):
    return np.linspace(-1, 1, 2 * env.observation_size).reshape(-1, 2)


def played(engine, env):
    """Returns the observations [T, N, O] and rewards [T, N] that an engine plays."""
    params = jnp.asarray(params_of(env), jnp.result_type(float))
    options = {"num_episodes": 6, "horizon": STEPS, "engine": engine}
    trajectory = jax.jit(lambda params, key: rollout(env, act, params, Fixed(), key, **options))(
        params, jax.random.key(3)
    )
    return np.asarray(trajectory.observation), np.asarray(trajectory.reward)


@pytest.mark.slow
def test_all_engines_play_a_task_of_all_parts(robot):
    by_vmap = played("vmap", robot)
    assert len(np.unique(by_vmap[0][0, :, -1])) >= 4  # commands, some of which are 0
    for engine in ("native", "mujoco"):
        for other, expected in zip(played(engine, robot), by_vmap, strict=True):
            np.testing.assert_allclose(other, expected, rtol=1e-5, atol=2e-5)
    size = robot.observation_size // robot.frames
    older, newer = by_vmap[0][..., :size], by_vmap[0][..., size:]
    np.testing.assert_array_equal(older[0], newer[0])
    # What is seen of an episode that is over is zero.
    is_running = newer[1:].any(axis=-1)
    assert is_running.mean() > 0.5
    np.testing.assert_array_equal(older[1:][is_running], newer[:-1][is_running])


@pytest.mark.slow
def test_one_episode_in_c_mujoco_is_that_of_the_task(robot):
    key = jax.random.key(5)
    simulation = InMujoco(robot)
    state, step = jax.jit(robot.reset)(key), jax.jit(robot.step)
    np.testing.assert_allclose(simulation.reset(key), state.obs, atol=1e-6)
    for _ in range(STEPS):
        action = np.asarray(act(params_of(robot), state.obs), np.float32)
        state = step(state, action)
        observation, reward, _ = simulation.step(action)
        np.testing.assert_allclose(observation, state.obs, atol=3e-5)
        np.testing.assert_allclose(reward, state.reward, atol=1e-5)


def test_a_period_of_no_steps_is_refused():
    with pytest.raises(ValueError, match="period must be at least 1, got 0"):
        parts.is_due(3, 0)

"""Every environment against the installed Gymnasium, in float64, and the models field by field.

MuJoCo's constraint solver stops at a tolerance of 1e-8; here it goes on to the optimum, by Newton's
method for all tasks, so that what is left are differences of the models.
``experiments.checks.parity`` compares them as they are, with more states and in single precision
too.
"""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.checks.parity import __main__ as parity
from experiments.checks.parity.native import Native
from experiments.checks.parity.sides import Ours, make_peer
from experiments.checks.parity.states import draw_states
from mjx_reinforce import envs
from mjx_reinforce.engine.play import available

NUM_STATES = 64
#: CartPole-v0 is v1, cut short.
IDS = [id for id in envs.names() if id != "CartPole-v0"]
MUJOCO = [id for id in IDS if "CartPole" not in id]
#: These are compared in a newcomer's `pytest` too.
SMALL = ("InvertedPendulum-v5", "CartPole-v1", "ContinuousCartPole-v0")
#: The largest error of qpos, qvel, observation and reward.
TOLERANCE = 1e-9
#: Task -> fields of the model's options that differ on purpose.
OPTIONS = {
    "Humanoid-v5": {"solver"},  # MJX has no PGS, Newton finds the same optimum
    "HumanoidStandup-v5": {"solver"},
}


def fields(record):
    """The numbers, names and arrays of a MuJoCo structure."""
    for name in dir(record):
        value = getattr(record, name)
        if not name.startswith("_") and isinstance(value, int | float | bytes | np.ndarray):
            yield name, value


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("id", MUJOCO)
def test_model_equals_gymnasium_field_by_field(id):
    ours, theirs = envs.make(id).mj_model, gymnasium.make(id).unwrapped.model
    compared = 0
    for part in ("", "opt", "stat"):
        mine, record = (getattr(model, part) if part else model for model in (ours, theirs))
        for name, value in fields(record):
            if part != "opt" or name not in OPTIONS.get(id, ()):
                np.testing.assert_array_equal(getattr(mine, name), value, err_msg=name)
                compared += 1
    assert compared > 300


def check(ours, id):
    """Compares one step from many states, the starts, and the observation at a start."""
    theirs = parity.Theirs.play(id, states=NUM_STATES, resets=1000, seed=0, tolerance=0)
    starts = ours.starts(0, 1000)
    row = parity.reset_errors(starts, theirs.peer, theirs.starts, "float64")
    row |= parity.step_errors(ours, theirs.peer, theirs.states, theirs.expected, 2e-16)
    assert row["reset_p_value"] > 1e-4
    assert row["reset_observation"] < 1e-9
    assert row["terminated_mismatches"] == 0
    for name in ("qpos", "qvel", "observation", "reward"):
        assert row[name] < TOLERANCE, name
    return starts


@pytest.mark.parametrize(
    "id",
    [
        pytest.param(id, marks=[] if id in SMALL else pytest.mark.slow)
        for id in IDS
        if id != "InvertedPendulum-v4"  # it differs from v5 in the reward of the fall, below
    ],
)
def test_equals_gymnasium(id):
    with jax.enable_x64(True):
        ours = Ours(id, NUM_STATES)
        starts, again = check(ours, id), ours.starts(0, 1)
    np.testing.assert_array_equal(again.qpos, starts.qpos[:NUM_STATES])


@pytest.mark.parametrize("id", SMALL)
def test_machine_code_equals_gymnasium(id):
    """Tasks with contacts are held to the same physics in ``test_native_contacts.py``."""
    with jax.enable_x64(True):
        if reason := available.unavailable():
            pytest.skip(reason)
        check(Native(id, NUM_STATES), id)


@pytest.mark.parametrize("id", SMALL)
def test_states_reach_what_matters(id):
    """The states that are compared end episodes and pass limits, and not all of them."""
    peer = make_peer(id)
    states = draw_states(peer, envs.make(id).action_space, 200, seed=0)
    ended = np.mean(parity.peer_steps(peer, *states).terminated)
    assert 0.05 < ended < 0.95
    low, high = peer.limits.T
    assert np.any(states[0] > high)
    assert np.any(states[0] < low)


def test_a_wrong_distribution_is_seen():
    random = np.random.default_rng(0)
    x, y = random.uniform(-1, 1, (2, 2000, 2))
    assert parity.same_distribution(x, y) > 1e-3
    assert parity.same_distribution(x, y[np.linalg.norm(y, axis=1) < 1]) < 1e-3


def test_pusher_starts_outside_the_disc():
    env = envs.make("Pusher-v5")
    qpos, _ = jax.jit(jax.vmap(env.initial))(jax.random.split(jax.random.key(0), 20000))
    cylinder = np.asarray(qpos[:, 7:9])
    random = np.random.default_rng(0).uniform([-0.3, -0.2], [0, 0.2], (30000, 2))
    expected = random[np.linalg.norm(random, axis=1) > 0.17]
    radii = [np.linalg.norm(x, axis=1, keepdims=True) for x in (cylinder, expected)]
    assert radii[0].min() > 0.17 - 1e-6
    assert np.all(np.abs(cylinder - [-0.15, 0]) <= [0.15 + 1e-6, 0.2 + 1e-6])
    samples = [np.hstack(pair) for pair in zip((cylinder, expected), radii, strict=True)]
    assert parity.same_distribution(*samples) > 1e-3


def test_reward_of_a_fall_and_of_a_broken_state():
    for id, at_fall in (("InvertedPendulum-v5", 0.0), ("InvertedPendulum-v4", 1.0)):
        env = envs.make(id)
        play = jax.jit(lambda *state, env=env: env.step(env.set_state(*state), jnp.zeros(1)))
        fallen = play(jnp.array([0.0, 0.25]), jnp.zeros(2))
        assert (float(fallen.done), float(fallen.reward)) == (1.0, at_fall)
        broken = play(jnp.zeros(2), jnp.array([jnp.nan, 0.0]))
        assert float(broken.done) == 1.0
        assert np.isnan(broken.reward)


@pytest.mark.parametrize("sutton_barto", [False, True])
def test_reward_of_a_lost_cart(sutton_barto):
    env = envs.make("CartPole-v1", sutton_barto_reward=sutton_barto)
    up, lost = (env.step(env.set_state(jnp.array([0.0, x]), jnp.zeros(2)), 1) for x in (0.0, 0.3))
    assert (float(up.reward), float(lost.reward)) == ((0.0, -1.0) if sutton_barto else (1.0, 1.0))
    assert (float(up.done), float(lost.done)) == (0.0, 1.0)


def test_semi_implicit_euler_moves_with_the_new_velocity():
    start = jnp.array([0.0, 0.1]), jnp.array([0.5, -0.3])
    for name, which in (("euler", 0), ("semi-implicit euler", 1)):
        env = envs.make("CartPole-v1", kinematics_integrator=name)
        after = env.step(env.set_state(*start), 1).pipeline_state
        velocity = (start[1], after.qvel)[which]
        np.testing.assert_allclose(after.qpos, start[0] + 0.02 * velocity, rtol=1e-6)
    with pytest.raises(ValueError, match="Did you mean 'euler'"):
        envs.make("CartPole-v1", kinematics_integrator="eular")


def test_a_row_of_the_table():
    row = {"env": "Hopper-v5", "states": 5, "qpos": 4.16e-9, "observation": 55.3}
    assert parity.line(row) == "| Hopper-v5 | 5 | 4e-09 | 6e+01 |"

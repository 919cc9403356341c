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
#: Their steps are those of others, with other formulas, which tests/envs/test_tasks.py compares.
ALIKE = ("CartPole-v0", "InvertedPendulum-v4", "HumanoidStandup-v5", "Walker2d-v5")
#: Gymnasium has these tasks, or a cart-pole to compare. A task of ours alone has no peer.
PEERED = [id for id in envs.names() if id in gymnasium.registry or "CartPole" in id]
IDS = [id for id in PEERED if id not in ALIKE]
MUJOCO = [id for id in PEERED if "CartPole" not in id]
#: These are compared in a newcomer's `pytest` too; the first of them by machine code alone.
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
    [pytest.param(id, marks=[] if id in SMALL[1:] else pytest.mark.slow) for id in IDS],
)
def test_equals_gymnasium(id):
    with jax.enable_x64(True):
        ours = Ours(id, NUM_STATES)
        starts, again = check(ours, id), ours.starts(0, 1)
    np.testing.assert_array_equal(again.qpos, starts.qpos[:NUM_STATES])


@pytest.mark.parametrize("id", SMALL)
def test_machine_code_equals_gymnasium(id):
    """Tasks with contacts are held to the same physics in ``tests/engine/play/test_mapping.py``."""
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


@pytest.mark.slow
def test_reward_of_a_fall_and_of_a_broken_state():
    for id, at_fall in (("InvertedPendulum-v5", 0.0), ("InvertedPendulum-v4", 1.0)):
        env = envs.make(id)
        play = jax.jit(lambda *state, env=env: env.step(env.set_state(*state), jnp.zeros(1)))
        fallen = play(jnp.array([0.0, 0.25]), jnp.zeros(2))
        assert (float(fallen.done), float(fallen.reward)) == (1.0, at_fall)
        broken = play(jnp.zeros(2), jnp.array([jnp.nan, 0.0]))
        assert float(broken.done) == 1.0
        assert np.isnan(broken.reward)


def test_a_row_of_the_table():
    row = {"env": "Hopper-v5", "states": 5, "qpos": 4.16e-9, "observation": 55.3}
    assert parity.line(row) == "| Hopper-v5 | 5 | 4e-09 | 6e+01 |"

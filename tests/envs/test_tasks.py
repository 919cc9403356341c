"""Observation, reward, end and start of each task: those of Gymnasium's own code, without physics.

Both get the same made-up simulations: numbers that no step could lead to, of every field they read.
"""

import math
import re
import types
from pathlib import Path
from typing import Any

import gymnasium
import jax
import mujoco
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv

from mjx_reinforce import envs
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import Before
from mjx_reinforce.envs.views import View

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date")

FIELDS = ("xpos", "xipos", "site_xpos", "cinert", "cvel", "cfrc_ext")
FORCES = ("qfrc_actuator", "qfrc_constraint")
PLACED = {"exclude_current_positions_from_observation": False}
LIVES = {"terminate_when_unhealthy": False, "healthy_reward": 3.0}
WEIGHTS = {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.7}
PERSON = [f"include_{name}_in_observation" for name in ("cinert", "cvel", "qfrc_actuator")]
CASES = {
    "Ant-v5": [
        PLACED | LIVES | WEIGHTS,
        {"contact_cost_weight": 0.3, "contact_force_range": (-0.5, 2.0), "main_body": 3},
        {"include_cfrc_ext_in_observation": False, "healthy_z_range": (0.5, 0.9)},
    ],
    "HalfCheetah-v5": [PLACED | WEIGHTS],
    "Hopper-v5": [PLACED | LIVES | WEIGHTS, {"healthy_state_range": (-9.0, 9.0)}],
    "Humanoid-v5": [
        PLACED | LIVES | WEIGHTS | dict.fromkeys(PERSON, False),
        {"contact_cost_weight": 0.1, "contact_cost_range": (0.5, 20.0)},
        {"include_cfrc_ext_in_observation": False},
    ],
    "HumanoidStandup-v5": [
        PLACED | {"ctrl_cost_weight": 0.7, "impact_cost_weight": 0.1},
        {"impact_cost_range": (0.5, 20.0)},
    ],
    "InvertedDoublePendulum-v5": [{"healthy_reward": 3.0}],
    "InvertedPendulum-v5": [],
    "Pusher-v5": [{"reward_near_weight": 3.0, "reward_dist_weight": 5.0}],
    "Reacher-v5": [{"reward_dist_weight": 3.0, "reward_control_weight": 0.2}],
    "Swimmer-v5": [PLACED | WEIGHTS],
    "Walker2d-v5": [PLACED | LIVES | WEIGHTS, {"healthy_angle_range": (0.1, 0.3)}],
}


@pytest.fixture(scope="module", autouse=True)
def without_mjx():
    """A task's formulas need MuJoCo's model alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "to_mjx", lambda model, xml_file: None)
        yield


def states(model, init_qpos):
    """Simulations about a pose: as it is, fast, turned, lifted, and with a NaN."""
    rng, sizes = np.random.default_rng(5), mujoco.MjData(model)  # pyright: ignore

    def state(scale=1.0, height=1.1, **changes):
        made = {name: rng.normal(size=getattr(sizes, name).shape) for name in FIELDS}
        made |= {name: 20 * rng.normal(size=model.nv) for name in FORCES}
        made["cfrc_ext"] *= scale
        made["qpos"] = init_qpos + 0.1 * rng.normal(size=model.nq)
        made["qvel"] = 4 * rng.normal(size=model.nv)
        made["site_xpos"][..., 2] = height
        made["xipos"] = np.float32(made["xipos"])
        for place, value in changes.items():
            if int(place[4:]) < model.nv:
                made[place[:4]][int(place[4:])] = value
        return made

    heights = [-1.05, -0.21, -0.2, 0.0, 0.15, 0.2, 0.25, 0.7, 0.75, 0.8, 0.95, 1.0, 1.4, 2.0, 2.1]
    return [
        state(),
        state(3000.0),
        *(state(height=x, **{f"qpos{place}": x}) for place in (1, 2) for x in heights),
        *(state(qpos1=1.25, qpos2=0.11, qvel1=speed) for speed in (150.0, -150.0)),
        state(qpos1=np.nan),
        state(qvel1=np.nan),
    ]


def peer_of(id, **settings) -> Any:
    return gymnasium.make(id, **settings).unwrapped


def theirs(peer, before, after, action):
    """What Gymnasium says of a step between two simulations."""

    def fill(simulation):
        for name, value in simulation.items():
            getattr(peer.data, name)[:] = value

    def simulate(ctrl, frame_skip):
        fill(after)
        peer.data.ctrl[:] = ctrl

    fill(before)
    peer.do_simulation = simulate
    obs, reward, terminated, _, info = peer.step(action)
    return obs, reward, terminated, info


def ours(env, before, after, action):
    known = {name: before[name] for name in ("qpos", "qvel", *env.carried)}
    view = View(types.SimpleNamespace(_impl=None, **after), env.mj_model, {})
    outcome = env.outcome(Before(known, env.mj_model, {}), view, action)
    return env.observe(view), *outcome


@pytest.mark.parametrize(
    ("id", "settings"), [(id, each) for id, cases in CASES.items() for each in [{}, *cases]]
)
def test_formulas_are_gymnasiums(id, settings):
    env, peer = envs.make(id, **settings), peer_of(id, **settings)
    made = states(env.mj_model, peer.init_qpos)
    rng, ends = np.random.default_rng(6), set()
    for before, after in zip(made[-1:] + made, made, strict=False):
        action = 1.5 * rng.normal(size=env.action_size)  # beyond the actuators' bounds
        obs, reward, terminated, info = theirs(peer, before, after, action)
        mine = ours(env, before, after, action)
        np.testing.assert_allclose(mine[0], obs, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(mine[1], reward, rtol=1e-5, atol=1e-4)
        assert bool(mine[2]) == bool(terminated), after["qpos"]
        assert mine[3].keys() <= info.keys() | {"reward_survive"}
        for name in mine[3].keys() & info.keys():
            np.testing.assert_allclose(mine[3][name], info[name], rtol=1e-5, atol=1e-4)
        ends.add(bool(terminated))
    falls = any(word in id for word in ("Ant", "Hopper", "Humanoid-", "Walker", "Inverted"))
    assert ends == ({True, False} if falls and "terminate_when_unhealthy" not in settings else {0})


@pytest.mark.slow
@pytest.mark.parametrize("id", CASES)
def test_starts_are_spread_as_gymnasiums(id):
    """So wide in each entry, and uniform or normal."""
    env, peer = envs.make(id), peer_of(id)
    places = []
    peer.set_state = lambda *start: places.append(np.concatenate(start))
    peer.reset(seed=0)
    for _ in range(500):
        peer.reset_model()
    mine = jax.vmap(env.initial)(jax.random.split(jax.random.key(1), 500))
    mine, wanted = np.concatenate(mine, axis=1), np.array(places)
    spread = wanted.std(axis=0)
    np.testing.assert_allclose(mine.std(axis=0), spread, rtol=0.2, atol=1e-7)
    np.testing.assert_array_less(abs(mine.mean(axis=0) - wanted.mean(axis=0)), spread / 3 + 1e-6)
    moves = spread > 0
    mine, wanted = (x[:, moves] - x[:, moves].mean(axis=0) for x in (mine, wanted))
    is_normal = [abs(x).max(axis=0) > 2.4 * x.std(axis=0) for x in (mine, wanted)]
    np.testing.assert_array_equal(is_normal[0], is_normal[1])


def test_half_cheetahs_masses_do_not_need_settotalmass():
    """The file says by which density, for the day when MuJoCo drops what it deprecates."""
    text = (Path(models.__file__).parent / "assets" / "half_cheetah.xml").read_text("utf-8")
    (density,) = re.findall(r'density="[\d.]+"', text)
    comment, _, rest = text.replace(' settotalmass="14"', "").partition("-->")
    by_density = mujoco.MjModel.from_xml_string(rest.replace("<geom ", f"<geom {density} ", 1))
    model = models.load_model("half_cheetah.xml")
    assert "settotalmass" in comment
    assert "settotalmass" not in rest
    for name in ("body_mass", "body_inertia", "body_ipos", "body_invweight0", "dof_invweight0"):
        pair = (getattr(by_density, name), getattr(model, name))
        np.testing.assert_allclose(*pair, rtol=1e-14, atol=1e-16, err_msg=name)
    assert by_density.stat.meaninertia == pytest.approx(model.stat.meaninertia, rel=1e-14)


@pytest.mark.slow
def test_a_cylinder_starts_beside_the_goal_as_gymnasium_draws_it():
    """Quarters of what is drawn lie between those that rejection finds."""
    env, rng = envs.make("Pusher-v5"), np.random.default_rng(0)
    drawn = jax.vmap(env.initial)(jax.random.split(jax.random.key(2), 4000))[0][:, 7:9]
    like = rng.uniform([-0.3, -0.2], [0, 0.2], (20_000, 2))
    like = like[np.linalg.norm(like, axis=1) > 0.17]
    assert np.linalg.norm(drawn, axis=1).min() > 0.17 - 1e-6
    for place in range(2):
        quarters = [np.quantile(x[:, place], np.linspace(0, 1, 5)) for x in (drawn, like)]
        np.testing.assert_allclose(quarters[0], quarters[1], atol=0.012)


def cart_states():
    rng = np.random.default_rng(2)
    wide = rng.normal(size=(40, 4)) * [1.5, 1.0, 0.15, 1.0]
    edges = [[2.39, 0, 0, 0], [2.4, 1, 0, 0], [-2.41, 0, 0, 0], [0, 0, 0.208, 0.1], [0, 0, 0.34, 1]]
    return np.concatenate([wide, edges])


@pytest.mark.parametrize(
    "task", ["CartPole-v1", "CartPole-v1 of -1 and 0", "ContinuousCartPole-v0"]
)
def test_carts_are_gymnasiums(task):
    """The continuous one too, but its angle, its force and its last reward."""
    barto, continuous = "of" in task, "Continuous" in task
    settings: dict[str, Any] = {"sutton_barto_reward": True} if barto else {}
    env, peer = envs.make(task.split()[0], **settings), CartPoleEnv(sutton_barto_reward=barto)
    if continuous:
        peer.theta_threshold_radians = 20 * math.pi / 180
    step, ends = jax.jit(env.step), []
    for place, start in enumerate(cart_states()):
        push = 1.7 * math.cos(place)
        peer.state, peer.steps_beyond_terminated = start, None
        if continuous:
            peer.force_mag = 10 * push
        obs, reward, terminated, *_ = peer.step(1 if continuous else place % 2)
        action = np.array([push]) if continuous else place % 2
        state = step(env.set_state(start[[0, 2]].astype("f4"), start[[1, 3]].astype("f4")), action)
        np.testing.assert_allclose(state.obs, obs, rtol=1e-5, atol=1e-5)
        assert bool(state.done) == terminated
        assert state.reward == (1 - terminated if continuous else reward)
        ends.append(terminated)
    assert 0 < sum(ends) < len(ends)

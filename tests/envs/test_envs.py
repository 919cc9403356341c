"""The contract of every registered environment, and its life under brax's own tools."""

import dataclasses
import functools
import inspect
import subprocess
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import wrappers
from gymnasium.envs.registration import load_env_creator
from mujoco import mjx

from mjx_reinforce import Environment, envs
from mjx_reinforce.engine.base import Discrete, action_space, null_action, observation_size
from mjx_reinforce.engine.physics.mjx_internals import fenced
from mjx_reinforce.envs.settings import EpisodeSettings
from mjx_reinforce.settings.tables import TASKS

IDS = envs.names()
#: Arguments of Gymnasium's tasks that are about pictures.
PICTURES = {"render_mode", "default_camera_config"}
#: What compiles for half a minute and more is traced here, and compared with Gymnasium's in
#: test_parity.py, in double precision; every other task, a new one too, is also run.
HEAVY = {
    *("Pusher-v5", "Swimmer-v5", "HalfCheetah-v5", "Hopper-v5"),
    *("Walker2d-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5"),
}
#: Tasks of the same classes as others, with other numbers.
OLDER = {"InvertedPendulum-v4", "CartPole-v0"}
#: Tasks whose steps are those of Hopper and Humanoid, with other formulas: test_tasks.py has these.
ALIKE = {"Walker2d-v5", "HumanoidStandup-v5"}
LIGHT = sorted(set(IDS) - HEAVY)
#: Tasks that take seconds to trace or to compile.
SECONDS = HEAVY - {"Swimmer-v5"} | {"Reacher-v5", "InvertedDoublePendulum-v5"}
made = functools.cache(envs.make)
all_in_turn = pytest.mark.parametrize(
    "ids", [LIGHT, pytest.param(sorted(HEAVY), marks=pytest.mark.slow)], ids=["light", "heavy"]
)


def shapes(tree):
    """A program that was compiled for one state serves all that have these."""
    return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)


@pytest.mark.parametrize(
    "id",
    [
        pytest.param(id, marks=pytest.mark.slow) if id in SECONDS else id
        for id in sorted(set(IDS) - OLDER - ALIKE)
    ],
)
def test_a_step_keeps_shapes_and_dtypes_and_its_argument(id):
    """The argument's structure and its leaves, dictionaries inside included."""
    env = made(id)
    assert isinstance(env, Environment)

    def play(key, action):
        state = env.reset(key)
        leaves, structure = jax.tree.flatten(state)
        after = env.step(state, action)
        later, kept = jax.tree.flatten(state)
        assert structure == kept
        assert all(x is y for x, y in zip(leaves, later, strict=True))
        return state, after

    for x64 in (False, True) if id in LIGHT else (False,):
        with jax.enable_x64(x64):
            dtype = jnp.float64 if x64 else jnp.float32
            action = jnp.asarray(null_action(env))
            action = action.astype(dtype) if action.ndim else action
            start, after = jax.eval_shape(play, jax.random.key(0), action)
            assert shapes(start) == shapes(after)
            assert start.obs.shape == (env.observation_size,) == (observation_size(env),)
            assert start.reward.shape == start.done.shape == ()
            assert start.obs.dtype == start.reward.dtype == start.done.dtype == dtype


@all_in_turn
def test_sizes_bounds_and_limits(ids):
    """They are those that the plan of a run knows, of what was measured."""
    for id in ids:
        env, space = made(id), action_space(made(id))
        if isinstance(space, Discrete):
            assert env.action_size == space.num_actions > 1, id
        else:
            assert space.low.shape == space.high.shape == (env.action_size,), id
            assert np.all(space.low < space.high), id
        assert min(env.max_episode_steps, env.dt) > 0, id
        entries = 1 if isinstance(space, Discrete) else env.action_size
        sizes = (env.observation_size, entries, env.max_episode_steps)
        if task := TASKS.get(id):
            assert (task.observation, task.action, task.horizon) == sizes, id


@all_in_turn
def test_settings_are_frozen_and_gymnasiums(ids):
    """Every argument of Gymnasium's class is here under its name, with its default."""
    for id in ids:
        env = made(id)
        assert isinstance(env.settings, EpisodeSettings)
        with pytest.raises(dataclasses.FrozenInstanceError):
            env.settings.max_episode_steps = 1
        limits = env.settings.max_episode_steps, env.settings.reward_threshold
        assert limits == (env.max_episode_steps, env.reward_threshold)
        if id not in gymnasium.registry:
            continue
        theirs = gymnasium.spec(id)
        parameters = inspect.signature(load_env_creator(theirs.entry_point)).parameters.values()
        expected = {
            parameter.name: parameter.default
            for parameter in parameters
            if parameter.kind != parameter.VAR_KEYWORD and parameter.name not in PICTURES
        }
        expected |= {
            "max_episode_steps": theirs.max_episode_steps,
            "reward_threshold": theirs.reward_threshold,
        }
        ours = dataclasses.asdict(env.settings)
        own_file = "xml_file" in ours and "v4" not in id
        assert expected.pop("xml_file", "").endswith(".xml") == own_file, id
        assert {name: ours[name] for name in expected} == expected, id


@pytest.mark.parametrize(
    ("id", "wrong", "message"),
    [
        ("InvertedPendulm-v5", {}, "Did you mean 'InvertedPendulum-v5'"),
        ("Hopper-v5", {"helthy_reward": 1}, "of Hopper 'helthy_reward'.*'healthy_reward'.*Known"),
        ("CartPole-v1", {"sutton": True}, "of CartPole 'sutton'.*'sutton_barto_reward'"),
        ("InvertedPendulum-v5", {"solver": "mjxx"}, "unknown solver 'mjxx'"),
        ("InvertedPendulum-v5", {"frame_skip": 0}, "frame_skip must be at least 1, got 0"),
        ("CartPole-v1", {"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ("CartPole-v1", {"kinematics_integrator": "rk4"}, "unknown integrator 'rk4'"),
        ("Swimmer-v5", {"reset_noise_scale": -0.1}, "reset_noise_scale must be 0 or more"),
        ("Hopper-v5", {"healthy_state_range": (1, 1)}, "healthy_state_range must be"),
        ("Walker2d-v5", {"healthy_angle_range": (1, -1)}, "healthy_angle_range must be"),
        ("Humanoid-v5", {"healthy_z_range": (2, 1)}, "healthy_z_range must be"),
        ("Humanoid-v5", {"contact_cost_range": (2, 1)}, "contact_cost_range must be"),
        ("HumanoidStandup-v5", {"impact_cost_range": (2, 1)}, "impact_cost_range must be"),
        ("Ant-v5", {"contact_force_range": (2, 1)}, "contact_force_range must be"),
        ("Ant-v5", {"main_body": "tail"}, "main_body 'tail' is not in ant.xml"),
    ],
)
def test_wrong_arguments_are_explained(id, wrong, message):
    with pytest.raises(ValueError, match=message):
        envs.make(id, **wrong)


#: A tilted capsule, partly in the floor, where the contact frames of C MuJoCo and MJX differ.
CAPSULE = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 .3">
      <joint name="lift" type="slide" axis="0 0 1"/>
      <joint axis="1 2 0" type="hinge"/>
      <geom type="capsule" size=".1 .2"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift"/></actuator>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "is_mjx"), [("mjx", True), ("fast", True), ("exact", False)])
def test_the_start_is_of_the_solver(tmp_path, solver, is_mjx):
    """It is ``mjx.forward``, operation for operation, unless C MuJoCo's contacts are asked for."""
    path = tmp_path / "capsule.xml"
    path.write_text(CAPSULE, encoding="utf-8")
    env = envs.make("InvertedPendulum-v5", xml_file=str(path), solver=solver)
    theirs = jax.jit(functools.partial(fenced(mjx.forward), env.model))
    start = mjx.make_data(env.mj_model, impl="jax")
    ours, theirs = (str(jax.make_jaxpr(forward)(start)) for forward in (env._forward, theirs))
    assert (ours == theirs) == is_mjx


@pytest.mark.parametrize(
    "id", [pytest.param("InvertedPendulum-v5", marks=pytest.mark.slow), "CartPole-v1"]
)
def test_it_runs_under_brax(id):
    """Their wrappers and rollout, on ours, with the raw keys they need."""
    from brax.training import acting

    env = envs.make(id)
    wrapped = wrappers.training.wrap(env, episode_length=5, action_repeat=1)
    action = null_action(env)

    def policy(observation, key):
        if action.ndim:
            return jax.random.uniform(key, (*observation.shape[:-1], env.action_size)), {}
        return jax.random.randint(key, observation.shape[:-1], 0, env.action_size), {}

    @jax.jit
    def play(keys, key):
        states = wrapped.reset(keys)
        return acting.generate_unroll(wrapped, states, policy, key, unroll_length=12)

    last, data = play(jax.random.split(jax.random.PRNGKey(0), 4), jax.random.PRNGKey(1))
    assert data.observation.shape == (12, 4, env.observation_size)
    assert np.all(np.isfinite(data.observation))
    assert np.all(np.isfinite(data.reward))
    assert np.all(last.info["steps"] <= 5)


@pytest.mark.parametrize("id", ["CartPole-v1", "InvertedPendulum-v5"])
def test_the_same_key_is_the_same_episode(id):
    """Compiled once, for a first step and for those that follow it."""
    env = made(id)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    first, second, other = (reset(jax.random.key(seed)) for seed in (3, 3, 4))
    equal(first, second)
    assert np.any(first.obs != other.obs)
    action = null_action(env)
    after = step(first, action)
    equal(after, step(second, action))
    assert np.all(np.isfinite(step(after, action).obs))
    assert step._cache_size() == 1
    physics = first.pipeline_state
    equal(jax.jit(env.set_state)(physics.qpos, physics.qvel), first)


def equal(x, y):
    jax.tree.map(np.testing.assert_array_equal, x, y)


def test_register_once():
    envs.register("Again-v0", envs.make, id="InvertedPendulum-v5")
    try:
        assert "Again-v0" in envs.names()
        with pytest.raises(ValueError, match="already registered"):
            envs.register("Again-v0", envs.make)
    finally:
        del envs._TABLE["Again-v0"]


_THREADS = """
import sys, threading
from mjx_reinforce import envs
stdout, seen, ended = sys.stdout, set(), threading.Event()
def look():
    while not ended.is_set():
        seen.add(sys.stdout)
watcher = threading.Thread(target=look)
watcher.start()
names = ["InvertedPendulum-v5", "CartPole-v1"] * 2
makers = [threading.Thread(target=envs.make, args=(name,)) for name in names]
for thread in makers:
    thread.start()
for thread in makers:
    thread.join()
ended.set()
watcher.join()
print(seen == {stdout}, sys.stdout is stdout)
"""


@pytest.mark.slow
def test_threads_that_make_environments_leave_standard_output_alone():
    """Nor do they print: what MJX says of its Warp backend is not heard."""
    done = subprocess.run(
        [sys.executable, "-c", _THREADS], check=True, capture_output=True, text=True, timeout=100
    )
    assert done.stdout == "True True\n"

"""The contract of every registered environment, and its life under brax's own tools."""

import dataclasses
import functools
import inspect
import json

import cloudpickle
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import wrappers
from command_lines import run_command
from gymnasium.envs.registration import load_env_creator
from places import ROOT

from mjx_reinforce import Environment, envs, watch
from mjx_reinforce.engine import objects
from mjx_reinforce.engine.base import Discrete, action_space, null_action, observation_size
from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.envs.outcomes import check_outcome, check_start
from mjx_reinforce.envs.settings import EpisodeSettings, read_settings
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import HORIZONS
from mjx_reinforce.setup import ready

IDS = envs.names()
#: Arguments of Gymnasium's tasks that are about pictures.
PICTURES = {"render_mode", "default_camera_config"}
#: What compiles for half a minute and more is traced here, and compared with Gymnasium's in
#: test_parity.py, in double precision; every other task, a new one too, is also run.
HEAVY = {
    *("Pusher-v5", "Swimmer-v5", "HalfCheetah-v5", "Hopper-v5"),
    *("Walker2d-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5"),
}
#: Tasks whose steps are those of others, with other numbers and formulas: see test_tasks.py.
ALIKE = HEAVY - {"Humanoid-v5"} | {"InvertedPendulum-v4", "CartPole-v0"}
LIGHT = sorted(set(IDS) - HEAVY)
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
        pytest.param(id, marks=pytest.mark.slow) if id in HEAVY | {"Reacher-v5"} else id
        for id in sorted(set(IDS) - ALIKE)
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
def test_environments_are_made_where_a_program_is_traced(ids):
    """Their models are constants there, and an environment that left the trace still plays."""
    environments = {}

    def make(key):
        environments.update({id: envs.make(id) for id in ids})
        return environments[ids[-1]].reset(key).obs

    jax.eval_shape(make, jax.random.key(0))
    for id, env in environments.items():
        leaves = jax.tree.leaves(getattr(env, "model", None))
        assert not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves), id


def test_an_environment_made_under_jit_plays_as_one_made_before(tmp_path):
    """Also of one's own MJCF and constants, under vmap, and after the trace."""
    path = tmp_path / "own.xml"
    path.write_text((ROOT / "envs" / "assets" / "inverted_pendulum.xml").read_text())
    kept = []

    class Own(type(made("InvertedPendulum-v5"))):
        def __init__(self):
            super().__init__(xml_file=str(path))
            self.force = jnp.ones(1)

        def control(self, action):
            return action + self.force

    def play(env, key):
        return env.step(env.reset(key), jnp.zeros(1)).obs

    def make(key):
        kept.append(envs.make("InvertedPendulum-v5"))
        return play(Own(), key), play(kept[0], key)

    keys = jax.random.split(jax.random.key(0), 2)
    pushed, alone = jax.jit(jax.vmap(make))(keys)
    expected = jax.vmap(functools.partial(play, made("InvertedPendulum-v5")))(keys)
    np.testing.assert_allclose(alone, expected, rtol=1e-6)
    np.testing.assert_allclose(play(kept[0], keys[0]), expected[0], rtol=1e-6)
    np.testing.assert_allclose(pushed, jax.vmap(functools.partial(play, Own()))(keys), rtol=1e-6)


def test_cloudpickle_copies_a_new_environment():
    """It is how Ray and others send one to their processes."""

    def play(env):
        return env.step(env.reset(jax.random.key(0)), jnp.zeros(3)).obs

    env = envs.make("Hopper-v5")
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    np.testing.assert_array_equal(play(copy), play(env))


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
        assert HORIZONS.get(id, env.max_episode_steps) == env.max_episode_steps, id


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
        ("CartPole-v1", {"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ("Swimmer-v5", {"reset_noise_scale": -0.1}, "reset_noise_scale must be 0 or more"),
        ("Hopper-v5", {"healthy_state_range": (1, 1)}, "healthy_state_range must be"),
        ("Humanoid-v5", {"healthy_z_range": (2, 1)}, "healthy_z_range must be"),
        ("HumanoidStandup-v5", {"impact_cost_range": (2, 1)}, "impact_cost_range must be"),
        ("Ant-v5", {"contact_force_range": (2, 1)}, "contact_force_range must be"),
        ("Ant-v5", {"main_body": "tail"}, "main_body 'tail' is not in ant.xml"),
    ],
)
def test_wrong_arguments_are_explained(id, wrong, message):
    with pytest.raises(ValueError, match=message):
        envs.make(id, **wrong)


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


# -------------------------------------------------------------------------------------------------
# Checks of what a task's methods return: a wrong shape is named in one line.

SIZES = {"qpos": (3,), "qvel": (2,), "act": (0,)}


def test_a_start_of_the_model_s_sizes_passes():
    start = check_start("Task", (np.arange(3), jnp.zeros(2)), SIZES)
    assert jnp.issubdtype(start["qpos"].dtype, jnp.floating)
    assert {name: x.tolist() for name, x in start.items()} == {"qpos": [0, 1, 2], "qvel": [0, 0]}
    assert not check_start("Task", {"act": np.zeros(0)}, SIZES)  # of which the model has none


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (np.zeros(3), r"must return qpos and qvel, .* got the shape \[3\]"),
        ((np.zeros(2), np.zeros(2)), r"must return qpos \[3\], .* got the shape \[2\]"),
        ([np.zeros(3), np.zeros((2, 1))], r"must return qvel \[2\]"),
    ],
)
def test_a_start_of_other_sizes_is_named(start, message):
    with pytest.raises(BadEnvironmentError, match=f"Task.initial .*{message}"):
        check_start("Task", start, SIZES)


def test_an_outcome_of_scalars_passes():
    outcome = (jnp.float32(1), False, {"forward": 2, "cost": np.zeros(())})
    assert check_outcome("Task", outcome) == outcome


@pytest.mark.parametrize(
    ("outcome", "message"),
    [
        ((1.0, False), "must return three values, .* got a tuple of 2"),
        ((1.0, False, 3), "third value of Task.outcome must be a dict of the reward's terms, got"),
        ((np.zeros(1), False, {}), r"the reward of .* must be a scalar \[\], got the shape \[1\]"),
        ((1.0, False, {"cost": np.zeros(4)}), "the term 'cost' of .* sum it, or take an entry"),
        ((None, False, {}), "the reward of .* got None"),
    ],
)
def test_another_outcome_is_named(outcome, message):
    with pytest.raises(BadEnvironmentError, match=message):
        check_outcome("Task", outcome)


# -------------------------------------------------------------------------------------------------
# Settings of an environment as texts, from the command line to the files of a run.


class Task:
    """Has settings of each kind."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(EpisodeSettings):
        """Settings of each kind."""

        weight: float = 0.5
        terminates: bool = True
        bounds: tuple[float, float] = (0.0, 1.0)
        name: str = "a"


def test_texts_are_read_by_their_type():
    words = ["weight=1", "terminates=false", "bounds=0.2,inf", "name=x=y", "max-episode-steps=1e3"]
    assert read_settings(Task, [*words, "reward_threshold=none"]) == {
        "weight": 1.0,
        "terminates": False,
        "bounds": (0.2, float("inf")),
        "name": "x=y",
        "max_episode_steps": 1000,
        "reward_threshold": None,
    }


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("weigth=1", "unknown setting of Task 'weigth'. Did you mean 'weight'.*Known: bounds"),
        ("weight=heavy", "weight of Task must be a number, got 'heavy'"),
        ("terminates=2", "must be True or False"),
        ("bounds=a,b", "must be .a number, a number."),
        ("max_episode_steps=1.5", "whole number"),
        ("weight", "takes NAME=VALUE"),
        ("weight=", "takes NAME=VALUE"),
        ("weight=1 weight=2", "weight twice: 1 and 2"),
    ],
)
def test_what_is_no_setting_is_refused(words, said):
    with pytest.raises(ValueError, match=said):
        read_settings(Task, words.split())


def test_what_has_no_settings_is_refused():
    with pytest.raises(ValueError, match="not a class with a dataclass Settings"):
        read_settings(len, ["weight=1"])


def test_a_value_out_of_its_range_is_refused_as_by_make():
    with pytest.raises(ValueError, match="frame_skip must be at least 1, got 0"):
        envs.make_set("InvertedPendulum-v5", ["frame_skip=0"])
    with pytest.raises(ValueError, match=r"healthy_z_range of Hopper must be .* got \(0.2, "):
        envs.make_set("Hopper-v5", ["healthy_z_range=0.2,1,3"])


def test_the_table_s_own_settings_hold_beside_those():
    env = envs.make_set("CartPole-v0", ["sutton_barto_reward=true"])
    assert env.settings.sutton_barto_reward
    assert env.max_episode_steps == 200


def test_programs_of_a_model_of_the_user_s_are_not_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    assert ready.key_of(Config(env_set=("xml_file=./mine.xml",))) is None
    keys = [ready.key_of(Config(env_set=words)) for words in ((), ("frame_skip=2",))]
    assert None not in keys
    assert len(set(keys)) == 2


QUICK = (
    *("--env", "CartPole-v1", "--engine", "vmap", "--hidden-sizes", "4", "--num-seeds", "2"),
    *("--num-episodes", "2", "--eval-episodes", "2", "--max-updates", "2", "--env-steps", "None"),
)


@pytest.mark.slow
def test_a_run_keeps_the_settings_of_its_environment(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ("max_episode_steps=7", "sutton_barto_reward=true")
    assert run_command(*QUICK, "--env-set", *words, "--output", "run") == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["env_set"] == list(words)
    assert config["horizon"] == 7
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    # The other reward is 1 a step.
    assert all(-1 <= x <= 0 for x in summary["final_returns"])
    made = []

    def stop(*given):
        made.append(given)
        raise ValueError("enough")

    monkeypatch.setattr(watch.envs, "make_set", stop)
    monkeypatch.setattr(watch, "check_drawing", lambda: None)
    assert run_command("run", command=watch.main) == 2
    assert made == [("CartPole-v1", words)]
    capsys.readouterr()
    assert run_command("--resume", "run", "--env-set", "max_episode_steps=8") == 2
    assert "--env-set is" in capsys.readouterr().err


def test_a_wrong_setting_ends_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(*QUICK, "--env-set", "sutton_bartoreward=true", "--output", "run") == 2
    assert "Did you mean 'sutton_barto_reward'?" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()

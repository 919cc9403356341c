"""The class that is written of a robot on legs: what it says, and what its episodes do."""

import csv
import importlib
import json
import shutil
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from new_classes import lint, write
from on_legs import on_legs
from places import ROOT

import mjx_reinforce as mr
from mjx_reinforce import envs
from mjx_reinforce.settings.defaults import PRESETS
from mjx_reinforce.templates.facts import class_name

QUADRUPED = ROOT / "experiments" / "examples" / "quadruped.xml"
NUM_EPISODES = 16
NUM_STEPS = 300
#: The standard deviation of actions: half of that with which training begins.
NOISE = 0.2
ON_TWO = on_legs(2)


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """The module that is written of the quadruped."""
    folder = tmp_path_factory.mktemp("dog")
    shutil.copy(QUADRUPED, folder / "my_dog.xml")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        write(patch, "my_dog.xml")
        yield importlib.import_module("my_dog")


@pytest.mark.slow
def test_the_commands_of_the_class_train_and_export(dog, tmp_path):
    """Two updates of the preset, in place of minutes, by the engine that compiles nothing."""
    words = dog.__doc__.replace("--minutes 20", "").partition("python ")[2].partition("\n\n")[0]
    train, watch, export = (command.split() for command in words.split("python "))
    assert watch == ["-m", "mjx_reinforce.watch", "my_dog_run", "--env", "my_dog:MyDog"]
    short = "--max-updates 2 --env-steps None --num-seeds 1 --num-episodes 8 --train-horizon 10"
    short += " --value-batch-size 8 --horizon 20 --eval-every 1 --eval-episodes 2 --engine mujoco"
    for command in ([*train, *short.split()], export):
        subprocess.run([sys.executable, *command], check=True, cwd=Path(dog.__file__).parent)
    run = Path(dog.__file__).with_name("my_dog_run")
    config = json.loads((run / "config.json").read_text())
    preset = vars(PRESETS["legged"][1])
    for name in ("hidden_sizes", "update", "estimator", "max_kl", "discount", "initial_std"):
        assert config[name] == json.loads(json.dumps(preset[name]))
    with (run / "metrics.csv").open() as file:
        rows = [*csv.DictReader(file)]
    assert [int(row["update"]) for row in rows] == [0, 1, 2]
    for name in dog.WEIGHTS:
        assert np.isfinite(float(rows[-1][f"eval_reward_{name}"]))
    header = Path(dog.__file__).with_name("my_dog_policy.h").read_text()
    assert "void my_dog_policy_control(const float *action, unsigned step, float *ctrl)" in header


@pytest.fixture(scope="module")
def env(dog):
    class Recorded(dog.MyDog):
        carried = ("ctrl",)

    return Recorded()


@pytest.fixture(scope="module")
def episodes(env):
    """Episodes [NUM_STEPS + 1, N] in C MuJoCo, under the noise that an untrained policy is.

    The first row is the start, which no action, reward or terms belong to.
    """
    vec = mr.make_vec(env, NUM_EPISODES, engine="mujoco", autoreset="disabled")
    step = jax.jit(vec.step)
    state = jax.jit(vec.reset)(jax.random.key(1))
    rng = np.random.default_rng(0)
    actions = np.zeros((NUM_EPISODES, 12), np.float32)
    rows = []
    for _ in range(NUM_STEPS + 1):
        physics = state.simulation.pipeline_state
        rows.append(
            {
                "action": actions,
                "obs": state.obs,
                "qpos": physics.qpos,
                "qvel": physics.qvel,
                "ctrl": physics.carried["ctrl"],
                "reward": state.reward,
                "has_fallen": state.terminated,
                **physics.memory,
                **state.metrics,
            }
        )
        actions = rng.normal(0.0, NOISE, actions.shape).astype(np.float32)
        state = step(state, actions)
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def module_of(text, monkeypatch, folder, name):
    """Returns the module that is written of a model in a file of this name."""
    (folder / f"{name}.xml").write_text(text)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    write(monkeypatch, f"{name}.xml")
    monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module(name)


def test_the_class_of_a_quadruped_says_how_it_walks(dog, env):
    assert dog.BODY == "torso"
    servos = [f"{name}-{y}-{x}" for x in "01" for y in "01" for name in ("abduct", "swing", "knee")]
    assert [*dog.JOINTS] == servos
    assert (dog.SLOWEST, dog.FASTEST) == ((0.0, -0.3, -0.5), (1.0, 0.3, 0.5))
    assert env.dt == pytest.approx(0.02)
    seconds = [dog.COMMAND_PERIOD, dog.PUSH_PERIOD, dog.GAIT_PERIOD, env.max_episode_steps]
    np.testing.assert_allclose(np.multiply(env.dt, seconds), [5, 4, 0.5, 10])
    assert (dog.LATENCY, dog.SCALE, dog.PUSH) == (1, 0.5, 0.5)
    np.testing.assert_allclose(dog.LIFT, 0.2 * 0.317, atol=1e-3)
    errors = ["forward_error", "sideways_error", "turn_error"]
    assert [*dog.WEIGHTS] == ["upright", *errors, "action_rate", "pose", "effort"]
    assert [name for name, weight in dog.WEIGHTS.items() if weight > 0] == ["upright"]
    np.testing.assert_array_equal(env.limit, np.full(12, 30.0))
    np.testing.assert_array_equal(env.action_space.high, np.ones(12))
    lint(dog.__file__)
    assert Path(dog.__file__).read_text().count("\n") < 200


def test_an_episode_starts_at_home_at_rest(env, episodes):
    start = {name: rows[0] for name, rows in episodes.items()}
    home = env.mj_model.qpos0
    np.testing.assert_allclose(start["qpos"][:, :7], np.tile(home[:7], (NUM_EPISODES, 1)))
    away = start["qpos"][:, 7:] - home[7:]
    assert 0.09 < np.abs(away).max() <= 0.1
    assert not start["qvel"].any()
    np.testing.assert_allclose(start["ctrl"], np.tile(env.home, (NUM_EPISODES, 1)))
    assert len(np.unique(start["step"])) > NUM_EPISODES / 2


def test_an_untrained_policy_stands_until_it_is_pushed(dog, episodes):
    will_wait = episodes["step"][0] < dog.PUSH_PERIOD - 100
    assert will_wait.sum() > NUM_EPISODES / 4
    assert not episodes["has_fallen"][:101, will_wait].any()


def test_controls_are_those_of_the_last_action_and_the_gait(dog, env, episodes):
    late_actions = episodes["action"][:-1]
    phases = episodes["step"][:-1] % dog.GAIT_PERIOD
    controls = env.home + dog.SCALE * late_actions + env.gait[phases]
    np.testing.assert_allclose(episodes["ctrl"][1:], controls, atol=1e-5)


def test_commands_are_in_their_ranges_and_change_when_due(dog, env, episodes):
    commands = episodes["command"]
    assert np.all((commands >= dog.SLOWEST) & (commands <= dog.FASTEST))
    has_changed = np.any(commands[1:] != commands[:-1], axis=-1)
    is_due = episodes["step"][1:] % dog.COMMAND_PERIOD == 0
    assert is_due.sum() > NUM_EPISODES / 2
    np.testing.assert_array_equal(has_changed, is_due)
    drawn = jax.vmap(env.command)(jax.random.split(jax.random.key(0), 2000))
    assert np.mean(~np.any(drawn, axis=1)) == pytest.approx(dog.REST_SHARE, abs=0.03)
    spread = np.subtract(dog.FASTEST, dog.SLOWEST)
    np.testing.assert_allclose(np.ptp(drawn, axis=0), spread, rtol=0.02)


def test_pushes_come_when_due(dog, env, episodes):
    is_due = episodes["step"] % dog.PUSH_PERIOD == 0
    pushes = episodes["push"]
    assert not pushes[0].any()
    assert is_due[1:].sum() > NUM_EPISODES
    np.testing.assert_array_equal(pushes[1:].any(axis=-1), is_due[1:])
    assert 0.8 * dog.PUSH < np.abs(pushes).max() <= dog.PUSH
    before = types.SimpleNamespace(memory={"push": jnp.array([0.3, -0.2])})
    np.testing.assert_allclose(env.push(before), [0.3, -0.2, *np.zeros(16)])


def test_a_policy_sees_what_the_robot_has(dog, episodes):
    """Joints and inertial unit with noise, the last action, the command, and the gait's clock."""
    obs = episodes["obs"][1:]
    sizes = [3, 3, 12, 12, 12, 3, 2, 6]
    assert obs.shape[-1] == sum(sizes)
    gravity, _, angles, speeds, actions, commands, clock, strides = np.split(
        obs, np.cumsum(sizes)[:-1], axis=-1
    )
    noise = episodes["noise"][1:]
    assert np.all(np.abs(noise) <= dog.NOISE)
    assert np.all(np.ptp(noise, axis=(0, 1)) > 1.9 * dog.NOISE)
    lengths = np.linalg.norm(gravity - noise[..., :3], axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    np.testing.assert_allclose(angles - noise[..., 6:18], episodes["qpos"][1:, :, 7:], atol=1e-5)
    np.testing.assert_allclose(speeds - noise[..., 18:], episodes["qvel"][1:, :, 6:], atol=1e-4)
    np.testing.assert_array_equal(actions, episodes["action"][1:])
    np.testing.assert_array_equal(commands, episodes["command"][1:])
    turns = 2 * np.pi * episodes["step"][1:] / dog.GAIT_PERIOD
    np.testing.assert_allclose(clock, np.stack([np.sin(turns), np.cos(turns)], -1), atol=1e-4)
    products = clock[..., :, None] * commands[..., None, :]
    np.testing.assert_allclose(strides, products.reshape(strides.shape), atol=1e-5)


def test_terms_sum_to_the_reward(dog, episodes):
    terms = [episodes[f"reward_{name}"][1:] for name in dog.WEIGHTS]
    np.testing.assert_allclose(np.sum(terms, axis=0), episodes["reward"][1:], atol=1e-5)
    changes = np.diff(episodes["action"], axis=0)
    rates = dog.WEIGHTS["action_rate"] * np.mean(np.square(changes), axis=-1)
    np.testing.assert_allclose(episodes["reward_action_rate"][1:], rates, atol=1e-5)
    poses = dog.WEIGHTS["pose"] * np.mean(np.square(episodes["qpos"][1:, :, 7:]), axis=-1)
    np.testing.assert_allclose(episodes["reward_pose"][1:], poses, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("height", "quaternion", "falls"),
    [
        (0.317, [1, 0, 0, 0], False),
        (0.317, [0.5**0.5, 0.5**0.5, 0, 0], True),  # on its side
        (0.15, [1, 0, 0, 0], True),
    ],
)
def test_a_fall_ends_an_episode(env, height, quaternion, falls):
    qpos = jnp.zeros(19).at[2:7].set(jnp.array([height, *quaternion]))
    task = env.in_c_mujoco()
    state = task.set_state(qpos, jnp.zeros(18), env.randomize(jax.random.key(0)))
    assert bool(task.step(state, jnp.zeros(12)).done) == falls


def test_a_biped_gets_a_slower_pace(tmp_path, monkeypatch):
    module = module_of(ON_TWO, monkeypatch, tmp_path, "biped")
    assert (module.SLOWEST, module.FASTEST) == ((0.0, -0.1, -0.3), (0.4, 0.1, 0.3))
    assert module.PUSH == 0.2
    np.testing.assert_allclose(module.LIFT, 0.12 * 0.37, atol=1e-3)
    assert module.JOINTS == ("knee0", "knee1", "out0", "out1", "swing0", "swing1")


def test_a_small_robot_is_slower_by_the_root_of_its_height(tmp_path, monkeypatch):
    text = on_legs(4).replace("<mujoco>", '<mujoco><compiler angle="degree"/>')
    text = text.replace('pos="0 0 0.37"', 'pos="0 0 -0.03"')
    text = text.replace('size="0 0 1"/>', 'size="0 0 1" pos="0 0 -0.18"/>')
    module = module_of(text, monkeypatch, tmp_path, "small")
    assert module.FASTEST == (0.7, 0.2, 0.5)
    # Heights are those over the floor, wherever it is.
    np.testing.assert_allclose(module.LIFT, 0.2 * 0.15, atol=1e-3)
    assert "xpos[2] < -0.09)" in (tmp_path / "small.py").read_text()


NOT_ON_LEGS = {
    "a body without a name": ('name="trunk"', ""),
    "motors": ("<position", "<motor"),
    "speeds": ("<position", "<intvelocity", 'joint="', 'actrange="-1 1" joint="'),
    "no floor": ('<geom type="plane" size="0 0 1"/>', ""),
    "x is up": (  # and its legs point down
        *('pos="0 0 0.37"', 'pos="0 0 0.37" euler="0 -90 0"'),
        *('<body euler="0 0 ', '<body euler="0 90 0"><body euler="0 0 '),
        *("</body>" * 4, "</body>" * 5),
    ),
}


@pytest.mark.parametrize("lack", NOT_ON_LEGS)
def test_another_robot_gets_the_older_class(tmp_path, monkeypatch, lack):
    text = ON_TWO
    words = NOT_ON_LEGS[lack]
    for old, new in zip(words[::2], words[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    module = module_of(text, monkeypatch, tmp_path, "other")
    assert not hasattr(module, "JOINTS")
    assert "self.unit" in (tmp_path / "other.py").read_text()


POSE = " ".join(["0 0 0.4 1 0 0 0", *["0.1 0.2 -0.3"] * 2])
IN_ORDER = [-0.3, -0.3, 0.1, 0.1, 0.2, 0.2]  # of the servos: knees, out, swing
CONTROLS = [-0.5, -0.6, 0.1, 0.2, 0.3, 0.4]
KEY = '<keyframe><key qpos="{pose}"{ctrl}/></keyframe></mujoco>'


@pytest.mark.parametrize(
    ("key", "home"),
    [
        (KEY.format(pose=POSE, ctrl=f' ctrl="{" ".join(map(str, CONTROLS))}"'), CONTROLS),
        (KEY.format(pose=POSE, ctrl=""), IN_ORDER),
        ("</mujoco>", np.zeros(6)),
    ],
)
def test_home_is_that_of_the_key_frame(tmp_path, monkeypatch, key, home):
    text = ON_TWO.replace("</mujoco>", key)
    task = module_of(text, monkeypatch, tmp_path, "keyed").Keyed()
    np.testing.assert_allclose(task.home, home)
    np.testing.assert_allclose(task.control(np.ones(6)), np.add(home, 0.5))
    start = task.initial(jax.random.key(0))
    np.testing.assert_allclose(start["ctrl"], home, atol=1e-6)
    first = task.mj_model.key_qpos[0] if "key" in key else task.mj_model.qpos0
    away = start["qpos"] - first
    assert not away[:7].any()
    assert np.all(away[7:] != 0)
    assert np.abs(away).max() <= 0.1 + 1e-6
    lint("keyed.py")


def test_servos_that_lag_start_where_they_are_to_hold(tmp_path, monkeypatch):
    text = ON_TWO.replace("<position", '<position timeconst="0.05"')
    text = text.replace("</mujoco>", KEY.format(pose=POSE, ctrl=""))
    task = module_of(text, monkeypatch, tmp_path, "lagging").Lagging()
    np.testing.assert_allclose(task.initial(jax.random.key(0))["act"], IN_ORDER, atol=1e-6)
    lint("lagging.py")


@pytest.mark.parametrize("limited", ["actuators", "joints", "nothing"])
def test_effort_is_of_the_limits_that_the_model_has(tmp_path, monkeypatch, limited):
    text = ON_TWO
    if limited == "actuators":
        text = text.replace("<position", '<position forcerange="-8 7"')
    if limited == "joints":
        text = text.replace('axis="0 1 0"/>', 'axis="0 1 0" actuatorfrcrange="-6 5"/>')
        text = text.replace('axis="1 0 0"/>', 'axis="1 0 0" actuatorfrcrange="-4 3"/>')
    module = module_of(text, monkeypatch, tmp_path, "limited")
    task = module.Limited()
    limits = {"actuators": [7] * 6, "joints": [5, 5, 3, 3, 5, 5]}
    if limited == "nothing":
        assert not hasattr(task, "limit")
    else:
        np.testing.assert_array_equal(task.limit, limits[limited])
    assert ("effort" in module.WEIGHTS) == (limited != "nothing")
    lint("limited.py")


def test_names_of_a_model_cannot_break_the_class(tmp_path, monkeypatch):
    names = {
        "trunk": ('"""{BODY}"""', "&quot;&quot;&quot;{BODY}&quot;&quot;&quot;"),
        "knee0": ("a\nb\\", "a&#10;b\\"),
        "out1": ("{0}' 腿 🤖 \u2028", "{0}&apos; 腿 🤖 \u2028"),
    }
    text = ON_TWO
    for name, (_, written) in names.items():
        text = text.replace(f'"{name}"', f'"{written}"')
    module = module_of(text, monkeypatch, tmp_path, "named")
    said = {"trunk": module.BODY, "knee0": module.JOINTS[0], "out1": module.JOINTS[3]}
    assert said == {name: strange for name, (strange, _) in names.items()}
    task = module.Named()
    state = jax.eval_shape(task.reset, jax.random.key(0))
    assert state.obs.shape == (3 + 3 + 3 * 6 + 3 + 2 + 6,)


def test_a_class_hides_no_name_that_it_uses(tmp_path, monkeypatch):
    taken = [class_name(name) for name in ("box", "path", "mujoco_env", "PUSH", "none", "true")]
    assert taken == [
        "TaskBox",
        "TaskPath",
        "TaskMujocoEnv",
        "TaskPUSH",
        "TaskNone",
        "TaskTrue",
    ]
    assert [class_name(name) for name in ("_", "_2", "go_1")] == ["Task", "Task2", "Go1"]
    (tmp_path / "box.xml").write_text(ON_TWO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    write(monkeypatch, "box.xml")
    assert envs.make("box:TaskBox").action_size == 6

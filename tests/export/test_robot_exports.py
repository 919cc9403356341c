"""What a robot's program needs beside the network: the memory of observations, and the control."""

import sys
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import COMPILERS, load_library, needs_compiler, pointer
from exports import BOX, CASES, OBSERVATIONS, import_file, make, run_export
from saved_runs import change_env, make_run

from mjx_reinforce import envs, load
from mjx_reinforce.registry import DISTRIBUTIONS

FRAMES, LENGTH = 3, 250
#: What a policy sees that remembers three observations, in episodes of 250 steps.
STACKS = np.concatenate(
    [
        np.concatenate([episode[np.maximum(np.arange(LENGTH) - lag, 0)] for lag in (2, 1, 0)], 1)
        for episode in OBSERVATIONS.reshape(-1, LENGTH, 4)
    ]
)
TASK = """
import jax.numpy as jnp
import numpy as np
from mujoco import MjSpec
from mjx_reinforce import Box
from mjx_reinforce.envs import parts
from mjx_reinforce.envs.base import MujocoEnv

SPEC = MjSpec.from_string('''<mujoco><worldbody>
  <body><joint name="a"/><geom size=".1"/><body><joint name="b"/><geom size=".1"/>
  <body><joint name="c"/><geom size=".1"/></body></body></body></worldbody><actuator>
  <position joint="a" ctrlrange="-1 1"/><position joint="b" ctrlrange=".1 2"/><motor joint="c"/>
  </actuator></mujoco>''')

class Servos(MujocoEnv):
    def __init__(self):
        super().__init__(
            xml_file=SPEC, frame_skip=2, max_episode_steps=20, reward_threshold=None
        )
        self.action_space = Box(np.array([-3.0, -1.0, 0.5]), np.array([3.0, -0.5, 2.0]))

    def initial(self, rng):
        return jnp.zeros(3), jnp.zeros(3)

    def control(self, action):
        return jnp.array([0.1, 0.9, -1.8]) + jnp.array([0.5, 1.7, 0.3]) * action

    def outcome(self, before, data, action):
        return 0.0, False, {}

class Walker(Servos):
    gait = np.array([[0.3, 0.0, 1.0], [0.0, -0.4, 0.5], [-0.2, 0.6, 0.0]])

    def memory(self, rng, data):
        return {"step": 0}

    def actuate(self, before, action):
        return self.control(action) + parts.cyclic(self.gait, before.memory["step"])

class Endless(Servos):
    gait = np.array([[np.inf, 0.0, 0.0]])

class Flat(Servos):
    gait = np.zeros(3)

class Narrow(Servos):
    gait = np.zeros((5, 2))

class Trot(Servos):
    gait = "trot"

class Bent(Servos):
    def control(self, action):
        return jnp.tanh(action)

class Mixed(Servos):
    def control(self, action):
        return action[::-1]
"""


def remembering_run(folder):
    return make_run(folder, "InvertedPendulum-v5", observation_size=12, frames=FRAMES, **BOX)


def task_run(folder, monkeypatch, name="Servos"):
    (folder / "servos_of_test.py").write_text(TASK)
    monkeypatch.syspath_prepend(folder)
    run = make_run(folder / "run", "InvertedPendulum-v5", **BOX)
    change_env(run, f"servos_of_test:{name}")
    return run


def controls(actions):
    """Returns what the task applies of actions, and MuJoCo clamps to the ranges of actuators."""
    task = envs.make("servos_of_test:Servos")
    return np.clip([task.control(jnp.asarray(action)) for action in actions], *RANGES)


#: What MuJoCo clamps the controls of the tasks to.
RANGES = np.array([[-1, 0.1, -np.inf], [1, 2, np.inf]])
WALKS = """\
#include "walk.h"
#ifdef __cplusplus
extern "C" {
#endif
void apply(int count, const float *actions, const unsigned *steps, float *ctrl);
void apply(int count, const float *actions, const unsigned *steps, float *ctrl) {
    for (int n = 0; n < count; n++)
        walk_control(actions + n * WALK_ACTION_SIZE, steps[n], ctrl + n * WALK_ACTION_SIZE);
}
void act(const float *observation, float *action);
void act(const float *observation, float *action) {
    walk_act(observation, action);
}
#ifdef __cplusplus
}
#endif
"""
#: Functions that both languages have.
CALLS = """\
#include "walk.h"
#ifdef __cplusplus
extern "C" {
#endif
void act(int count, const float *observations, float *actions);
void act(int count, const float *observations, float *actions) {
    struct walk_state state;
    for (int n = 0; n < count; n++) {
        if (n % 250 == 0)
            walk_reset(&state);
        walk_act(&state, observations + n * WALK_OBSERVATION_SIZE, actions + n * WALK_ACTION_SIZE);
    }
}
#ifdef __cplusplus
}
#endif
"""


@needs_compiler
@pytest.mark.parametrize("language", COMPILERS)
def test_a_header_remembers_the_last_observations(tmp_path, monkeypatch, language):
    run = remembering_run(tmp_path)
    run_export(monkeypatch, run, "--output", tmp_path / "walk.h")
    library = load_library(tmp_path, CALLS, language)
    observations = np.ascontiguousarray(OBSERVATIONS, np.float32)
    actions = np.full((len(observations), 3), np.nan, np.float32)
    library.act(len(observations), pointer(observations), pointer(actions))
    np.testing.assert_allclose(actions, load(run).act(STACKS), atol=1e-5)


def test_a_module_remembers_the_last_observations(tmp_path, monkeypatch):
    run = remembering_run(tmp_path)
    run_export(monkeypatch, run, "--output", tmp_path / "walk.npz")
    module = import_file(tmp_path / "walk.py")
    policy = module.Policy()
    observation = np.empty(4)  # a program may write each into the same array
    actions = []
    for step, numbers in enumerate(OBSERVATIONS):
        observation[:] = numbers
        if step % LENGTH == 0:
            policy.reset()
        actions.append(policy.act(observation))
    np.testing.assert_allclose(actions, load(run).act(STACKS), atol=1e-5)
    assert "action = policy.act(observation)  # [4] -> [3]\n" in module.__doc__


@needs_compiler
def test_the_control_of_the_task_comes_into_the_files(tmp_path, monkeypatch):
    run = task_run(tmp_path, monkeypatch)
    for name in ("walk.h", "walk.npz"):
        run_export(monkeypatch, run, "--env", "servos_of_test:Servos", "--output", tmp_path / name)
    actions = np.random.default_rng(0).uniform(-3, 3, size=(1000, 3)).astype(np.float32)
    expected = controls(actions)
    assert (expected[:, 0] == 1).any()
    np.testing.assert_allclose(import_file(tmp_path / "walk.py").control(actions), expected, 1e-5)
    code = """#include "walk.h"\nvoid apply(float *x);\nvoid apply(float *x) {
    float ctrl[WALK_ACTION_SIZE];
    walk_control(x, ctrl);
    for (int i = 0; i < WALK_ACTION_SIZE; i++) x[i] = ctrl[i];\n}\nvoid act(float *x);
    void act(float *x) { walk_act(x, x); }"""
    library = load_library(tmp_path, code)
    for action, control in zip(actions, expected, strict=True):
        library.apply(pointer(action))
        np.testing.assert_allclose(action, control, rtol=1e-5)


def walks(actions, steps):
    """Returns what the task applies of actions at env steps, clamped as by MuJoCo."""
    task: Any = envs.make("servos_of_test:Walker")
    befores = [SimpleNamespace(memory={"step": step}) for step in steps]
    applied = [
        task.actuate(before, jnp.asarray(action))
        for before, action in zip(befores, actions, strict=True)
    ]
    return np.clip(applied, *RANGES)


def walking_run(folder, monkeypatch, *files):
    """Exports a run of a task with a gait into files, and returns actions and env steps."""
    run = task_run(folder, monkeypatch, "Walker")
    for name in files:
        run_export(monkeypatch, run, "--env", "servos_of_test:Walker", "--output", folder / name)
    rng = np.random.default_rng(0)
    return rng.uniform(-3, 3, size=(1000, 3)).astype(np.float32), rng.integers(0, 10**6, 1000)


@needs_compiler
@pytest.mark.parametrize("language", COMPILERS)
def test_a_header_adds_the_gait(tmp_path, monkeypatch, language):
    actions, steps = walking_run(tmp_path, monkeypatch, "walk.h")
    library = load_library(tmp_path, WALKS, language)
    ctrl = np.full((len(actions), 3), np.nan, np.float32)
    library.apply(len(actions), pointer(actions), pointer(steps.astype(np.uint32)), pointer(ctrl))
    np.testing.assert_allclose(ctrl, walks(actions, steps), atol=1e-5)


def test_a_module_adds_the_gait(tmp_path, monkeypatch):
    actions, steps = walking_run(tmp_path, monkeypatch, "walk.npz")
    module = import_file(tmp_path / "walk.py")
    expected = walks(actions, steps)
    np.testing.assert_allclose(module.control(actions, steps), expected, atol=1e-5)
    ctrl = module.control(actions[0], int(steps[0]))
    np.testing.assert_allclose(ctrl, expected[0], atol=1e-5)


def test_a_graph_adds_the_gait(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    _, steps = walking_run(tmp_path, monkeypatch, "walk.onnx")
    inputs = {"observation": OBSERVATIONS.astype(np.float32), "step": steps}
    action, ctrl = onnx_session(tmp_path / "walk.onnx").run(["action", "ctrl"], inputs)
    np.testing.assert_allclose(ctrl, walks(action, steps), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("Endless", "float64[1, 3]"),
        ("Flat", "float64[3]"),
        ("Narrow", "float64[5, 2]"),
        ("Trot", "<U4[]"),
    ],
)
def test_a_gait_that_is_no_table_is_refused(tmp_path, monkeypatch, capsys, kind, shape):
    run = task_run(tmp_path, monkeypatch, kind)
    with pytest.raises(SystemExit, match="2"):
        run_export(
            monkeypatch, run, "--env", f"servos_of_test:{kind}", "--output", tmp_path / "w.h"
        )
    error = capsys.readouterr().err
    assert f"gait of {kind} is what actuate adds" in error
    assert f"finite numbers [P, 3], got {shape}" in error


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("servos_of_test:Bent", "control of Bent is not home + scale * action"),
        ("servos_of_test:Mixed", "control of Mixed is not home + scale * action"),
        ("servos_of_test:Other", "was trained on servos_of_test:Servos"),
    ],
)
def test_a_control_of_another_kind_is_refused(tmp_path, monkeypatch, capsys, name, message):
    kind = name.partition(":")[2]
    run = task_run(tmp_path, monkeypatch, "Servos" if kind == "Other" else kind)
    with pytest.raises(SystemExit, match="2"):
        run_export(monkeypatch, run, "--env", name, "--output", tmp_path / "walk.h")
    assert message in capsys.readouterr().err
    assert not (tmp_path / "walk.h").exists()


def onnx_session(path):
    pytest.importorskip("onnx").checker.check_model(str(path))
    return pytest.importorskip("onnxruntime").InferenceSession(str(path))


@pytest.mark.parametrize(
    ("family", "case"),
    [*((x, "linear") for x in DISTRIBUTIONS), *(("normal", x) for x in CASES if x != "linear")],
)
def test_a_graph_acts_as_ours(tmp_path, monkeypatch, family, case):
    pytest.importorskip("onnx")
    run = make(tmp_path, family, case)
    run_export(monkeypatch, run, "--output", tmp_path / "walk.onnx")
    session = onnx_session(tmp_path / "walk.onnx")
    observations = OBSERVATIONS.astype(np.float32)
    (actions,) = session.run(None, {"observation": observations})
    expected = load(run).act(observations)
    assert actions.shape == expected.shape
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    observations[:, 1] = np.nan
    (actions,) = session.run(None, {"observation": observations})
    assert family == "categorical" or np.isnan(actions).all()


def test_a_graph_is_given_the_last_observations(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    run = remembering_run(tmp_path)
    run_export(monkeypatch, run, "--output", tmp_path / "walk.onnx")
    session = onnx_session(tmp_path / "walk.onnx")
    frames, actions = None, []
    for step, observation in enumerate(OBSERVATIONS.astype(np.float32)):
        if step % LENGTH == 0:
            frames = np.tile(observation, (1, FRAMES))
        inputs = {"observation": observation[None], "frames": frames}
        action, frames = session.run(["action", "next_frames"], inputs)
        actions.append(action[0])
    np.testing.assert_allclose(actions, load(run).act(STACKS), atol=1e-5)


def test_a_graph_has_the_control_of_the_task(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    run = task_run(tmp_path, monkeypatch)
    output = tmp_path / "walk.onnx"
    run_export(monkeypatch, run, "--env", "servos_of_test:Servos", "--output", output)
    observations = OBSERVATIONS.astype(np.float32)
    action, ctrl = onnx_session(output).run(["action", "ctrl"], {"observation": observations})
    np.testing.assert_allclose(ctrl, controls(action), rtol=1e-5)


def test_what_is_not_installed_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(SystemExit, match="2"):
        run_export(monkeypatch, make_run(tmp_path), "--output", tmp_path / "walk.onnx")
    assert "pip install 'mjx-reinforce[onnx]'" in capsys.readouterr().err


def test_a_file_without_the_control_of_a_task_says_so(tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path)
    run_export(monkeypatch, run)
    assert capsys.readouterr().err == ""
    change_env(run, "task:Servos")
    run_export(monkeypatch, run, "--overwrite")
    assert "home + scale * action, add --env task:Servos" in capsys.readouterr().err

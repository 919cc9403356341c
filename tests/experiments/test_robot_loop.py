"""The program of a robot sees what the task shows, and its actions come one step late."""

import importlib
import sys
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from exports import import_file, run_export
from places import ROOT
from saved_runs import change_env, make_run

from mjx_reinforce import envs, load, new
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco

EXAMPLES = ROOT / "experiments" / "examples"
SPACE = {"action_low": [-1.0] * 12, "action_high": [1.0] * 12}


@pytest.mark.parametrize("frames", [1, 3])
def test_the_loop_plays_the_policy_one_step_late(tmp_path, monkeypatch, frames):
    """As a loop of the package's own policy and the task's own observation does."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import robot_loop

    task = envs.make("quadruped:Quadruped")
    assert task.dt == robot_loop.PERIOD
    sizes = {"observation_size": 35 * frames, "frames": frames}
    run = make_run(tmp_path / "run", "InvertedPendulum-v5", **sizes, **SPACE)
    change_env(run, "quadruped:Quadruped")
    output = tmp_path / "policy.npz"
    run_export(monkeypatch, run, "--env", "quadruped:Quadruped", "--output", output)
    waited = []
    model = task.mj_model
    policy = import_file(tmp_path / "policy.py")
    positions = robot_loop.run(policy, model, 20, waited.append).positions
    assert waited == [*range(20)]

    player = load(run)
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    seen = [np.asarray(task.observe(data))] * frames
    action = np.zeros(12)
    for position in positions[1:]:
        seen = [*seen[1:], np.asarray(task.observe(data))]
        data.ctrl[:] = action
        action = np.asarray(player.act(np.concatenate(seen)))
        mujoco.mj_step(model, data, task.frame_skip)  # pyright: ignore
        np.testing.assert_allclose(position, data.qpos, atol=1e-4)
    assert np.abs(positions[-1] - positions[0]).max() > 0.02


#: A pose in which the quadruped does not stand at zero.
KEY = """<keyframe>
  <key qpos="1 2 0.31 1 0 0 0 0 0.1 -0.2 0 0.1 -0.2 0 0.1 -0.2 0 0.1 -0.2"/></keyframe></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("key", ["", KEY])
def test_the_loop_walks_as_the_class_that_new_writes(tmp_path, monkeypatch, key):
    """Its observations and controls are those of the task without noise and pushes."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import robot_loop

    text = (EXAMPLES / "quadruped.xml").read_text()
    (tmp_path / "dog.xml").write_text(text.replace("</mujoco>", key or "</mujoco>"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["new", "dog.xml"])
    new.main()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "dog", raising=False)
    dog = importlib.import_module("dog")
    command = np.array([0.5, -0.1, 0.2])

    class Calm(dog.Dog):
        """It starts at rest in its first pose, and obeys one command."""

        def initial(self, rng):
            if key:
                return self.key_frame(0)
            return jnp.asarray(self.mj_model.qpos0), jnp.zeros(self.mj_model.nv)

        def randomize(self, rng):
            return {}

        def command(self, rng):
            return jnp.asarray(command, float)

        def memory(self, rng, data):
            return super().memory(rng, data) | {"step": jnp.zeros((), int)}

    monkeypatch.setattr(dog, "NOISE", 0 * dog.NOISE)
    task = Calm()
    assert task.dt == pytest.approx(robot_loop.PERIOD)
    size = task.observation_size
    run = make_run(tmp_path / "run", "InvertedPendulum-v5", observation_size=size, **SPACE)
    change_env(run, "dog:Dog")
    run_export(monkeypatch, run, "--env", "dog:Dog", "--output", tmp_path / "policy.npz")
    policy = import_file(tmp_path / "policy.py")
    model = task.mj_model
    observe = robot_loop.legged(policy, model, command)
    walk = robot_loop.run(policy, model, 50, lambda step: None, observe)

    player = load(run)
    robot = InMujoco(task)
    observation = robot.reset(jax.random.key(0))
    for seen, ctrl in zip(walk.observations, walk.controls, strict=True):
        np.testing.assert_allclose(seen, observation, atol=1e-5)
        observation, _, _ = robot.step(np.asarray(player.act(observation)))
        np.testing.assert_allclose(ctrl, robot.data.ctrl, atol=1e-5)
    # The gait is as long as half of the steps, and the policy does more than the gait.
    assert np.abs(walk.controls[25:] - walk.controls[:25]).max() > 0.1


GLIDER = """<mujoco><option timestep="0.004" gravity="0 0 0"/><worldbody><body>
  <freejoint/><geom size="0.1"/></body></worldbody>
  <keyframe><key qpos="0 0 0 1 0 0 1" qvel="{}"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("qvel", "words"),
    [
        (
            "-0.1 0.5 0 0 0 0",
            "5.10 m in 10 s: 0.50 m/s forward, 0.10 m/s sideways, 0.00 rad/s to the left",
        ),
        (
            "0 0 0 0 0 0.3",
            "0.00 m in 10 s: 0.00 m/s forward, 0.00 m/s sideways, 0.30 rad/s to the left",
        ),
    ],
)
def test_the_speeds_are_those_of_the_robot_s_frame(monkeypatch, qvel, words):
    """It looks along y."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import robot_loop

    model: Any = mujoco.MjModel.from_xml_string(GLIDER.format(qvel))  # pyright: ignore
    policy = SimpleNamespace(
        P={}, act=lambda observation: np.zeros(0), control=lambda action: action
    )
    walk = robot_loop.run(policy, model, 500, lambda step: None)
    assert robot_loop.summary(walk) == f"walked {words}"


def test_the_clock_says_what_is_late(monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)
    import robot_loop

    now, slept = [0.0], []
    monkeypatch.setattr(robot_loop.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(robot_loop.time, "sleep", slept.append)
    wait = robot_loop.wall_clock()
    for step, time in enumerate((0.005, 0.047, 0.05)):
        now[0] = time
        wait(step)
    np.testing.assert_allclose(slept, [0.015, 0, 0.01], atol=1e-12)
    assert capsys.readouterr().out == "step 1 was 7.0 ms late\n"

"""The program of a robot sees what the task shows, and its actions come one step late."""

import mujoco
import numpy as np
import pytest
from exports import import_file, run_export
from places import ROOT
from saved_runs import change_env, make_run

from mjx_reinforce import envs, load

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
    positions = robot_loop.run(policy, model, 20, waited.append)
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

"""Your own robot: the arm of the example learns to reach, and a model becomes a class."""

import csv
import shutil
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from new_classes import lint, write
from places import ROOT

import mjx_reinforce as mr
from mjx_reinforce import envs
from mjx_reinforce.engine import choose
from mjx_reinforce.engine.play import cxx
from mjx_reinforce.envs.refusals import best_in_c

EXAMPLES = ROOT / "experiments" / "examples"
SENSED = """<mujoco><option timestep="0.002"/><worldbody>
  <body><freejoint/><geom size="0.1"/><site name="end-effector"/>
    <body><joint axis="0 1 0"/><geom size="0.1"/></body></body></worldbody>
  <actuator><motor joint="j"/></actuator><sensor><gyro site="end-effector"/></sensor></mujoco>"""


@pytest.mark.slow
def test_the_arm_learns_to_reach(tmp_path):
    command = [sys.executable, "-m", "mjx_reinforce.train", "--env", "my_arm:Arm"]
    options = ["--num-episodes", "64", "--env-steps", "200_000", "--num-seeds", "1"]
    output = ["--output", str(tmp_path / "arm")]
    subprocess.run([*command, *options, *output], check=True, capture_output=True, cwd=EXAMPLES)
    with (tmp_path / "arm" / "metrics.csv").open() as file:
        rows = [*csv.DictReader(file)]
    returns = [float(row["eval_return"]) for row in rows if row["seed"] == "0"]
    assert returns[-1] > returns[0] / 2  # both are negative: half of the way is left


@pytest.mark.slow
def test_the_arm_is_paid_for_the_distance_of_the_ball(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    env = envs.make("my_arm:Arm")
    qpos, qvel = env.initial(jax.random.key(0))
    assert (qpos.shape, qvel.shape, env.action_size) == ((6,), (6,), 3)
    state = env.set_state(jnp.zeros(6).at[3:].set(jnp.array([0.3, 0.0, 0.2])), qvel)
    tip = np.array([0.0, 0.0, 0.83])
    np.testing.assert_allclose(state.obs[-3:], np.array([0.3, 0.0, 0.2]) - tip, atol=1e-6)
    starts = jax.vmap(env.initial)(jax.random.split(jax.random.key(1), 100))[0]
    assert np.all(np.linalg.norm(starts[:, 3:], axis=1) < 0.75)  # within reach


def test_a_model_becomes_a_class_that_plays(tmp_path, monkeypatch, capsys):
    shutil.copy(EXAMPLES / "my_arm.xml", tmp_path / "my_robot-2.xml")
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "my_robot-2.xml")
    assert "--env my_robot_2:MyRobot2 --output my_robot_2_run" in capsys.readouterr().out
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("my_robot_2:MyRobot2")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(3))
    assert after.obs.shape == (12,)
    assert set(after.metrics) == {"reward_pose", "reward_control"}
    assert 'actuator "shoulder" in [-0.523599, ' in (tmp_path / "my_robot_2.py").read_text()
    lint("my_robot_2.py")


def test_names_of_a_model_cannot_break_the_class(tmp_path, monkeypatch):
    joint = """<joint name='say "it"\\' axis"""
    named = SENSED.replace("<joint axis", joint).replace('joint="j"', """joint='say "it"\\'""")
    (tmp_path / "sensed.xml").write_text(named)
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "sensed.xml")
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("sensed:Sensed")
    assert (env.dt, env.max_episode_steps) == (pytest.approx(0.04), 125)
    assert env.observation_size == 8 - 2 + 7 + 3
    assert r'data.joint("say \"it\"\\").qpos' in (tmp_path / "sensed.py").read_text()


@pytest.mark.slow
def test_a_walker_starts_in_its_key_frame(tmp_path, monkeypatch):
    """It sees no place on the floor, speed pays, and a fall ends it."""
    key = '<keyframe><key qpos="0 0 .2 .6 0 .8 0 -1" ctrl="-.5"/></keyframe></mujoco>'
    text = SENSED.replace("<joint axis", '<joint name="j" range="-120 -30" axis')
    (tmp_path / "kept.xml").write_text(text.replace("</mujoco>", key))
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "kept.xml")
    monkeypatch.syspath_prepend(tmp_path)
    env, home = envs.make("kept:Kept"), np.array([0, 0, 0.2, 0.6, 0, 0.8, 0, -1])
    start = env.initial(jax.random.key(0))
    qvel = start["qvel"]
    np.testing.assert_allclose(start["qpos"], home, atol=1e-6)
    np.testing.assert_allclose(start["ctrl"], [-0.5])
    assert 0 < np.abs(qvel).max() < 0.1
    state = env.set_state(jnp.asarray(home), qvel)
    np.testing.assert_allclose(state.obs[:6], home[2:], atol=1e-6)
    upright = np.array([np.eye(3), [[-0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, -0.28]]])
    stands = types.SimpleNamespace(qpos=home, xmat=upright)
    moved = home + np.array([env.dt, 0, -0.1, 0, 0, 0, 0, 0])
    fallen = types.SimpleNamespace(qpos=moved, xmat=upright)
    tilted = types.SimpleNamespace(qpos=home, xmat=np.array([np.eye(3), np.eye(3)]))
    action = jnp.zeros(1)  # that of the key frame costs nothing
    np.testing.assert_allclose(env.control(action), [-0.5])
    found = [env.outcome(stands, after, action)[:2] for after in (stands, fallen, tilted)]
    assert found == [(1, False), (pytest.approx(2), True), (1, True)]
    lint("kept.py")


SERVO = """<mujoco><compiler angle="radian"/><option timestep="0.002"/><worldbody><body pos="0 0 1">
  <joint name="j" axis="0 1 0" range="-1 3" damping="1"/><geom size=".05" pos=".2 0 0" mass=".1"/>
  </body></worldbody><actuator><position joint="j" kp="100" ctrlrange="-1 3"/>
  <motor joint="j" gear="0.0001" ctrlrange="0 255"/></actuator>
  <keyframe><key qpos="2.2" ctrl="2.2 0"/></keyframe></mujoco>"""


@pytest.mark.slow
def test_an_untrained_policy_holds_the_key_frame(tmp_path, monkeypatch):
    """The middle of ctrlrange, 1 rad and 127.5, is elsewhere; and a large unit costs no more."""
    (tmp_path / "servo.xml").write_text(SERVO)
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "servo.xml")
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("servo:Servo")
    learner = mr.reinforce(env)
    actor = learner.init(jax.random.key(0)).actor
    step, state = jax.jit(env.step), env.reset(jax.random.key(0))
    for _ in range(env.max_episode_steps):
        outputs = mr.act(learner.policy, actor, state.obs)
        state = step(state, learner.policy.distribution.mode(outputs))
        assert state.obs[0] == pytest.approx(2.2, abs=0.1)
        assert state.metrics["reward_control"] > -0.01
    np.testing.assert_allclose(env.control(jnp.array([0.0, 2.0])), [2.2, 255.0], rtol=1e-6)
    reward = env.outcome(state.pipeline_state, state.pipeline_state, jnp.array([0.0, 2.0]))
    assert reward[2]["reward_control"] == pytest.approx(-0.04)
    lint("servo.py")


def test_servos_whose_key_frame_has_no_controls_hold_its_angles(tmp_path, monkeypatch):
    """Also on legs, where actions reach less far."""
    text = SENSED.replace("<joint axis", '<joint name="j" range="-120 -30" axis')
    servo = '<position joint="j" kp="20" ctrlrange="-2 2"/>'
    text = text.replace('<motor joint="j"/>', servo)
    key = '<keyframe><key name="stand" qpos="0 0 .2 1 0 0 0 -1"/></keyframe></mujoco>'
    (tmp_path / "legs.xml").write_text(text.replace("</mujoco>", key))
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "legs.xml")
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("legs:Legs")
    np.testing.assert_allclose(env.control(np.array([0.0])), [-1.0])
    np.testing.assert_allclose(env.control(np.array([1.0])), [-0.5])
    np.testing.assert_allclose(env.initial(jax.random.key(0))["ctrl"], [-1.0])
    assert (env.action_space.low, env.action_space.high) == (-1, 1)
    lint("legs.py")


#: What a quadruped no longer has: an edit of its file, and what ``new`` says of it.
LACKS = {
    "servos": ("<position joint", "<motor joint", "<position> servos with gear 1 of hinges"),
    "a floor": (
        'conaffinity="1" rgba',
        'contype="0" rgba',
        "two feet that come nearest to a",
    ),
    "a name": ('name="torso"', "", "a name of the body of its free joint"),
    "nothing": ("", "", None),
}


@pytest.mark.parametrize("lack", LACKS)
def test_what_keeps_a_robot_from_legs_is_named(tmp_path, monkeypatch, capsys, lack):
    part, other_part, words = LACKS[lack]
    text = (EXAMPLES / "quadruped.xml").read_text()
    assert part in text
    (tmp_path / "robot.xml").write_text(text.replace(part, other_part))
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "robot.xml")
    said = capsys.readouterr().out
    if words is None:
        assert "lacks" not in said
        assert "robot.py: it walks as commanded" in said
        assert "train legged --env robot:Robot --minutes 20 --output robot_run" in said
        # Without the task, the policy in C would have no control.
        assert "export robot_run --env robot:Robot" in (tmp_path / "robot.py").read_text()
    else:
        assert f"for the class of a robot on legs the model lacks {words}" in said
        assert "robot.py: write its reward" in said
        assert "train --env robot:Robot --output robot_run" in said


def test_a_model_that_mjx_refuses_is_played_by_c_mujoco(tmp_path, monkeypatch, capsys):
    arm = (EXAMPLES / "my_arm.xml").read_text()
    (tmp_path / "pgs.xml").write_text(arm.replace("<option", '<option solver="PGS"'))
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "pgs.xml")
    assert "C MuJoCo will play it: MJX has no mjSOL_PGS\n" in capsys.readouterr().out
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("pgs:Pgs")
    assert choose("auto", env).name == "mujoco"
    assert np.isfinite(env.step(env.reset(jax.random.key(0)), jnp.zeros(3)).reward)


@pytest.mark.parametrize("compiler", [None, "/usr/bin/c++"])
def test_a_compiler_of_this_system_may_play_a_model(compiler, tmp_path, monkeypatch, capsys):
    arm = (EXAMPLES / "my_arm.xml").read_text()
    (tmp_path / "cones.xml").write_text(arm.replace("<option", '<option cone="elliptic"'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cxx, "compiler", lambda: compiler)
    write(monkeypatch, "cones.xml")
    said = capsys.readouterr().out
    if compiler is None:
        assert "C MuJoCo will play it: " in said
    else:
        assert f"machine code by {compiler} will play it, and C MuJoCo where there is none" in said


def test_an_unstable_model_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "stiff.xml").write_text(SERVO.replace('kp="100"', 'kp="1e9"'))
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "stiff.xml")
    assert "unstable in C MuJoCo itself: under no control it explodes after 0" in (
        said := capsys.readouterr().out
    )
    assert "(DOF 0, joint 'j'); implicitfast, damping of servos, armature" in said
    assert "--fix" not in said  # no remedy helps
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stiff.py", "stiff.xml"]


def test_fix_writes_a_mended_copy_and_its_class(tmp_path, monkeypatch, capsys):
    """Without it the same changes are named; a file is replaced on demand alone."""
    text = SERVO.replace('kp="100"', 'kp="20000"').replace("<option", '<option solver="PGS"')
    (tmp_path / "servo.xml").write_text(text)
    monkeypatch.chdir(tmp_path)
    write(monkeypatch, "servo.xml")
    offer = capsys.readouterr().out
    assert "MJX has no mjSOL_PGS" in offer
    assert not (tmp_path / "servo_fixed.xml").exists()
    write(monkeypatch, "servo.xml", "--fix")
    changes, _, rest = capsys.readouterr().out.partition("0 possible contacts")
    assert changes.startswith('servo_fixed.xml:\n  solver="Newton" in place of PGS\n  integrator=')
    assert changes.partition("\n")[2] in offer
    assert "unstable" in offer
    assert "unstable" not in rest
    assert "machine code will play it\n" in rest
    assert "servo_fixed:ServoFixed" in rest
    assert (tmp_path / "servo.xml").read_text() == text
    monkeypatch.syspath_prepend(tmp_path)
    env = envs.make("servo_fixed:ServoFixed")
    assert best_in_c(env.mj_model) is None  # but machine code
    with pytest.raises(SystemExit, match="2"):
        write(monkeypatch, "servo.xml", "--fix")
    assert "servo_fixed.py exists; pass --overwrite" in capsys.readouterr().err
    # A model that somebody changed since is not overwritten, either.
    (tmp_path / "servo_fixed.py").unlink()
    with pytest.raises(SystemExit, match="2"):
        write(monkeypatch, "servo.xml", "--fix")
    assert "servo_fixed.xml exists; pass --overwrite" in capsys.readouterr().err
    # Where the class cannot be written, nothing is.
    (tmp_path / "servo_fixed.xml").rename(tmp_path / "kept.xml")
    (tmp_path / "servo_fixed.py").write_text("mine")
    with pytest.raises(SystemExit, match="2"):
        write(monkeypatch, "servo.xml", "--fix")
    assert not (tmp_path / "servo_fixed.xml").exists()
    (tmp_path / "kept.xml").rename(tmp_path / "servo_fixed.xml")
    write(monkeypatch, "servo_fixed.xml", "--fix", "--output", "twice.py")
    assert "servo_fixed.xml needs no fix\n" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.glob("*.xml")) == ["servo.xml", "servo_fixed.xml"]


WRONG = {
    "nothing.xml": "there is no model",
    "model.urdf": "model.urdf is not a model; give an MJCF file that ends in .xml",
    "arm.xml --output json.py": "cannot import 'json.py' beside",
    "arm.xml --output my-arm.py": "Python cannot import 'my-arm.py'",
    "arm.xml --output ../arm.py": "must be in the folder of arm.xml",
    "arm.xml --output there.py": "there.py exists; pass --overwrite",
    "still.xml": "has no actuators",
    "broken.xml": "MuJoCo cannot compile",
    "timeless.xml --fix": "has the timestep 0.0; write a finite number of seconds above 0",
}


@pytest.mark.parametrize("arguments", WRONG)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, arguments):
    arm = (EXAMPLES / "my_arm.xml").read_text()
    texts = {"arm": arm, "still": "<mujoco/>", "broken": "<mujoco"}
    texts["timeless"] = arm.replace("<worldbody>", '<option timestep="0"/><worldbody>')
    for name, text in texts.items():
        (tmp_path / f"{name}.xml").write_text(text)
    (tmp_path / "there.py").write_text("")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        write(monkeypatch, *arguments.split())
    error = capsys.readouterr().err
    assert WRONG[arguments] in error
    assert error.count("\n") == 1
    assert not (tmp_path / "arm.py").exists()

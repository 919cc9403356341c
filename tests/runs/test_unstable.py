"""A model of the user's own that explodes in C MuJoCo is told from a bad learning rate."""

import mujoco
import pytest

from mjx_reinforce.envs import models
from mjx_reinforce.envs.instability import instability, remedy

TASK = """
import jax.numpy as jnp
from mujoco import MjModel
from mjx_reinforce.envs.base import MujocoEnv

class Stiff(MujocoEnv):
    def __init__(self):
        model = MjModel.from_xml_path("stiff.xml")
        super().__init__(
            xml_file=model, frame_skip=2, max_episode_steps=20, reward_threshold=None
        )

    def initial(self, rng):
        return jnp.zeros(1), jnp.zeros(1)

    def outcome(self, before, data, action):
        return 0.0, False, {}
"""
STIFF = """<mujoco><option timestep="0.01"/><worldbody><body><joint name="x" axis="0 1 0"/>
  <geom size=".1" pos=".2 0 0" mass=".1"/></body></worldbody>
  <actuator><position joint="x" kp="{}" ctrlrange="-1 1"/></actuator></mujoco>"""
SAID = "unstable in C MuJoCo itself: under no control it explodes after"


def test_c_mujoco_says_whether_and_where(tmp_path, monkeypatch):
    """Also under random controls alone, from the key frame; no file is left, no handler changed."""
    monkeypatch.chdir(tmp_path)
    read = mujoco.MjModel.from_xml_string  # pyright: ignore[reportAttributeAccessIssue]
    before = mujoco.get_mju_user_warning()  # pyright: ignore[reportAttributeAccessIssue]
    assert instability(read(STIFF.format(1))) is None
    said = instability(read(STIFF.format(1e9)))
    assert f"{SAID} 0.0" in said
    assert "(DOF 0, joint 'x'); implicitfast, damping of servos, armature 0.01, half" in said
    assert said.endswith("do not mend it: try softer servos")
    calm = STIFF.format(1e9).replace("<option", '<option gravity="0 0 0"')
    assert "under random controls it explodes after 0" in instability(read(calm))
    key = '<keyframe><key qpos="1e11"/></keyframe></mujoco>'
    far = instability(read(STIFF.format(1).replace("</mujoco>", key)))
    assert "after 0 s (qpos 0, joint 'x')" in far
    assert mujoco.get_mju_user_warning() is before  # pyright: ignore[reportAttributeAccessIssue]
    assert not [*tmp_path.iterdir()]


#: What mends a model -> the attributes of its servo.
REMEDIES = {
    'integrator="implicitfast"': 'kp="1" kv="5"',
    "armature 0.01 of joints": 'kp="400"',
    'integrator="implicitfast" and kv 3.98 of servos': 'kp="900"',
    'integrator="implicitfast" and armature 0.01 of joints and kv 5.93 of servos and '
    "timestep 0.005": 'kp="2000"',
}


@pytest.mark.parametrize("words", REMEDIES)
def test_the_remedy_is_one_that_was_tried(words):
    """It is the first after which a second passes in C MuJoCo; the model stays as it is."""
    text = STIFF.replace('kp="{}"', REMEDIES[words])
    model = mujoco.MjModel.from_xml_string(text)  # pyright: ignore[reportAttributeAccessIssue]
    before = models.digest(model)
    said = instability(model)
    assert models.digest(model) == before
    assert f"with {words} it is stable" in said
    assert instability(remedy(model).model) is None


@pytest.mark.slow
def test_training_says_so_before_and_where_it_stops(run, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "stiff_task.py").write_text(TASK)
    (tmp_path / "stiff.xml").write_text(STIFF.format(1e9))
    flags = ["--env", "stiff_task:Stiff", "--num-seeds", "1", "--env-steps", "100000"]
    assert run(*flags, "--hidden-sizes", "4", "--output", "out") == 1
    said = capsys.readouterr().out
    assert said.count(SAID) == 2
    assert said.index(SAID) < said.index("compiled in") < said.rindex(SAID)
    assert "broken throughout" in said[said.index("stopped:") : said.rindex(SAID)]
    assert said.count("met values that are not finite") == 1

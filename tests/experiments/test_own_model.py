"""A user's own MJCF: the 20-line script trains, and what MJX cannot run is explained."""

import re
import subprocess
import sys

import jax
import mujoco
import pytest
from mujoco import mjx
from places import ROOT

from mjx_reinforce import envs
from mjx_reinforce.envs import models
from mjx_reinforce.envs.refusals import UnsupportedError

SCRIPT = ROOT / "experiments" / "examples" / "own_model.py"
ONE_JOINT = """
<mujoco>
  <option {option}/>
  <worldbody>
    <geom type="{floor}" size="1 1 1"/>
    <body><joint/><geom type="ellipsoid" size=".1 .2 .3"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
def test_the_script_learns():
    command = [sys.executable, "-W", "ignore", str(SCRIPT)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    returns = [float(x) for x in re.findall(r"return +(-?[\d.]+)", printed)]
    assert len(returns) == 4
    assert returns[-1] > returns[0] / 3


@pytest.mark.parametrize(
    ("option", "floor", "message"),
    [
        ('solver="PGS"', "plane", "SOL_PGS.*Newton"),
        ('integrator="implicit"', "plane", "implicitfast"),
        ('integrator="implicitfast" density="1"', "plane", "fluid drag.*Euler"),
    ],
)
def test_what_mjx_lacks_is_named_with_a_remedy(option, floor, message):
    MjModel = mujoco.MjModel  # pyright: ignore[reportAttributeAccessIssue] # noqa: N806
    model = MjModel.from_xml_string(ONE_JOINT.format(option=option, floor=floor))
    with pytest.raises(UnsupportedError, match=message):
        models.to_mjx(model, "mine.xml")


#: What a user may have written, and what the message must say.
REFUSED = {
    '<actuator><adhesion body="b" ctrlrange="0 1" gain="1"/></actuator>': "TRN_BODY.*friction",
    '<actuator><general cranksite="s" slidersite="t" cranklength="1"/></actuator>': (
        "TRN_SLIDERCRANK.*<connect>"
    ),
    '<actuator><general joint="j" gaintype="user"/></actuator>': "GAIN_USER.*<motor>",
    '<option><flag multiccd="disable"/></option>': 'ignore <flag multiccd="disable"/>; remove it',
    '<worldbody><geom type="box" size="1 1 1" margin=".1"/><body name="c"><freejoint/>'
    '<geom type="box" size="1 1 1"/></body></worldbody>': (
        "box on box with a margin or gap, which MJX ignores .*; remove margin"
    ),
    '<tendon><fixed range="0 1" margin=".6"><joint joint="j" coef="1"/></fixed></tendon>': (
        "two limits that a tendon meets.*margin of at most half"
    ),
    '<default><joint range="-1 2" margin=".03"/></default>': "two limits that a joint meets",
    '<default><joint solreflimit="-100 1"/></default>': "solref of mixed signs.*two positive",
    '<sensor><user dim="1"/></sensor>': "SENS_USER.*remove those sensors",
    '<sensor><rangefinder site="s"/></sensor>': 'rangefinders.*<material name="any"/>',
}


@pytest.mark.parametrize("element", REFUSED)
def test_what_mjx_lacks_beside_options(element):
    text = f"""<mujoco>{element}<worldbody><site name="t"/><body name="b"><joint name="j"/>
        <geom size="1"/><site name="s"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(UnsupportedError, match=REFUSED[element]):
        models.to_mjx(model, "mine.xml")


RANGEFINDER = """<mujoco><option><flag energy="enable" fwdinv="enable"/></option>
  <asset><material name="any"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body pos="0 0 1"><joint name="j"/><geom size="0.1"/>
      <site name="s" zaxis="0 0 -1"/></body></worldbody>
  <actuator><motor joint="j"/></actuator>
  <sensor><rangefinder site="s"/></sensor></mujoco>"""


def test_what_only_reports_is_turned_off_and_a_rangefinder_measures(tmp_path):
    (tmp_path / "mine.xml").write_text(RANGEFINDER, encoding="utf-8")
    model = models.load_model(str(tmp_path / "mine.xml"))
    ours, data = models.to_mjx(model, "mine.xml"), mjx.make_data(model, impl="jax")
    seen = jax.jit(lambda: mjx.sensor_pos(ours, mjx.kinematics(ours, data)))()
    assert float(seen.sensordata[0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("xml_file", "message"),
    [("mine.xml", r"'\./mine.xml'"), ("./mine.xml", "there is no model")],
)
def test_missing_files_are_explained(xml_file, message):
    with pytest.raises(ValueError, match=message):
        envs.make("InvertedPendulum-v5", xml_file=xml_file)


def test_a_model_without_actuators_is_explained(tmp_path):
    path = tmp_path / "still.xml"
    path.write_text(ONE_JOINT.format(option="", floor="plane"), encoding="utf-8")
    with pytest.raises(ValueError, match="no actuators"):
        envs.make("InvertedPendulum-v5", xml_file=str(path))


def test_a_class_of_ones_own_by_module_and_name(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    assert envs.make("own_model:Crane").max_episode_steps == 100


@pytest.mark.parametrize("id", ["own_modle:Crane", "own_model:Crain"])
def test_a_class_that_is_not_there_is_explained(monkeypatch, id):
    monkeypatch.syspath_prepend(SCRIPT.parent)
    with pytest.raises(ValueError, match="cannot import the environment"):
        envs.make(id)

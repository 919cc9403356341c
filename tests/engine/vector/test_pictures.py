"""Pictures of a model: they draw, so each in a process of its own, by its pixels."""

import json
import subprocess
import sys

import pytest


def in_its_own_process(code, *arguments):
    """What a program prints as JSON; it is told to draw without a screen when MuJoCo is imported.

    It says nothing on stderr: a renderer that stays open complains there when Python ends.
    """
    command = [sys.executable, "-c", code, *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (ran.returncode, ran.stderr) == (0, "")
    return json.loads(ran.stdout)


#: The spread of shades in the lowest tenth of pictures, where the floor is.
TASKS = """
import json, sys
from mjx_reinforce.export.films import Renderer, import_mujoco
import_mujoco()
from mjx_reinforce.envs import models
spread = {}
for name in sys.argv[1:]:
    model = models.load_model(f"{name}.xml")
    renderer, qpos = Renderer(model, 120, 90), model.qpos0.copy()
    spread[name] = []
    for x in (0, 45, 300):
        qpos[0] = x
        spread[name].append(float(renderer.draw(qpos)[-9:].std()))
print(json.dumps(spread))
"""


@pytest.mark.slow
def test_floors_have_no_end():
    """The models of Gymnasium have 20 to 40 m; HalfCheetah runs 300 m in an episode."""
    tasks = ["half_cheetah", "ant", "walker2d", "hopper", "swimmer", "humanoid", "humanoid_standup"]
    for name, shades in in_its_own_process(TASKS, *tasks).items():
        assert min(shades) > 50, name  # its checkers are black and nearly white


#: Pictures of a ball on a floor of 3 m, by MuJoCo alone and by ours, and the same ones farther on.
OWN = """
import json, sys
import numpy as np
from mjx_reinforce.export.films import Renderer, import_mujoco
mujoco = import_mujoco()
model = mujoco.MjModel.from_xml_string('''<mujoco>
  <asset><texture name="t" type="2d" builtin="checker" width="64" height="64" rgb1="0 0 0"/>
  <material name="m" texture="t" texrepeat="6 6" texuniform="%s"/></asset>
  <worldbody><body><body><geom name="floor" type="plane" size="3 3 .1" material="m"/></body></body>
    <geom type="plane" size="1 1 .1" pos="0 9 1" euler="90 0 0"/>
    <body pos="0 0 .5"><freejoint/><geom size=".1"/>
      <camera name="track" mode="trackcom" pos="0 -1 1" xyaxes="1 0 0 0 1 1"/></body>
  </worldbody></mujoco>''' % sys.argv[1])
model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
model.vis.headlight.specular[:] = 0
data, plain, ours = mujoco.MjData(model), mujoco.Renderer(model, 90, 120), Renderer(model, 120, 90)
mujoco.mj_forward(model, data)
plain.update_scene(data, "track")
first, pictures = plain.render().astype(int), []
plain.close()
for x in (0, 45, 300, 300 + float(sys.argv[2])):
    qpos = model.qpos0.copy()
    qpos[0] = x
    pictures.append(ours.draw(qpos)[-30:].astype(int))
apart = [float(np.abs(picture - first[-30:]).mean()) for picture in pictures]
print(json.dumps([*apart, model.geom_size[:, 0].tolist()]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("uniform", "half_a_repeat"), [("false", 0.5), ("true", 1 / 6)])
def test_a_floors_texture_keeps_its_scale(uniform, half_a_repeat):
    """Drawn as MuJoCo draws the finite floor, whole repeats away too; half a repeat swaps it."""
    *same, swapped, sizes = in_its_own_process(OWN, uniform, str(half_a_repeat))
    assert max(same) < 6
    assert swapped > 60
    assert sizes == [1, 3, 0.1]  # the model itself is as it was

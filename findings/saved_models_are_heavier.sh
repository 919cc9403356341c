#!/usr/bin/env bash
# mujoco 4.0.0: <geom mass="0" density="0"/> in a default class is how robots of MuJoCo Menagerie
# (franka_fr3, low_cost_robot_arm) say that a shape only collides. mj_saveLastXML and MjSpec.to_xml
# write neither number, so the saved model loads without a word, and its shapes have the density of
# water: this pendulum gains 4.2 kg, and falls half as fast again. Either number alone is kept, and so
# are both on the geom itself.
# Seen with: Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0
"$folder/venv/bin/python" - "$folder/saved.xml" <<'PROGRAM'
import sys

import mujoco

PENDULUM = """<mujoco>
  <default><default class="collision"><geom {of_class}/></default></default>
  <worldbody><body><joint axis="0 1 0"/>
    <geom size=".05" pos="1 0 0" mass="1"/>
    <geom class="collision" size=".1" pos=".5 0 0" {of_geom}/>
  </body></worldbody>
</mujoco>"""


def description(model):
    """Returns the mass (kg) and the angular acceleration (rad/s2) of a level pendulum."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return round(float(model.body_mass[1]), 3), round(float(data.qacc[0]), 3)


def descriptions(of_class, of_geom=""):
    """Returns the description of a model, and that of the model that is saved and loaded."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(of_class=of_class, of_geom=of_geom))
    mujoco.mj_saveLastXML(sys.argv[1], model)
    return description(model), description(mujoco.MjModel.from_xml_path(sys.argv[1]))


original, reloaded = descriptions('mass="0" density="0"')
print(f"mujoco {mujoco.__version__}: {original} as it is, {reloaded} saved and loaded")
assert original[0] == 1 and original[1] < 10
assert reloaded[0] > 5 and reloaded[1] > 14
for of_class, of_geom in (('mass="0"', ""), ('density="0"', ""), ("", 'mass="0" density="0"')):
    assert descriptions(of_class, of_geom) == (original, original), (of_class, of_geom)
PROGRAM

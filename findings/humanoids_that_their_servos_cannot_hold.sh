#!/usr/bin/env bash
# playground 0.2.0 and mujoco 4.0.0 (2026-11-29).
#
# Two humanoid robots of MuJoCo Playground do not stand in the first key frame of their own files, with
# its controls held: Unitree G1 ("home") has fallen after 1.2 s, Apptronik Apollo ("stand") after 2 s,
# although the center of mass is above the feet. The servos are too soft: G1's ankles turn its feet with
# 40 N m/rad together, while its weight turns it over the ankles with 208 N m/rad. Stiffer ankles alone
# do not help, for knees, hips, and waist give way, too. With the servos of all these that pitch twelve
# times as stiff, and joints damped twice as much, the same file stands for 10 s. So does Robotis OP3 as
# it is. Who trains G1 to stand before it walks, trains balance from the first step on.
#
# Expected: a key frame called "home" or "stand" that its own controls hold. Seen:
#
#     G1 servos 40 N m/rad, weight 208 N m/rad, falls after 1.16 s; ankles alone 12 times as stiff:
#     1.89 s; all that pitch: 10.00 s; Apollo 2.01 s; OP3 10.00 s
#
# The files name meshes that the package downloads elsewhere; they are drawn only, and left out here.
# This script ends with status 1 where that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check mujoco==4.0.0
"$folder/venv/bin/pip" install -q --disable-pip-version-check --no-deps --target "$folder/robots" playground==0.2.0
cat > "$folder/stand.py" <<'PYTHON'
import pathlib
import sys

import mujoco

ROBOTS = pathlib.Path(sys.argv[1]) / "mujoco_playground/_src/locomotion"
SECONDS = 10.0


def load(robot, scene):
    """Returns the compiled model of a scene without its meshes."""
    spec = mujoco.MjSpec.from_file(str(ROBOTS / robot / "xmls" / scene))
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return spec.compile()


def g1(factor=1.0, names=()):
    """Returns G1, servos with such names so much stiffer, and their joints damped twice as much."""
    model = load("g1", "scene_mjx_feetonly_flat_terrain.xml")
    for number in range(model.nu):
        if any(name in model.actuator(number).name for name in names):
            model.actuator_gainprm[number, 0] *= factor
            model.actuator_biasprm[number, 1] *= factor
            model.dof_damping[model.jnt_dofadr[model.actuator_trnid[number, 0]]] *= 2
    return model


def time_to_fall(model):
    """Returns when the robot has tilted by 53 degrees (s) if it holds its first key frame."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = model.key_ctrl[0]
    root = model.jnt_bodyid[0]
    while data.time < SECONDS and (data.time == 0 or data.xmat[root, 8] >= 0.6):
        mujoco.mj_step(model, data)
    return data.time


def overturning(model, ankles):
    """Returns what the weight does over the ankles (N m/rad)."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    root = model.jnt_bodyid[0]
    height = data.subtree_com[root, 2] - data.xanchor[model.actuator_trnid[ankles[0], 0], 2]
    return 9.81 * model.body_subtreemass[root] * height


model = g1()
ankles = [model.actuator(f"{side}_ankle_pitch_joint").id for side in ("left", "right")]
servos = model.actuator_gainprm[ankles, 0].sum()
weight = overturning(model, ankles)
falls = time_to_fall(model)
stiff_ankles = time_to_fall(g1(12, ["ankle_pitch"]))
stiff = time_to_fall(g1(12, ["ankle_pitch", "knee", "hip_pitch", "waist_pitch"]))
apollo = time_to_fall(load("apollo", "scene_mjx_feetonly_flat_terrain.xml"))
op3 = time_to_fall(load("op3", "scene_mjx_feetonly.xml"))
print(f"G1 servos {servos:.0f} N m/rad, weight {weight:.0f} N m/rad, falls after {falls:.2f} s; ", end="")
print(f"ankles alone 12 times as stiff: {stiff_ankles:.2f} s; all that pitch: {stiff:.2f} s; ", end="")
print(f"Apollo {apollo:.2f} s; OP3 {op3:.2f} s")
seen = falls < 2 and stiff_ankles < 4 and apollo < 3 and stiff >= SECONDS and op3 >= SECONDS
sys.exit(0 if seen else "no longer as stated")
PYTHON
"$folder/venv/bin/python" "$folder/stand.py" "$folder/robots"

#!/usr/bin/env bash
# MuJoCo 4.0.0: with the default tolerance of 1e-8, one step of a walking robot with elliptic friction
# cones has velocities that are up to 5e-5 from those with tolerance 0; with pyramidal cones, the same
# robot under the same controls stays within 1e-14. The cost of pyramids is quadratic in pieces, so
# that Newton's method ends at the optimum whatever the tolerance; the cost of a cone that slides is
# not, and the test of the improvement, scaled by the inertia, ends the search early. Who compares
# an implementation with MuJoCo on elliptic cones has to set tolerance="0" in both.
# Seen with: mujoco 4.0.0, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0 numpy
"$folder/venv/bin/python" - <<'PROGRAM'
import mujoco
import numpy as np

LEG = """<body pos="{x} {y} 0"><joint name="hip{n}" axis="0 1 0" damping=".5" armature=".01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02" mass=".3" contype="0" conaffinity="0"/>
  <body pos="0 0 -.15"><joint name="knee{n}" axis="0 1 0" damping=".5" armature=".01"/>
    <geom size=".025" pos="0 0 -.15" mass=".2"/></body></body>"""
SERVOS = '<position joint="hip{n}" kp="40"/><position joint="knee{n}" kp="40"/>'
CORNERS = [(0.18, 0.09), (0.18, -0.09), (-0.18, 0.09), (-0.18, -0.09)]
SCENE = """<mujoco><option cone="{cone}" timestep=".004"/><worldbody>
  <geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .35"><freejoint/><geom type="box" size=".2 .1 .05" mass="5"/>{legs}</body>
</worldbody><actuator>{servos}</actuator></mujoco>"""


def largest_gap(cone):
    """Returns how far one step is from the same step with tolerance 0, over 400 steps (m/s, rad/s)."""
    legs = "".join(LEG.format(n=n, x=x, y=y) for n, (x, y) in enumerate(CORNERS))
    servos = "".join(SERVOS.format(n=n) for n in range(4))
    scene = SCENE.format(cone=cone, legs=legs, servos=servos)
    model, exact_model = (mujoco.MjModel.from_xml_string(scene) for _ in range(2))
    exact_model.opt.tolerance = 0
    data, exact_data = mujoco.MjData(model), mujoco.MjData(exact_model)
    draw = np.random.default_rng(0)
    gaps = []
    for _ in range(400):
        data.ctrl[:] = 0.5 * draw.normal(size=model.nu)
        for field in ("qpos", "qvel", "qacc_warmstart", "ctrl"):
            getattr(exact_data, field)[:] = getattr(data, field)
        mujoco.mj_step(model, data)
        mujoco.mj_step(exact_model, exact_data)
        gaps.append(np.abs(data.qvel - exact_data.qvel).max())
    return max(gaps)


elliptic, pyramidal = largest_gap("elliptic"), largest_gap("pyramidal")
print(f"mujoco {mujoco.__version__}: elliptic {elliptic:.1e}, pyramidal {pyramidal:.1e} m/s or rad/s")
assert elliptic > 1e-6
assert pyramidal < 1e-9
PROGRAM

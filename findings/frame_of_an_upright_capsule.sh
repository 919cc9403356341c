#!/usr/bin/env bash
# MuJoCo 4.0.0: a capsule that stands exactly along the normal of a tilted plane gets contact frames
# that are no frames. The first row of mjContact.frame is the plane's normal, the second is the
# world's x axis, which is not orthogonal to it, and the third is not of length one. "Friction"
# along the second row then has a part along the normal. One degree away from upright, the frame is
# orthonormal. Seen with: mujoco 4.0.0, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0 numpy
"$folder/venv/bin/python" - <<'PROGRAM'
import mujoco
import numpy as np

SCENE = """<mujoco><worldbody>
  <geom type="plane" size="5 5 1" euler="30 20 0"/>
  <body euler="30 20 0"><freejoint/><geom type="capsule" size=".1 .2" euler="{lean} 0 0"/></body>
</worldbody></mujoco>"""


def worst(lean):
    """Returns how far the frames of the contacts are from orthonormal."""
    model = mujoco.MjModel.from_xml_string(SCENE.format(lean=lean))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon
    frames = [contact.frame.reshape(3, 3) for contact in data.contact[: data.ncon]]
    return max(np.abs(frame @ frame.T - np.eye(3)).max() for frame in frames)


upright, leaning = worst(0), worst(1)
print(f"mujoco {mujoco.__version__}: upright {upright:.3f} from orthonormal, leaning {leaning:.1e}")
assert upright > 0.3
assert leaning < 1e-12
PROGRAM

#!/usr/bin/env bash
# mujoco-mjx 3.17.0 on mujoco 4.0.0: <custom><numeric name="max_contact_points"/> is free data of the
# user's to C MuJoCo. MJX reads it as a limit, and keeps only the deepest contacts, without a word.
# Two equal balls that lie on a plane, number 1: C holds both, in MJX one sinks. Many models that
# packages ship carry this element. Seen with: jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0 mujoco-mjx==3.17.0 jax==0.10.2 jaxlib==0.10.2
JAX_PLATFORMS=cpu "$folder/venv/bin/python" - <<'PROGRAM'
import jax
import mujoco
from mujoco import mjx

SCENE = """<mujoco>{custom}<worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 .099"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>
  <body pos="1 0 .098"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>
</worldbody></mujoco>"""
LIMIT = '<custom><numeric name="max_contact_points" data="1"/></custom>'


def speeds(custom):
    """Returns the speeds of the two balls after one step, by C and by MJX."""
    model = mujoco.MjModel.from_xml_string(SCENE.format(custom=custom))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    in_mjx = jax.jit(mjx.step)(mjx.put_model(model), mjx.make_data(model))
    return data.qvel.copy(), jax.device_get(in_mjx.qvel)


plain_c, plain_mjx = speeds("")
limited_c, limited_mjx = speeds(LIMIT)
print("without:", plain_c, plain_mjx)
print("with:   ", limited_c, limited_mjx)
assert (plain_c == limited_c).all()
assert abs(plain_c - plain_mjx).max() < 1e-4
assert abs(limited_c - limited_mjx).max() > 1e-2
PROGRAM

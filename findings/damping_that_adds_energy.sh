#!/usr/bin/env bash
# playground 0.2.0: the dampers of the Humanoid's joints make it move faster. Its file turns off the
# implicit damping of MuJoCo's Euler integrator (eulerdamp) and keeps dm_control's timestep of 5 ms and
# damping of up to 5 N m s. Explicit damping adds energy where an eigenvalue of timestep * M^-1 * damping
# is above 2. Upright, the largest is 1.1; within the limits of the joints it reaches 2.08. There, in C
# MuJoCo without contacts, gravity, springs, limits of joints, and actions, ten steps multiply a small
# motion's kinetic energy by 4.8; with eulerdamp, as in dm_control, they leave less than a millionth of it.
# Seen with: mujoco and mujoco-mjx 3.17.0, jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet playground==0.2.0 mujoco==3.17.0 mujoco-mjx==3.17.0 \
  jax==0.10.2 jaxlib==0.10.2
JAX_PLATFORMS=cpu MUJOCO_GL=disable "$folder/venv/bin/python" - <<'PROGRAM'
import mujoco
import numpy as np
from mujoco_playground import registry

NO = mujoco.mjtDisableBit
STEPS = 10

model = registry.load("HumanoidWalk", config_overrides={"impl": "jax"}).mj_model
assert model.opt.disableflags & NO.mjDSBL_EULERDAMP
assert model.opt.timestep == 0.005
joints = np.flatnonzero(model.jnt_limited)
low, high = model.jnt_range[joints].T


def posed(angles):
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[joints]] = angles
    mujoco.mj_forward(model, data)
    return data


def inertia(data):
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    return matrix


def fastest_damping(angles):
    """Returns the largest eigenvalue, and velocities along its eigenvector."""
    root = np.sqrt(model.dof_damping)
    inverse = np.linalg.inv(inertia(posed(angles)))
    values, vectors = np.linalg.eigh(model.opt.timestep * root[:, None] * inverse * root)
    return values[-1], inverse @ (root * vectors[:, -1])


# From the upright pose, climb to poses whose largest eigenvalue is larger.
random = np.random.default_rng(0)
angles = np.clip(np.zeros(len(joints)), low, high)
upright = eigenvalue = fastest_damping(angles)[0]
for _ in range(3000):
    change = random.normal(0, 0.3, len(joints)) * (high - low) * (random.random(len(joints)) < 0.3)
    trial = np.clip(angles + change, low, high)
    if fastest_damping(trial)[0] > eigenvalue:
        eigenvalue, angles = fastest_damping(trial)[0], trial
print(f"largest eigenvalue: upright {upright:.2f}, in the pose that was found {eigenvalue:.2f}")
assert upright < 2 < eigenvalue

alone = NO.mjDSBL_CONTACT | NO.mjDSBL_GRAVITY | NO.mjDSBL_SPRING | NO.mjDSBL_LIMIT
ratios = {}
for name, flags in (("eulerdamp off, as in the file", NO.mjDSBL_EULERDAMP), ("eulerdamp on", 0)):
    model.opt.disableflags = flags | alone
    data = posed(angles)
    velocity = fastest_damping(angles)[1]
    data.qvel[:] = 0.01 * velocity / np.abs(velocity).max()
    energies = []
    for _ in range(STEPS + 1):
        energies.append(data.qvel @ inertia(data) @ data.qvel / 2)
        mujoco.mj_step(model, data)
    ratios[name] = energies[-1] / energies[0]
    print(f"{name}: {STEPS} steps multiply the kinetic energy by {ratios[name]:.2g}")
off, on = ratios.values()
assert off > 4
assert on < 1e-6
PROGRAM

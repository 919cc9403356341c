#!/usr/bin/env bash
# playground 0.2.0: with the solver's four iterations of its file, implicit damping makes the Humanoid
# break. The file also turns implicit damping off in MuJoCo's Euler integrator (eulerdamp). With it
# on, C MuJoCo warns of a bad or huge state in several of 20 episodes of random actions (5 where we
# ran it) within 400 env steps, and with two iterations in all 20. With explicit damping, as in the
# file, it warns in none, even with two iterations; nor with implicit damping and 100 iterations. So
# a number of iterations that was chosen with one kind of damping does not carry over to the other.
# Seen with: mujoco and mujoco-mjx 3.17.0, jax 0.10.2, Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet playground==0.2.0 mujoco==3.17.0 mujoco-mjx==3.17.0 \
  jax==0.10.2 jaxlib==0.10.2
cd "$folder" # where MuJoCo writes its log of warnings
JAX_PLATFORMS=cpu MUJOCO_GL=disable "$folder/venv/bin/python" - <<'PROGRAM'
import mujoco
import numpy as np
from mujoco_playground import registry

EPISODES, ENV_STEPS, HELD_FOR = 20, 400, 5
EXPLICIT, IMPLICIT = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP), 0
WARNINGS = [getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}") for name in ("QPOS", "QVEL", "QACC")]

task = registry.load("HumanoidWalk", config_overrides={"impl": "jax"})
model = task.mj_model
assert model.opt.iterations == 4
assert model.opt.disableflags == EXPLICIT


def is_broken(random):
    """Plays actions of -1 and 1, each for five env steps."""
    data = mujoco.MjData(model)
    for step in range(ENV_STEPS):
        if step % HELD_FOR == 0:
            data.ctrl[:] = random.choice([-1.0, 1.0], model.nu)
        mujoco.mj_step(model, data, task.n_substeps)
        if any(data.warning[kind].number for kind in WARNINGS):
            return True
    return False


def num_broken(flags, iterations):
    model.opt.disableflags = flags
    model.opt.iterations = iterations
    random = np.random.default_rng(0)
    count = sum(is_broken(random) for _ in range(EPISODES))
    damping = "explicit" if flags == EXPLICIT else "implicit"
    print(f"{damping} damping, {iterations} iterations: {count} of {EPISODES} episodes broken")
    return count


assert num_broken(EXPLICIT, 4) == 0
assert num_broken(EXPLICIT, 2) == 0
assert num_broken(IMPLICIT, 4) > 1
assert num_broken(IMPLICIT, 2) == EPISODES
assert num_broken(IMPLICIT, 100) == 0
PROGRAM

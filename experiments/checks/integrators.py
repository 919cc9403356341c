"""How far an env step of Gymnasium's tasks differs between two versions of MuJoCo.

    python experiments/checks/integrators.py write old.npz     # where mujoco==3.17.0 is installed
    python experiments/checks/integrators.py write new.npz     # where mujoco==4.0.0 is installed
    python experiments/checks/integrators.py compare old.npz new.npz

It needs Gymnasium with its extra ``mujoco``, and nothing of this package. Each task takes one
random action from each of 32 starts, with the same seeds. ``compare`` prints the largest difference
of a position or velocity, and the median over starts of each start's largest difference.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

TASKS = ("Ant", "Humanoid", "HumanoidStandup", "HalfCheetah", "Hopper", "Walker2d", "Swimmer")
TASKS += ("Reacher", "Pusher", "InvertedPendulum", "InvertedDoublePendulum")
STARTS = 32


def states_after_a_step(task: str) -> np.ndarray:
    """Returns positions and velocities [STARTS, nq + nv] after an env step from each start."""
    env = gymnasium.make(f"{task}-v5")
    states = []
    for seed in range(STARTS):
        env.reset(seed=seed)
        env.action_space.seed(seed)
        env.step(env.action_space.sample())
        simulation: Any = env.unwrapped
        data = simulation.data
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


def main() -> None:
    """Writes the states of this version, or compares those of two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stage", choices=("write", "compare"))
    parser.add_argument("files", type=Path, nargs="+", help="one to write, two to compare")
    arguments = parser.parse_args()
    if len(arguments.files) != {"write": 1, "compare": 2}[arguments.stage]:
        parser.error(f"{arguments.stage} takes another number of files; see --help")
    if arguments.stage == "write":
        states = {task: states_after_a_step(task) for task in TASKS}
        np.savez(arguments.files[0], allow_pickle=False, **states)
        return
    old, new = map(np.load, arguments.files)
    for task in TASKS:
        largest = np.abs(old[task] - new[task]).max(axis=1)
        print(f"{task}-v5: at most {largest.max():.0e}, median {np.median(largest):.0e}")


if __name__ == "__main__":
    main()

"""CleanRL's ``ppo_continuous_action.py``, of which one statement is changed: where it makes envs.

The file is not part of this repository: download it from github.com/vwxyzjn/cleanrl. Its statement

    envs = gym.vector.SyncVectorEnv([make_env(...) for i in range(args.num_envs)])

becomes ``envs = make_envs(args.env_id, args.num_envs, args.gamma)``, for both sides: its own
``make_env`` fails with Gymnasium 1.0 and newer, whose ``TransformObservation`` takes one argument
more.
"""

import ast
import os
import runpy
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from gymnasium.wrappers import vector as wrappers

from experiments.kit.rows import words
from experiments.speed.trainers.sides import Trained, vector_env

#: The statement that takes the place of CleanRL's.
LINE = "envs = make_envs(args.env_id, args.num_envs, args.gamma)"


def train(
    side: str, task: str, num_envs: int, seed: int, env_steps: int, *, rollout: int, program: Path
) -> Trained:
    """Runs the program with its default settings, whose rollout is split over the environments.

    Args:
      side: a key of ``SIDES``.
      task: an id of Gymnasium.
      num_envs: N.
      seed: of all that is random.
      env_steps: of the training; the program plays whole rollouts alone, of 2,048 by default.
      rollout: env steps between updates, of all environments together.
      program: CleanRL's file.

    Raises:
      ValueError: the file has no statement that makes environments, or several.
    """
    torch.set_num_threads(1)
    env, start_seconds = vector_env(side, task, num_envs)
    began = cpu = 0.0
    recorded = wrappers.RecordEpisodeStatistics(env)

    def make_envs(env_id: str, num_envs: int, gamma: float) -> Any:
        nonlocal began, cpu
        began, cpu = time.perf_counter(), time.process_time()
        return wrapped(recorded, gamma)

    settings = {"env-id": task, "num-envs": num_envs, "num-steps": rollout // num_envs}
    given = settings | {"seed": seed, "total-timesteps": env_steps}
    arguments = [f"--{name}={value}" for name, value in given.items()]
    with tempfile.TemporaryDirectory() as folder, _told(folder, [*arguments, "--no-cuda"]):
        path = Path(folder) / program.name
        path.write_text(changed(program.read_text(encoding="utf-8")), encoding="utf-8")
        found = runpy.run_path(str(path), {"make_envs": make_envs}, "__main__")
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    returns = [float(x) for x in recorded.return_queue]
    told = words(settings)
    return Trained(returns, start_seconds, seconds, cpu, found["global_step"], told)


def changed(text: str) -> str:
    """Returns the program with ``LINE`` in place of the statement that makes environments.

    Raises:
      ValueError: there is none, or there are several.
    """
    found = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "envs"
    ]
    if len(found) != 1:
        raise ValueError(f"the program makes environments in {len(found)} places; expected one")
    (node,) = found
    lines = text.splitlines()
    lines[node.lineno - 1 : node.end_lineno] = [" " * node.col_offset + LINE]
    return "\n".join(lines) + "\n"


def wrapped(env: Any, gamma: float) -> Any:
    """Returns a vector environment under the wrappers that CleanRL puts around each single one."""
    env = wrappers.NormalizeObservation(wrappers.ClipAction(env))
    env = wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10))
    env = wrappers.NormalizeReward(env, gamma=gamma)
    return wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))


@contextmanager
def _told(folder: str, arguments: list[str]) -> Iterator[None]:
    """Has a program read these arguments, and write its logs into a folder."""
    before, there = sys.argv, os.getcwd()
    sys.argv = ["ppo_continuous_action.py", *arguments]
    os.chdir(folder)
    try:
        yield
    finally:
        sys.argv = before
        os.chdir(there)

"""Both sides of the comparison, our environments and Gymnasium's, and what a training did."""

import dataclasses
import time
from typing import Any

import gymnasium
import numpy as np

import mjx_reinforce.gym  # noqa: F401 (tells Gymnasium our tasks)

#: Whose environments, and the prefix of their ids in Gymnasium.
SIDES = {"gymnasium": "", "mjx_reinforce": "mjx_reinforce/"}
#: So many of the last episodes of a training are its return.
LAST = 20


@dataclasses.dataclass(frozen=True)
class Trained:
    """What a training did.

    returns: [E] of all its episodes, or of the last ones, in the order in which they ended
    start_seconds: until the environments had been made, compiled and stepped once (s)
    seconds: of the training itself, updates included (s)
    cpu_seconds: that all its threads were computing in it, which others on the machine slow less
    env_steps: how many were played
    settings: what the program was told, as text
    """

    returns: list[float]
    start_seconds: float
    seconds: float
    cpu_seconds: float
    env_steps: int
    settings: str

    @property
    def mean_return(self) -> float:
        """The mean of the last episodes; NaN where none has ended."""
        return float(np.mean(self.returns[-LAST:])) if self.returns else float("nan")


def vector_env(side: str, task: str, num_envs: int) -> tuple[Any, float]:
    """Returns Gymnasium's vector environment of a task, ready to train on, and how long it took.

    Args:
      side: a key of ``SIDES``.
      task: an id of Gymnasium, such as "Hopper-v5".
      num_envs: N.
    """
    began = time.perf_counter()
    env = gymnasium.make_vec(SIDES[side] + task, num_envs=num_envs)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    return env, time.perf_counter() - began

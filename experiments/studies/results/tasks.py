"""What the results are of: every task, its seeds and budget, and the figure to hold against it."""

import dataclasses
from typing import Any, NamedTuple

from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import HORIZONS, of_task

#: Roots of all randomness of the results. No tuning used them. The second and the third are of
#: tasks whose settings were chosen again after a run with the first.
ROOT, SECOND_ROOT, THIRD_ROOT = 923917982, 456536658, 612381924
#: The seeds of a published figure.
PUBLISHED_SEEDS = 10
#: A run is evaluated about so often, more where episodes end before their limit.
_EVALUATIONS = 40


class Task(NamedTuple):
    """One row of the results.

    name: of its files: the environment's id, and what else is not the default
    seeds: how many are trained
    env_steps: budget of each
    published: mean and standard deviation over ``PUBLISHED_SEEDS`` seeds, if there is a figure
    root: of its seeds
    settings: what differs from the task's default settings
    """

    name: str
    seeds: int
    env_steps: int
    published: tuple[float, float] | None
    root: int = ROOT
    settings: dict[str, Any] = {}  # noqa: RUF012 - nobody changes it

    @property
    def env(self) -> str:
        """The environment's id."""
        return self.name.removesuffix("-32-32")


_OFTEN = {"eval_every": 2}
_PENDULUM = (4096, 1_000_000, (1000.0, 0.0), THIRD_ROOT)
#: Published: REINFORCE of Tianshou after 10 million env steps, examples/mujoco/README.md there.
TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task("InvertedPendulum-v5", *_PENDULUM, _OFTEN),
        Task("InvertedPendulum-v5-32-32", *_PENDULUM, _OFTEN | {"hidden_sizes": (32, 32)}),
        Task("InvertedDoublePendulum-v5", 64, 3_000_000, (7726.2, 1287.3), THIRD_ROOT),
        Task("Reacher-v5", 64, 3_000_000, (-5.5, 0.2)),
        Task("Pusher-v5", 16, 1_000_000, None),
        Task("Swimmer-v5", 64, 2_000_000, (35.6, 2.6)),
        Task("HalfCheetah-v5", 64, 2_000_000, (1138.8, 104.7)),
        Task("Hopper-v5", 64, 1_500_000, (416.0, 104.7)),
        Task("Walker2d-v5", 64, 800_000, (440.9, 148.2), SECOND_ROOT),
        Task("Ant-v5", 16, 2_000_000, (1108.1, 323.1), SECOND_ROOT),
        Task("Humanoid-v5", 16, 1_000_000, (464.3, 58.4), SECOND_ROOT),
        Task("HumanoidStandup-v5", 16, 200_000, None),
    )
}


def settings_of(task: Task) -> Config:
    """Returns the settings of a task's runs: its defaults, except these and ``eval_every``."""
    config = of_task(task.env, task.env_steps, task.seeds)
    config = dataclasses.replace(config, seed=task.root, **task.settings)
    if "eval_every" in task.settings:
        return config
    horizon = config.horizon or HORIZONS[task.env]
    updates = -(-task.env_steps // (config.episodes_per_update * horizon))
    return dataclasses.replace(config, eval_every=max(config.eval_every, updates // _EVALUATIONS))

"""What the tasks were measured to take; ``measured.toml`` has it, and says how."""

from typing import NamedTuple

from mjx_reinforce.settings.config import read_tables


class Task(NamedTuple):
    """The sizes of a task, and what its runs are like.

    observation: O, entries of an observation
    action: A, entries of an action
    horizon: the task's time limit (env steps)
    useful: the part of the simulated env steps that belongs to an episode that still runs
    base_memory: what a small run takes on a CPU, mostly for compiling (bytes)
    """

    observation: int
    action: int
    horizon: int
    useful: float
    base_memory: float


class Speed(NamedTuple):
    """How fast an engine plays and trains on a task.

    engine: its name
    compiling: from nothing, until the first update (s)
    latency: one env step of however few episodes (s)
    rate: env steps a second of however many
    """

    engine: str
    compiling: float
    latency: float
    rate: float

    def seconds(self, steps: float, episodes: int) -> float:
        """Returns how long ``steps`` env steps take, ``episodes`` at a time (s)."""
        return steps / episodes * (self.latency + episodes / self.rate)


_TABLES = read_tables("measured.toml")
#: Environment id -> its sizes, and its speed on two CPU cores, and on one GPU.
TASKS = {name: Task(**table["sizes"]) for name, table in _TABLES.items()}
CPU = {name: Speed(**table["cpu"]) for name, table in _TABLES.items()}
GPU = {name: Speed(**table["gpu"]) for name, table in _TABLES.items()}
#: Floating-point operations a second of networks that learn: on two CPU cores, and on one H200.
CPU_OPERATIONS, GPU_OPERATIONS = 6e10, 5e12

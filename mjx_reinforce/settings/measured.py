"""What the tasks were measured to take, so that a run can say beforehand how long it needs.

Runs of ``train`` with four seeds of 16 episodes an update and a 32-32 policy, training and
evaluating, on 2026-11-22, and of InvertedPendulum on a CPU with its default settings, of 4 episodes
and a linear policy, on 2026-11-23; all figures are good to a factor of two.

- CPU: two cores of a shared machine on which nothing else ran, on 2026-11-24, a quarter of a
  minute of each task; the Humanoids' rates are those of rollouts, halved. The operations of larger
  networks and of value networks are from ContinuousCartPole, InvertedPendulum and Swimmer on that
  day, by the time of the processor: 3e10 to 6e10 a second and core.
- GPU: an H100, on 2026-11-24, from runs of 16 seeds with 1,024 episodes (Swimmer: 128, the double
  pendulum: 16) an update, and of 8 seeds of Ant; how an update's time divides into what every
  update takes and what each episode adds was guessed, except for the pendulums and carts, which an
  H200 ran before. The Humanoids' rates are those of rollouts on an H200. Compiling depends on the
  host: while many other programs run it takes up to four times as long. The operations of networks
  were not measured: they are taken to be a tenth of what the card can do.
"""

from typing import NamedTuple


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


TASKS = {
    "InvertedPendulum-v5": Task(4, 1, 1000, 0.9, 1.0e9),
    "InvertedPendulum-v4": Task(4, 1, 1000, 0.9, 1.0e9),
    "InvertedDoublePendulum-v5": Task(9, 1, 1000, 0.3, 1.8e9),
    "Reacher-v5": Task(10, 2, 50, 1.0, 2.0e9),
    "Pusher-v5": Task(23, 7, 100, 1.0, 3.3e9),
    "Swimmer-v5": Task(8, 2, 1000, 1.0, 2.6e9),
    "HalfCheetah-v5": Task(17, 6, 1000, 1.0, 2.6e9),
    "Hopper-v5": Task(11, 3, 1000, 0.3, 2.8e9),
    "Walker2d-v5": Task(17, 6, 1000, 0.3, 2.5e9),
    "Ant-v5": Task(105, 8, 1000, 0.8, 2.9e9),
    "Humanoid-v5": Task(348, 17, 1000, 0.35, 4.0e9),
    "HumanoidStandup-v5": Task(348, 17, 1000, 1.0, 3.9e9),
    "CartPole-v1": Task(4, 1, 500, 0.8, 1.3e9),
    "CartPole-v0": Task(4, 1, 200, 0.8, 1.3e9),
    "ContinuousCartPole-v0": Task(4, 1, 50, 1.0, 1.4e9),
}

_PENDULUM_CPU = Speed("native", 8, 1.5e-6, 8e6)
_PENDULUM_GPU = Speed("native", 12, 2.2e-5, 1.2e9)
_CART_CPU = Speed("native", 9, 2e-5, 4e6)
_CART_GPU = Speed("native", 12, 2.1e-5, 1e9)

#: Floating-point operations a second of networks that learn: on two CPU cores, and on one H200.
CPU_OPERATIONS, GPU_OPERATIONS = 6e10, 5e12

#: On two CPU cores.
CPU = {
    "InvertedPendulum-v5": _PENDULUM_CPU,
    "InvertedPendulum-v4": _PENDULUM_CPU,
    "InvertedDoublePendulum-v5": Speed("native", 18, 2e-5, 1.2e6),
    "Reacher-v5": Speed("native", 14, 0, 2e6),
    "Pusher-v5": Speed("native", 19, 0, 2.9e5),
    "Swimmer-v5": Speed("native", 10, 0, 1.5e6),
    "HalfCheetah-v5": Speed("native", 14, 0, 8e5),
    "Hopper-v5": Speed("native", 13, 0, 5e5),
    "Walker2d-v5": Speed("native", 15, 0, 2.6e5),
    "Ant-v5": Speed("native", 21, 0, 8.5e4),
    "Humanoid-v5": Speed("native", 48, 0, 1.1e4),
    "HumanoidStandup-v5": Speed("native", 48, 0, 5.6e3),
    "CartPole-v1": _CART_CPU,
    "CartPole-v0": _CART_CPU,
    "ContinuousCartPole-v0": _CART_CPU,
}

#: On one GPU.
GPU = {
    "InvertedPendulum-v5": _PENDULUM_GPU,
    "InvertedPendulum-v4": _PENDULUM_GPU,
    "InvertedDoublePendulum-v5": Speed("native", 14, 4.5e-5, 1e9),
    "Reacher-v5": Speed("native", 14, 3e-5, 6e8),
    "Pusher-v5": Speed("native", 25, 1e-3, 1.8e7),
    "Swimmer-v5": Speed("native", 13, 3e-5, 6e8),
    "HalfCheetah-v5": Speed("native", 22, 1.1e-4, 2e8),
    "Hopper-v5": Speed("native", 21, 1.2e-4, 1.7e8),
    "Walker2d-v5": Speed("native", 20, 2.3e-4, 5.6e7),
    "Ant-v5": Speed("native", 40, 2e-3, 4.1e6),
    "Humanoid-v5": Speed("native", 130, 1e-2, 8e5),
    "HumanoidStandup-v5": Speed("native", 130, 1.1e-2, 7e5),
    "CartPole-v1": _CART_GPU,
    "CartPole-v0": _CART_GPU,
    "ContinuousCartPole-v0": _CART_GPU,
}

"""States and actions from which `experiments.checks.parity` takes a step."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from experiments.checks.parity.sides import Peer
from mjx_reinforce.engine.base import Discrete


def draw_states(
    peer: Peer, space: Any, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws states and actions: reached by random actions, and every other one pushed.

    Args:
      peer: where they are reached.
      space: the actions, our Box or Discrete.
      count: N.
      seed: of everything.

    Returns:
      qpos [N, nq], qvel [N, nv] and actions [N, A], or [N] if discrete.
    """
    random = np.random.default_rng(seed)
    reached = _reached(peer, space, random)
    qpos, qvel = map(np.array, zip(*(next(reached) for _ in range(count)), strict=True))
    for i in range(0, count, 2):
        qpos[i], qvel[i] = _pushed(qpos[i], qvel[i], peer.limits, random)
    action = np.array([random_action(space, random) for _ in range(count)])
    return qpos, qvel, action


def random_action(space: Any, random: np.random.Generator) -> np.ndarray:
    """Draws an action, of a Box up to 20% beyond its bounds."""
    if isinstance(space, Discrete):
        return random.integers(space.num_actions)  # type: ignore
    return random.uniform(1.2 * space.low, 1.2 * space.high)


def _reached(
    peer: Peer, space: Any, random: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields one state in four on the way of episodes of up to 80 steps."""
    while True:
        state = peer.reset(int(random.integers(2**31)))
        for _ in range(random.integers(1, 81)):
            if random.uniform() < 0.25:
                yield state.qpos, state.qvel
            if state.terminated:
                break
            state = peer.step(random_action(space, random))


def _pushed(
    qpos: np.ndarray, qvel: np.ndarray, limits: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Moves a state a little or a lot, some of its joints to their limits, and makes it faster.

    A quaternion may lose its length here; MuJoCo and MJX both normalize it.
    """
    size = 10 ** random.uniform(-3, -0.5)
    qpos = qpos + size * random.uniform(-1, 1, qpos.shape)
    low, high = limits.T
    near = np.where(random.uniform(size=qpos.shape) < 0.5, low, high)
    near = near + 0.02 * (high - low) * random.standard_normal(qpos.shape)
    chosen = (random.uniform(size=qpos.shape) < 0.2) & np.isfinite(near)
    qvel = random.uniform(0, 2) * qvel + 10 * size * random.uniform(-1, 1, qvel.shape)
    return np.where(chosen, near, qpos), qvel

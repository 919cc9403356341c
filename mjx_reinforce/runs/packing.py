"""Which runs are moved side by side, and their states on the way there and back; all on the host.

A compiled program moves a fixed number of runs at once, a slot, and takes about as long as the
longest episode in it, whether the others still train or not. So before each block of updates the
runs that still train are sorted by the length of their episodes and packed into slots anew. Runs
whose budget is used lie aside. The packing follows from what a checkpoint holds, so that a resumed
run packs as it would have.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mjx_reinforce.runs.config import MAX_COUNT
from mjx_reinforce.runs.state import Budget, RunState

Arrays = dict[str, np.ndarray]


def training(states: RunState, budget: Budget) -> np.ndarray:
    """Returns which runs [R] have not used their budget."""
    used = np.asarray(states.env_steps) >= np.asarray(budget.env_steps)
    return ~(used | (np.asarray(states.train_states.num_updates) >= np.asarray(budget.updates)))


def pack(
    chosen: np.ndarray, lengths: np.ndarray, widths: Sequence[int], num_devices: int
) -> np.ndarray:
    """Returns the runs of each slot.

    Args:
      chosen: [R] which runs are packed.
      lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      widths: that slots may have, multiples of the number of devices. The narrowest that holds all
        is taken, or as many of the widest as are needed.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [slots, width], the number of the run in each lane, -1 where there is none.
    """
    runs = np.flatnonzero(chosen)
    runs = runs[np.argsort(lengths[runs], kind="stable")]
    width = min((w for w in widths if w >= len(runs)), default=max(widths))
    lanes = np.full((-(-len(runs) // width), width), -1)
    lanes.flat[: len(runs)] = runs
    dealt = lanes.reshape(len(lanes), width // num_devices, num_devices)
    return dealt.swapaxes(1, 2).reshape(lanes.shape)


def take(states: RunState, lanes: np.ndarray) -> RunState:
    """Returns the states of the runs of a slot; in a lane without one, a run that has no budget."""
    slot = jax.tree.map(lambda x: x[lanes], states)
    return dataclasses.replace(slot, env_steps=np.where(lanes < 0, MAX_COUNT, slot.env_steps))


def put_back(states: RunState, lanes: np.ndarray, slots: Sequence[RunState]) -> RunState:
    """Returns the states of all runs, those in ``lanes`` from their slots."""
    runs, places = _matched(lanes)

    def replace(old: np.ndarray, *new: np.ndarray) -> np.ndarray:
        replaced = old.copy()
        replaced[runs] = np.concatenate(new)[places]
        return replaced

    return jax.tree.map(replace, states, *slots)


def spread(num_runs: int, lanes: np.ndarray, slots: Sequence[Arrays]) -> Arrays:
    """Returns measurements [..., R] of all runs, zero for those in no slot, from [..., W] each."""
    runs, places = _matched(lanes)

    def of_all(name: str) -> np.ndarray:
        measured = np.concatenate([slot[name] for slot in slots], axis=-1)
        every = np.zeros((*measured.shape[:-1], num_runs), measured.dtype)
        every[..., runs] = measured[..., places]
        return every

    return {name: of_all(name) for name in slots[0]}


def _matched(lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the runs in lanes [slots, width], and the place of each, counted through all."""
    places = np.flatnonzero(lanes >= 0)
    return lanes.flat[places], places


def join(slots: Sequence[Any], count: int) -> Any:
    """Returns the states of the first ``count`` runs of slots side by side."""
    return jax.tree.map(lambda *xs: np.concatenate(xs)[:count], *slots)

"""Which runs are moved side by side.

A compiled program moves a fixed number of runs at once, a slot, and takes about as long as the
longest episode in it, whether the others still train or not. So before a block of updates the
runs that still train are sorted by the length of their episodes and packed into slots anew. Runs
whose budget is used lie aside. The packing follows from what a checkpoint holds, so that a resumed
run packs as it would have.
"""

from collections.abc import Sequence

import numpy as np


def pack(
    chosen: np.ndarray, lengths: np.ndarray, widths: Sequence[int], num_devices: int
) -> list[np.ndarray]:
    """Returns the runs of each slot.

    Args:
      chosen: [R] which runs are packed, at least one.
      lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      widths: that slots may have, multiples of the number of devices, the most first. Each is
        filled as often as it can be; what is left goes there too if it fills more than half.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [width] of each slot, the number of the run in each lane, -1 where there is none.
    """
    runs = np.flatnonzero(chosen)
    runs = runs[np.argsort(lengths[runs], kind="stable")]
    slots = []
    for width in widths:
        narrowest = width == widths[-1]
        while len(runs) > (0 if narrowest else width // 2):
            slots.append(_deal(runs[:width], width, num_devices))
            runs = runs[width:]
    return slots


def _deal(runs: np.ndarray, width: int, num_devices: int) -> np.ndarray:
    """Returns the lanes of a slot, dealt one by one to the devices, each of which has a part."""
    lanes = np.full(width, -1)
    lanes[: len(runs)] = runs
    return lanes.reshape(-1, num_devices).T.reshape(-1)

"""Which runs are moved side by side.

A compiled program moves a fixed number of runs at once, a slot, and takes about as long as the
longest episode in it, whether the others still train or not. So before a block of updates the
runs that still train are sorted by the length of their episodes and packed into slots again. Runs
whose budget is used lie aside. The packing follows from what a checkpoint holds, so that a resumed
run packs as it would have.
"""

from collections.abc import Sequence

import numpy as np


def pack_slots(
    chosen: np.ndarray, lengths: np.ndarray, widths: Sequence[int], num_devices: int
) -> np.ndarray:
    """Returns the runs of each slot.

    Args:
      chosen: [R] which runs are packed, at least one.
      lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      widths: that slots may have, multiples of the number of devices, the most first. The first of
        which these runs fill more than a quarter of a slot is taken, or else the last: on an H200
        the wider slot takes as long as two of an eighth of its width.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [slots, width], the number of the run in each lane, -1 where there is none.
    """
    runs = np.flatnonzero(chosen)
    runs = runs[np.argsort(lengths[runs], kind="stable")]
    width = next((width for width in widths if len(runs) > width // 4), widths[-1])
    lanes = np.full((-(-len(runs) // width), width), -1)
    lanes.flat[: len(runs)] = runs
    dealt = lanes.reshape(len(lanes), width // num_devices, num_devices)
    return dealt.swapaxes(1, 2).reshape(lanes.shape)

"""Updates that met numbers which are not finite: how many, of which seeds, and when to give up."""

import numpy as np

from mjx_reinforce.files import Arrays

#: Why a run that is ``hopeless`` is stopped.
HOPELESS = (
    "every seed that still trained was broken throughout the last updates, its episodes "
    "or its new policy not finite; lower --learning-rate (ars: --step-size) or mend the task"
)
#: A run is not given up before each of its seeds was broken so many updates in a row: blocks may
#: be shorter, and a seed may recover from one such update, since the next draws other numbers.
MIN_BROKEN = 5
#: A message names so many seeds.
_MAX_NAMED = 5


def nonfinite_updates(metrics: Arrays) -> np.ndarray:
    """Returns how many updates of a block met numbers which are not finite, of each seed [S].

    Args:
      metrics: [K, S] each, as in ``record.Measured``.
    """
    is_broken = (metrics["nonfinite_episodes"] > 0) | (metrics["skipped_update"] > 0)
    return (is_broken & metrics["active"]).sum(axis=0)


def broken_in_a_row(old_count: np.ndarray, metrics: Arrays) -> np.ndarray:
    """Returns how many of its latest updates each seed was broken in, without one between.

    An update is broken if all its episodes left the finite numbers, or if it was skipped.

    Args:
      old_count: [S] the same before this block.
      metrics: [K, S] each, as in ``record.Measured``.
    """
    is_broken = metrics["nonfinite_episodes"] >= metrics["episodes"]
    is_broken |= metrics["skipped_update"] > 0
    num_broken = old_count
    # One row [S] an update. A seed that stands still keeps its count: it was not tried.
    for active_row, is_broken_row in zip(metrics["active"], is_broken, strict=True):
        num_broken = np.where(active_row, np.where(is_broken_row, num_broken + 1, 0), num_broken)
    return num_broken


def describe_nonfinite(num_nonfinite: np.ndarray, first_seed: int, updates: int) -> str:
    """Returns a line about the first ``nonfinite_updates`` of a run, of which some are not 0.

    Args:
      num_nonfinite: [S] how many of a block, of each seed.
      first_seed: the number of the first seed.
      updates: how many there were after the block.
    """
    seeds = (first_seed + np.flatnonzero(num_nonfinite)).tolist()
    seed_list = ", ".join(map(str, seeds[:_MAX_NAMED]))
    if len(seeds) > _MAX_NAMED:
        seed_list += ", ..."
    noun = "number" if len(seeds) == 1 else "numbers"
    return (
        f"up to update {updates}, {len(seeds):,} of {len(num_nonfinite):,} seeds ({noun} "
        f"{seed_list}) met values that are not finite or beyond 1e10. Such an episode counts as "
        "the worst of its update. This line comes once; the number of such updates comes at the "
        "end. If they are many, give the model a smaller timestep or more armature, or lower "
        "--learning-rate"
    )

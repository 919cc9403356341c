"""Do our seeds agree with a program's own?"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from experiments.studies.reproduce.cases import Case
from mjx_reinforce.settings.defaults import PRESETS

LEVEL = 0.05  # of the tests; the range over seeds holds 95% too


def windowed(scores: np.ndarray, count: int, window: int) -> np.ndarray:
    """Returns the mean [S] of the scores [U, S] of up to ``window`` updates before a count."""
    return scores[max(0, count - window) : count].mean(axis=0)


def reached(entry: Mapping[str, Any], count: int) -> np.ndarray:
    """Returns the values after ``count`` updates of a program's seeds that got there."""
    index = count // entry["every_updates"] - 1
    return np.array([curve[index] for curve in entry["seeds"].values() if index < len(curve)])


def rank_test(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Returns the two-sided p value of a permutation test on mean ranks; ties share theirs."""
    ranks = stats.rankdata(np.concatenate([theirs, ours]))
    shuffled = np.random.default_rng(0).permuted(np.tile(ranks, (9999, 1)), axis=1)
    means = np.concatenate([ranks[None], shuffled])[:, : len(theirs)].mean(axis=1)
    distance = np.abs(means - ranks.mean())
    return float(np.mean(distance >= distance[0] - 1e-9))


def spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the 2.5 and 97.5% quantiles over seeds, the last axis."""
    low, high = np.quantile(values, [LEVEL / 2, 1 - LEVEL / 2], axis=-1)
    return low, high


def compare(
    case: Case, name: str, entry: Mapping[str, Any], scores: np.ndarray, preset: str = ""
) -> list[dict[str, Any]]:
    """Returns a row for every count: our seeds, the program's, and whether they agree."""
    rows = []
    for count in case.counts:
        # The record has two decimals: those that tie there are to tie here.
        ours = windowed(scores, count, entry["window_updates"]).astype(float).round(2)
        theirs = reached(entry, count)
        low, high = map(float, spread(ours))
        p_value = rank_test(ours, theirs)
        rows.append(
            {
                "document": name,
                "preset": preset or case.preset,
                "episode": count * PRESETS[case.preset][1].episodes_per_update,
                "ours_mean": float(ours.mean()),
                "ours_low": low,
                "ours_high": high,
                "theirs_mean": float(theirs.mean()),
                "theirs_n": len(theirs),
                "inside": int(np.sum((theirs >= low) & (theirs <= high))),
                "p_value": p_value,
                "agrees": p_value >= LEVEL,
            }
        )
    return rows


def compare_repair(
    case: Case, scores: np.ndarray, repaired: np.ndarray, window: int = 50
) -> list[dict[str, Any]]:
    """Returns the row that says what the repair does to our own seeds, at the last count."""
    if not case.counts or case.repair is None:
        return []
    count = case.counts[-1]
    window = 1 if case.score == "eval_return" else window
    before, after = windowed(scores, count, window), windowed(repaired, count, window)
    low, high = map(float, spread(after))
    return [
        {
            "document": case.references[0],
            "repair": case.repair[0],
            "episode": count * PRESETS[case.preset][1].episodes_per_update,
            "as_written_mean": float(before.mean()),
            "repaired_mean": float(after.mean()),
            "repaired_low": low,
            "repaired_high": high,
            "p_value": rank_test(before, after),
        }
    ]

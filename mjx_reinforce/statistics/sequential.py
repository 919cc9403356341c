"""Which configuration is best, tested again and again as seeds come in, with one error for all.

A group-sequential permutation test as AdaStop (Mathieu et al. 2024, arXiv:2306.10882), for seeds
that all configurations share. Instead of exchanging runs of two configurations, it exchanges the
two runs of a seed, which flips the sign of their difference.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: Looks at the results until the budget is spent.
_LOOKS = 8
#: Choices of signs; the first flips none.
_CHOICES = 8192
#: Pairs of configurations whose sums are in memory at once.
_PAIRS = 256
#: Sums that differ by less, relative to their size, differ by rounding.
_ROUNDING = 1e-9


class Verdict(NamedTuple):
    """Where a sequential test of C configurations stands.

    Attributes:
      contenders: the places of the configurations that no other is surely above; one, if the best
        is decided
      num_seeds: [C] seeds of each that counted; an excluded configuration needs no more
      looks: how many seeds each contender had at each look so far
      budget: how many it has at the last look
      is_over: whether no seed is needed any more: the best is decided, or the budget is spent
    """

    contenders: list[int]
    num_seeds: list[int]
    looks: list[int]
    budget: int
    is_over: bool


def look_seeds(budget: int) -> list[int]:
    """Returns at how many seeds the test looks: after each eighth of a budget, rounded up."""
    return sorted({-(-budget * look // _LOOKS) for look in range(1, _LOOKS + 1)})


def sequential_test(returns: Sequence[np.ndarray], budget: int, level: float = 0.05) -> Verdict:
    """Tests which configuration has the highest mean, at each look that has its seeds.

    At each look, all pairs of contenders are tested by the sum of their differences, seed by seed,
    over the root of the sum of their squares. Without a difference, each choice of the seeds'
    signs is equally likely. So a pair is told apart if its statistic is above the largest statistic
    of all pairs under all but a small share of 8192 random choices. These shares grow evenly from
    look to look up to ``level``. Pairs that are told apart leave the test, which is repeated for
    the others (step-down). At the end of the look, the lower ones of these pairs are excluded.

    The probability of any wrong exclusion is at most ``level`` if all choices of signs are equally
    likely. Where only the means are equal, or some of several configurations, that holds as far as
    sums over the seeds are normal; docs/statistics.md has simulations.

    Args:
      returns: [S] of each configuration, of the same seeds in the same order, as many as there are
        so far. A seed that failed counts as the worst finite return of its look.
      budget: seeds of each contender at the last look.
      level: the probability of any wrong exclusion, of all looks together.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> seeds = np.arange(64.0)
      >>> verdict = mr.sequential_test([np.sin(seeds), np.sin(seeds) + 1], budget=64)
      >>> verdict.contenders, verdict.looks
      ([1], [8, 16])
    """
    contenders = list(range(len(returns)))
    num_seeds = [0] * len(returns)
    looks: list[int] = []
    values = np.zeros((len(returns), budget))
    open_pairs = np.stack(np.triu_indices(len(returns), k=1), axis=1)
    #: Which choices of signs were above the boundary of a look; each counts once.
    is_spent = np.zeros(_CHOICES, bool)
    all_looks = look_seeds(budget)
    for look, end in enumerate(all_looks, start=1):
        has_seeds = min(len(returns[member]) for member in contenders) >= end
        if len(contenders) == 1 or not has_seeds:
            break
        start = looks[-1] if looks else 0
        values[contenders, start:end] = _with_failures_as_worst(
            np.stack([returns[member][start:end] for member in contenders])
        )
        looks.append(end)
        for member in contenders:
            num_seeds[member] = end
        open_pairs = open_pairs[np.isin(open_pairs, contenders).all(axis=1)]
        num_choices = int(level * look / len(all_looks) * _CHOICES)
        open_pairs, lower, is_spent = _step_down(values[:, :end], open_pairs, is_spent, num_choices)
        contenders = [member for member in contenders if member not in lower]
    is_over = len(contenders) == 1 or looks == all_looks
    return Verdict(contenders, num_seeds, looks, budget, is_over)


def _with_failures_as_worst(values: np.ndarray) -> np.ndarray:
    """Returns values [C, S], the worst finite one of all in place of those that are not finite."""
    is_finite = np.isfinite(values)
    # Where all failed, they are alike, whatever number stands for them.
    worst_value = np.min(values, initial=np.inf, where=is_finite) if is_finite.any() else 0.0
    return np.where(is_finite, values, worst_value)


def _step_down(
    values: np.ndarray, open_pairs: np.ndarray, is_spent: np.ndarray, num_choices: int
) -> tuple[np.ndarray, set[int], np.ndarray]:
    """Tests pairs at one look.

    Args:
      values: [C, S] returns so far.
      open_pairs: [P, 2] the pairs that are tested.
      is_spent: [8192] the choices of signs that were above the boundary of an earlier look.
      num_choices: how many may have been above that of this look or an earlier one.

    Returns:
      The pairs that are not told apart, the lower configurations of the others, ``is_spent`` with
      the choices of this look.
    """
    lower: set[int] = set()
    is_above = np.zeros_like(is_spent)
    while len(open_pairs):
        observed, largest = _statistics(values, open_pairs)
        # The lowest boundary that at most so many choices are above.
        unspent = np.sort(largest[~is_spent])
        boundary = unspent[-1 - (num_choices - int(is_spent.sum()))] * (1 + _ROUNDING)
        is_above = largest > boundary
        is_apart = np.abs(observed) > boundary
        if not is_apart.any():
            break
        lower.update(np.where(observed > 0, open_pairs[:, 1], open_pairs[:, 0])[is_apart].tolist())
        open_pairs = open_pairs[~is_apart]
    return open_pairs, lower, is_spent | is_above


def _statistics(values: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the statistics of pairs [P], and the largest size of all for each choice [8192]."""
    num_seeds = values.shape[1]
    signs = _signs(num_seeds)
    observed = []
    largest = np.zeros(_CHOICES)
    for start in range(0, len(pairs), _PAIRS):
        firsts, seconds = pairs[start : start + _PAIRS].T
        differences = values[firsts] - values[seconds]
        sizes = np.linalg.norm(differences, axis=1, keepdims=True)
        # Equal returns have a statistic of 0.
        statistics = signs @ (differences / np.where(sizes > 0, sizes, 1.0)).T
        observed.append(statistics[0])
        largest = np.maximum(largest, np.abs(statistics).max(axis=1))
    return np.concatenate(observed), largest


@functools.lru_cache(maxsize=16)
def _signs(num_seeds: int) -> np.ndarray:
    """Returns the choices of signs of so many seeds, [8192, S]; the first has no -1.

    Those of fewer seeds are the first columns of those of more.
    """
    columns = [
        np.random.default_rng(seed).choice([-1.0, 1.0], _CHOICES) for seed in range(num_seeds)
    ]
    signs = np.stack(columns, axis=1)
    signs[0] = 1.0
    signs.flags.writeable = False
    return signs

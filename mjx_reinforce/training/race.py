"""Races: policies that train for one seed, of which the worse go on as copies of the better.

R = N * K policies are trained, K for each of N seeds side by side. Truncation selection at fixed
moments, as in population-based training (Jaderberg et al. 2017); a race of one is a plain run.
"""

import numpy as np

#: The shares of the budget at which the better half of a race replaces the worse half.
SHARES = (0.25, 0.5, 0.75)
#: A policy is judged by this share of its updates, the last ones.
_JUDGED_SHARE = 0.1


def scores(episode_return: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns by what policies are judged [R]: the mean training return of their last tenth.

    Args:
      episode_return: [U, R] mean training return of each update; one that is NaN does not count.
      updates: [R] how many updates made each policy, which are its first rows.

    Returns:
      -inf where no return counts.
    """
    first_rows = updates - np.ceil(_JUDGED_SHARE * updates).astype(int)
    # No row before these counts for any policy.
    rows = np.arange(first_rows.min(), len(episode_return))[:, None]
    returns = episode_return[first_rows.min() :]
    counted = (rows >= first_rows) & (rows < updates) & np.isfinite(returns)
    return_sums = np.where(counted, returns, 0.0).sum(axis=0, dtype=np.float64)
    return np.where(counted.any(axis=0), return_sums / np.maximum(counted.sum(axis=0), 1), -np.inf)


def leaders(policy_scores: np.ndarray, race: int) -> np.ndarray:
    """Returns the number of the best policy in each race [N]; of equals the first.

    Args:
      policy_scores: [R] of all policies.
      race: K, the policies of a race.
    """
    best = policy_scores.reshape(-1, race).argmax(axis=1)
    return np.arange(len(best)) * race + best


def sources(policy_scores: np.ndarray, is_cut: np.ndarray) -> np.ndarray:
    """Returns the policies [R] as which each policy goes on.

    In a race that is cut, the worst goes on as the best, the second worst as the second best, and
    so on; of an odd number the middle one stays.

    Args:
      policy_scores: [R] of all policies.
      is_cut: [N] which races are cut.
    """
    score_rows = policy_scores.reshape(len(is_cut), -1)
    race = score_rows.shape[1]
    ranks = np.argsort(-score_rows, axis=1, kind="stable")
    half = race // 2
    places = np.tile(np.arange(race), (len(is_cut), 1))
    np.put_along_axis(places, ranks[:, ::-1][:, :half], ranks[:, :half], axis=1)
    places = np.where(is_cut[:, None], places, np.arange(race))
    return (np.arange(len(is_cut))[:, None] * race + places).reshape(-1)

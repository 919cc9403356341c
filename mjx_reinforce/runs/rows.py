"""The rows of metrics.csv: one for each seed and evaluation."""

from typing import Any

import numpy as np

COLUMNS = (
    *("seed", "update", "episodes", "env_steps", "wall_seconds"),
    *("train_return", "eval_return", "eval_return_stochastic", "eval_length", "train_length"),
    *("entropy", "gradient_norm", "nonfinite_episodes", "skipped_update"),
    *("kl", "policy_std", "explained_variance", "gradient_snr", "clipped_gradients"),
)
#: Columns that an evaluation measures.
_EVALUATION = ("eval_return", "eval_return_stochastic", "eval_length")
#: Columns that the last update measured, and the names of its metrics.
_LAST_UPDATE = {
    "train_return": "episode_return",
    "train_length": "episode_length",
    "entropy": "entropy",
    "gradient_norm": "gradient_norm",
    "nonfinite_episodes": "nonfinite_episodes",
    "skipped_update": "skipped_update",
    "kl": "kl",
    "policy_std": "policy_std",
    "explained_variance": "explained_variance",
    "gradient_snr": "gradient_snr",
    "clipped_gradients": "clipped_gradients",
}


def of_evaluation(
    evaluation: dict[str, np.ndarray],
    last_update: dict[str, np.ndarray],
    updates: np.ndarray,
    episodes: np.ndarray,
    env_steps: np.ndarray,
    seconds: float,
) -> list[dict[str, Any]]:
    """Returns a row for each seed; a return is NaN if one of its episodes was not finite.

    Args:
      evaluation: [S] each, what ``evaluation.evaluate`` returns.
      last_update: [S] each, the metrics of each seed's last update; empty before the first. The
        columns of metrics that a learner does not have are empty.
      updates: [S] how many were made.
      episodes: [S] how many were played for them.
      env_steps: [S] and how many env steps.
      seconds: wall time since compilation ended.
    """
    num_seeds = len(updates)
    columns: dict[str, list[Any]] = {
        "seed": list(range(num_seeds)),
        "update": updates.tolist(),
        "episodes": episodes.tolist(),
        "env_steps": env_steps.tolist(),
        "wall_seconds": [round(seconds, 3)] * num_seeds,
    }
    for name in _EVALUATION:
        columns[name] = evaluation[name].tolist()
    for name, metric in _LAST_UPDATE.items():
        measured = last_update.get(metric)
        columns[name] = [""] * num_seeds if measured is None else measured.tolist()
    table = zip(*(columns[name] for name in COLUMNS), strict=True)
    return [dict(zip(COLUMNS, row, strict=True)) for row in table]

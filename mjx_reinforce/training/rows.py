"""The rows of metrics.csv: one for each seed and evaluation."""

from collections.abc import Mapping, Sequence

import numpy as np

#: The rows of one evaluation as text: column -> the cells of all seeds; columns as in ``COLUMNS``.
Cells = Mapping[str, Sequence[str]]

COLUMNS = (
    *("seed", "update", "episodes", "env_steps", "wall_seconds"),
    *("train_return", "eval_return", "eval_return_stochastic", "eval_length", "train_length"),
    *("entropy", "gradient_norm", "nonfinite_episodes", "skipped_update"),
    *("kl", "policy_std", "explained_variance", "gradient_snr", "clipped_gradients"),
)
#: Columns that an evaluation measures.
_EVALUATION = ("eval_return", "eval_return_stochastic", "eval_length")
#: Columns that the last update measured, and the names of its metrics: the same, but for two.
_RENAMED = {"train_return": "episode_return", "train_length": "episode_length"}
_LAST_UPDATE = _RENAMED | {name: name for name in COLUMNS[COLUMNS.index("entropy") :]}


def of_evaluation(
    evaluation: dict[str, np.ndarray],
    last_update: dict[str, np.ndarray],
    updates: np.ndarray,
    episodes: np.ndarray,
    env_steps: np.ndarray,
    seconds: float,
    first_seed: int = 0,
) -> Cells:
    """Returns the cells of all seeds; a return is NaN if one of its episodes was not finite.

    Args:
      evaluation: [S] each, what ``evaluation.evaluate`` returns.
      last_update: [S] each, the metrics of each seed's last update; empty before the first. The
        columns of metrics that a learner does not have are empty.
      updates: [S] how many were made.
      episodes: [S] how many were played for them.
      env_steps: [S] and how many env steps.
      seconds: wall time since compilation ended.
      first_seed: the number of the first seed.
    """
    num_seeds = len(updates)
    columns: dict[str, Sequence[str]] = {
        "seed": _cells(first_seed + np.arange(num_seeds)),
        "update": _cells(updates),
        "episodes": _cells(episodes),
        "env_steps": _cells(env_steps),
        "wall_seconds": [f"{seconds:.3f}"] * num_seeds,
    }
    for name in _EVALUATION:
        columns[name] = _cells(evaluation[name])
    for name, metric in _LAST_UPDATE.items():
        measured = last_update.get(metric)
        columns[name] = [""] * num_seeds if measured is None else _cells(measured)
    return {name: columns[name] for name in COLUMNS}


def lines(rows: Cells) -> bytes:
    """Returns rows as metrics.csv has them."""
    return "".join(",".join(row) + "\n" for row in zip(*rows.values(), strict=True)).encode()


def _cells(values: np.ndarray) -> Sequence[str]:
    """Returns values [S] as text that, read as their own type, is the same to the last bit."""
    if values.dtype != np.float32:
        return [*map(str, values.tolist())]
    # Nine digits tell any two float32 apart. A thousand in one format take 0.2 ms; one by one with
    # all digits of a double, 1 ms.
    texts = ("%.9g\n" * len(values) % tuple(values.tolist())).split()
    return [f"{text}.0" if text.lstrip("-").isdigit() else text for text in texts]

"""Rows of metrics.csv: what an evaluation and the updates before it measured, as text."""

from collections.abc import Sequence

import numpy as np

from mjx_reinforce.files import Arrays

#: Of metrics.csv, before those of the reward's terms.
COLUMNS = (
    *("seed", "update", "episodes", "env_steps", "wall_seconds", "train_return", "eval_return"),
    *("eval_return_stochastic", "eval_length", "train_length", "entropy", "gradient_norm"),
    *("nonfinite_episodes", "skipped_update", "kl", "policy_std", "explained_variance"),
    "gradient_snr",
)
#: How the columns behind these begin, one for each term of the reward.
TERM_COLUMN = "eval_reward"
#: What these columns are called among the metrics of an update.
_METRIC_OF_COLUMN = {"train_return": "episode_return", "train_length": "episode_length"}


def as_rows(measured: Arrays, seconds: float) -> Arrays:
    """Returns the rows of one evaluation in metrics.csv: column -> the values [S] of all seeds.

    Args:
      measured: [S] each, by column, or as ``_METRIC_OF_COLUMN``. What was not measured is no
        column; terms of the reward are those whose names begin with ``TERM_COLUMN``. A return is
        NaN if one of its episodes was not finite.
      seconds: wall time since compilation ended.
    """
    clock = np.full(len(measured["seed"]), round(seconds, 3))
    columns = {column: measured.get(_METRIC_OF_COLUMN.get(column, column)) for column in COLUMNS}
    terms = {name: x for name, x in measured.items() if name.startswith(TERM_COLUMN)}
    return {n: x for n, x in columns.items() if x is not None} | terms | {"wall_seconds": clock}


def header(terms: Sequence[str]) -> bytes:
    """Returns the first line of metrics.csv, for a task whose reward has these terms."""
    return (",".join([*COLUMNS, *(f"eval_{name}" for name in terms)]) + "\n").encode()


def lines(rows: Arrays, columns: Sequence[str] = COLUMNS) -> bytes:
    """Returns rows as metrics.csv has them; cells of what was not measured are empty.

    Args:
      rows: of ``as_rows``.
      columns: those of the file.
    """
    cells = {name: [""] * len(rows["seed"]) for name in columns}
    cells |= {name: _cells(rows[name]) for name in columns if name in rows}
    return "".join(",".join(row) + "\n" for row in zip(*cells.values(), strict=True)).encode()


def _cells(values: np.ndarray) -> Sequence[str]:
    """Returns values [S] as text that, read as their own type, is the same to the last bit."""
    if values.dtype != np.float32:
        return [*map(str, values.tolist())]
    # Nine digits tell any two float32 apart. A thousand in one format take 0.2 ms; one by one with
    # all digits of a double, 1 ms.
    texts = ("%.9g\n" * len(values) % tuple(values.tolist())).split()
    return [f"{text}.0" if text.lstrip("-").isdigit() else text for text in texts]

"""The rows of docs/peers.csv: what a peer reached on a task after so many seconds of training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.kit import rows

#: A row for each (peer, task, seed, budget).
COLUMNS: tuple[str, ...] = (
    "date",
    "commit",
    "machine",
    "device",
    "peer",
    "version",
    "libraries",
    "environment",
    "task",
    "seed",
    "budget_seconds",
    "seconds",
    "env_steps",
    "mean_return",
    "std_return",
    "episodes",
    "settings",
    "source",
)


def result(budget: float, seconds: float, env_steps: int, returns: np.ndarray) -> dict[str, Any]:
    """Returns what a row says of an evaluation.

    Args:
      budget: seconds of training that were asked for.
      seconds: of training so far; more than the budget, since an update is never cut short.
      env_steps: of training so far.
      returns: [E] of single episodes under the policy without noise.
    """
    return {
        "budget_seconds": f"{budget:g}",
        "seconds": f"{seconds:.1f}",
        "env_steps": env_steps,
        "mean_return": f"{returns.mean():.2f}",
        "std_return": f"{returns.std():.2f}",
        "episodes": len(returns),
    }


def read(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of a file, numbers as numbers."""
    found = rows.read(path)
    for row in found:
        row |= {name: int(row[name]) for name in ("seed", "env_steps", "episodes")}
        for name in ("budget_seconds", "seconds", "mean_return", "std_return"):
            row[name] = float(row[name])
    return found


def budgets(text: str) -> Sequence[float]:
    """Reads budgets in seconds, such as "60,600".

    Raises:
      ValueError: one is no positive number.
    """
    try:
        seconds = [float(part) for part in text.split(",")]
    except ValueError:
        seconds = [0.0]
    if not all(0 < x < float("inf") for x in seconds):
        raise ValueError(f"--seconds is {text!r}; give positive numbers, such as 60,600")
    return sorted(set(seconds))

"""What a run says at its end: a summary, a picture, a table."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.records import write_bytes
from mjx_reinforce.statistics import iqm, iqm_interval, steps_to_solve


def load_libraries() -> None:
    """Imports what the report needs, half a second of work, while something else runs."""
    import matplotlib.figure  # noqa: F401
    import scipy.stats  # noqa: F401


def summarize(history: dict[str, np.ndarray], threshold: float | None) -> dict[str, Any]:
    """Returns the statistics over seeds of a run.

    Args:
      history: ``eval_return`` and ``env_steps``, each [E, S]: evaluations by seeds.
      threshold: the return that counts as solved, if any.

    Returns:
      ``final_returns`` [S], their interquartile mean ``iqm`` with its 95 %
      interval ``iqm_ci``, ``solve_rate`` (the fraction of seeds whose last
      evaluation reached the threshold, None without one), and
      ``env_steps_to_solve`` [S].
    """
    final = history["eval_return"][-1]
    low, high = iqm_interval(final)
    return {
        "final_returns": final.tolist(),
        "iqm": float(iqm(final)),
        "iqm_ci": [float(low), float(high)],
        "solve_rate": None if threshold is None else float(np.mean(final >= threshold)),
        "env_steps_to_solve": steps_to_solve(
            history["eval_return"], history["env_steps"], threshold
        ),
    }


def draw_learning_curve(
    path: Path, history: dict[str, np.ndarray], env: str, threshold: float | None
) -> None:
    """Draws every seed thin, their interquartile mean with a 95 % band, and the threshold.

    Seeds reach different numbers of env steps at an evaluation, so all curves are
    read off, by linear interpolation, at the steps of the slowest seed's range.
    """
    from matplotlib.figure import Figure

    returns, steps = history["eval_return"], history["env_steps"]
    num_seeds = returns.shape[1]
    grid = np.linspace(0, steps[-1].min(), 200)
    curves = np.stack(
        [np.interp(grid, steps[:, s], returns[:, s]) for s in range(num_seeds)], axis=1
    )
    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.subplots()
    alpha = max(0.03, min(0.5, 4 / num_seeds))
    axes.plot(steps, returns, color="tab:blue", linewidth=0.7, alpha=alpha)
    axes.plot(grid, iqm(curves), color="tab:blue", linewidth=2, label="interquartile mean")
    if num_seeds > 1:
        low, high = iqm_interval(curves)
        axes.fill_between(
            grid, low, high, color="tab:blue", alpha=0.25, linewidth=0, label="95 % interval"
        )
    if threshold is not None:
        axes.axhline(threshold, color="0.3", linestyle="--", linewidth=1, label="solved")
    axes.set(
        xlabel="env steps of a seed",
        ylabel="return of the deterministic policy",
        title=f"{env}, {num_seeds} seed{'s' if num_seeds > 1 else ''}",
    )
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    write_bytes(path, picture.getvalue())

"""What a run says at its end: a summary, a picture, a table."""

import io
from typing import Any, cast

import numpy as np

from mjx_reinforce.reports.statistics import iqm, iqm_interval, steps_to_solve

#: Training returns are drawn as means over so many episodes.
_SMOOTHED_EPISODES = 50


def load_libraries() -> None:
    """Imports what the report needs, half a second of work, while something else runs."""
    import matplotlib.figure  # noqa: F401
    import scipy.stats  # noqa: F401


def summarize(history: dict[str, np.ndarray], threshold: float | None) -> dict[str, Any]:
    """Returns the statistics over seeds of a run.

    Args:
      history: ``eval_return``, and the ``env_steps`` and ``episodes`` until then, each
        [E, S]: evaluations by seeds.
      threshold: the return that counts as solved, if any.

    Returns:
      ``final_returns`` [S], their interquartile mean ``iqm`` with its 95 %
      interval ``iqm_ci``, ``solve_rate`` (the fraction of seeds whose last
      evaluation reached the threshold, None without one), and
      ``env_steps_to_solve`` and ``episodes_to_solve`` [S], until the first that did.
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
        "episodes_to_solve": steps_to_solve(history["eval_return"], history["episodes"], threshold),
    }


def to_npz(arrays: dict[str, np.ndarray]) -> bytes:
    """Returns the contents of a compressed NumPy archive; no pickle."""
    archive = io.BytesIO()
    np.savez_compressed(archive, allow_pickle=False, **cast(Any, arrays))
    return archive.getvalue()


def smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Returns the mean of each value [U, ...] and up to ``window`` - 1 before it."""
    sums = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0)
    first = np.maximum(np.arange(len(values)) + 1 - window, 0)
    count = np.arange(len(values)) + 1 - first
    return (sums[1:] - sums[first]) / count.reshape(-1, *(1,) * (values.ndim - 1))


def draw_learning_curve(
    history: dict[str, np.ndarray],
    training: dict[str, np.ndarray],
    env: str,
    threshold: float | None,
    axis: str = "env_steps",
) -> bytes:
    """Draws every seed thin, their interquartile mean with a 95 % band, and the threshold.

    Seeds may reach different numbers of env steps at an evaluation, so all curves are
    read off, by linear interpolation, in the range of the slowest seed.

    Args:
      history: evaluations, as for ``summarize``.
      training: ``episode_return`` of each update, NaN where a seed stands still, and the
        ``env_steps`` and ``episodes`` after it, [U, S]; drawn smoothed over some fifty
        episodes, the window is in the legend.
      env: its id, for the title.
      threshold: the return that counts as solved, if any.
      axis: what the curves are drawn over, "env_steps" or "episodes".

    Returns:
      A PNG file.
    """
    from matplotlib.figure import Figure

    returns, steps = history["eval_return"], history[axis]
    num_seeds = returns.shape[1]
    grid = np.linspace(0, steps[-1].min(), 200)
    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.subplots()
    if len(training[axis]):
        episodes = training["episodes"][0, 0]  # an update
        window = min(-(-_SMOOTHED_EPISODES // episodes), len(training[axis]))
        label = f"while training, mean of {window * episodes} episodes"
        smoothed = smooth(training["episode_return"], window)
        inside = grid[grid >= training[axis][0].max()]
        _draw_mean(axes, inside, training[axis], smoothed, "tab:orange", label)
    alpha = max(0.03, min(0.5, 4 / num_seeds))
    axes.plot(steps, returns, color="tab:blue", linewidth=0.7, alpha=alpha)
    _draw_mean(axes, grid, steps, returns, "tab:blue", "deterministic policy")
    if threshold is not None:
        axes.axhline(threshold, color="0.3", linestyle="--", linewidth=1, label="solved")
    seeds = f"interquartile mean of {num_seeds} seeds, 95 % interval" if num_seeds > 1 else "1 seed"
    axes.set(xlabel=f"{axis.replace('_', ' ')} of a seed", ylabel="return", title=f"{env}, {seeds}")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _draw_mean(
    axes: Any, grid: np.ndarray, steps: np.ndarray, returns: np.ndarray, color: str, label: str
) -> None:
    """Draws the interquartile mean over seeds of curves [E, S] on a grid of steps, and its band."""
    curves = []
    for s in range(returns.shape[1]):
        known = np.isfinite(returns[:, s])  # a seed that stands still keeps its last value
        curves.append(np.interp(grid, steps[known, s], returns[known, s]))
    curves = np.stack(curves, axis=1)
    axes.plot(grid, iqm(curves), color=color, linewidth=2, label=label)
    if len(grid) and curves.shape[1] > 1:
        low, high = iqm_interval(curves)
        axes.fill_between(grid, low, high, color=color, alpha=0.25, linewidth=0)

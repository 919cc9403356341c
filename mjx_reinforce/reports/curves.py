"""Pictures of how seeds learned."""

import io
from typing import TYPE_CHECKING

import numpy as np

from mjx_reinforce.statistics import enough, iqm, iqm_interval, smooth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Training returns are drawn as means over so many episodes.
_SMOOTHED_EPISODES = 50


def load_libraries() -> None:
    """Imports what drawing needs, a second of work, so that it can run beside other work."""
    import matplotlib.backends.backend_agg
    import matplotlib.figure  # noqa: F401


def draw_learning_curve(
    history: dict[str, np.ndarray],
    training: dict[str, np.ndarray],
    env: str,
    threshold: float | None,
    axis: str = "env_steps",
) -> bytes:
    """Draws every seed thin, their interquartile mean with a 95 % band, and the threshold.

    A threshold that lies far above all returns is in the legend alone.

    Seeds may reach different numbers of env steps at an evaluation, so all curves are
    read off, by linear interpolation, in the range of the slowest seed.

    Args:
      history: evaluations, as for ``summarize``.
      training: ``episode_return`` of each update, NaN where a seed stands still or an episode
        left the finite numbers, and the ``env_steps`` and ``episodes`` after it, [U, S]; drawn
        smoothed over some fifty episodes, the window is in the legend.
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
        _draw_training(axes, grid, training, axis)
    alpha = max(0.03, min(0.5, 4 / num_seeds))
    axes.plot(steps, returns, color="tab:blue", linewidth=0.7, alpha=alpha)
    _draw_mean(axes, grid, steps, returns, "tab:blue", "deterministic policy")
    if (drawn := drawn_threshold(threshold, returns)) is not None:
        axes.axhline(drawn, color="0.3", linestyle="--", linewidth=1, label="solved")
    elif threshold is not None:
        axes.plot([], [], " ", label=f"solved at {threshold:,g}, above the picture")
    seeds = f"interquartile mean of {num_seeds} seeds" if num_seeds > 1 else "1 seed"
    seeds += ", 95 % interval" if enough(num_seeds) else ""
    failed = int(np.sum(~np.isfinite(returns[-1])))
    seeds += f"; {failed:,} of {num_seeds:,} not finite at the end" if failed else ""
    axes.set(xlabel=f"{axis.replace('_', ' ')} of a seed", ylabel="return", title=f"{env}, {seeds}")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    # With a thousand seeds, to look for the best place takes as long as all the rest.
    axes.legend(loc="best" if num_seeds <= 100 else "lower right", frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _draw_training(
    axes: "Axes", grid: np.ndarray, training: dict[str, np.ndarray], axis: str
) -> None:
    """Draws the smoothed training returns, as ``draw_learning_curve`` says."""
    episodes = training["episodes"][0, 0]  # an update
    window = min(-(-_SMOOTHED_EPISODES // episodes), len(training[axis]))
    label = f"while training, mean of {window * episodes} episodes"
    smoothed = smooth(training["episode_return"], window)
    inside = grid[grid >= training[axis][0].max()]
    _draw_mean(axes, inside, training[axis], smoothed, "tab:orange", label)


def _draw_mean(
    axes: "Axes", grid: np.ndarray, steps: np.ndarray, returns: np.ndarray, color: str, label: str
) -> None:
    """Draws the interquartile mean over seeds of curves [E, S] on a grid of steps, and its band.

    A seed counts as failed, see ``iqm``, around a return that is not finite.
    """
    curves = on_grid(grid, steps, returns)
    axes.plot(grid, iqm(curves), color=color, linewidth=2, label=label)
    if len(grid) and curves.shape[1] > 1:
        low, high = iqm_interval(curves)
        axes.fill_between(grid, low, high, color=color, alpha=0.25, linewidth=0)


def drawn_threshold(threshold: float | None, returns: np.ndarray) -> float | None:
    """Returns a threshold that is drawn over returns; None where it would squeeze all of them."""
    known = returns[np.isfinite(returns)]
    if threshold is None or not known.size or threshold - known.max() > 0.5 * np.ptp(known):
        return None
    return threshold


def on_grid(grid: np.ndarray, steps: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Returns curves [E, S] read off, by linear interpolation, on a grid [K] of steps: [K, S].

    A return that is not finite makes all that is read off beside it so, too.
    """
    curves = []
    for s in range(returns.shape[1]):
        moved = np.diff(steps[:, s], prepend=-1) > 0  # a seed that stands still keeps its value
        curves.append(np.interp(grid, steps[moved, s], returns[moved, s]))
    return np.stack(curves, axis=1)

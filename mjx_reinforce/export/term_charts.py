"""A chart of an episode: the terms of the reward, and the command beside what the robot does."""

import io
from typing import Any

import numpy as np

from mjx_reinforce.export.films import Take, robot_paths, velocities

#: What the three numbers of a commanded velocity are.
_VELOCITY = ("forward (m/s)", "sideways (m/s)", "turning (rad/s)")


def draw_terms(take: Take) -> bytes:
    """Returns the chart as a PNG file: each term in every env step, over the seconds.

    Of a reward without terms it is the reward. Below are the command, if there is one, as dashed
    lines, and the velocity of a robot with a free joint. Gray lines are pushes.
    """
    from matplotlib.figure import Figure

    num_panels = 1 if take.commands is None else 2
    figure = Figure(figsize=(8, 3 * num_panels), dpi=150, layout="constrained")
    panels = np.ravel(figure.subplots(num_panels, sharex=True, squeeze=False))
    seconds = take.dt * np.arange(1, 1 + len(take.rewards))
    for name, rewards in (take.terms or {"reward": take.rewards}).items():
        panels[0].plot(seconds, rewards, linewidth=1, label=name)
    panels[0].set(title=take.label, ylabel="reward of an env step")
    if take.commands is not None:
        _draw_command(panels[1], take, take.commands)
    push_steps = [] if take.pushes is None else np.flatnonzero(take.pushes)
    for panel in panels:
        for pushed in take.dt * np.asarray(push_steps):  # an env step begins with a push
            panel.axvline(pushed, color="0.6", linewidth=0.8)
        panel.grid(alpha=0.3)
        panel.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
    panels[-1].set_xlabel("seconds")
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _draw_command(panel: Any, take: Take, commands: np.ndarray) -> None:
    """Draws each number of the command, and what the robot does of it in the same color."""
    seconds = take.dt * np.arange(len(take.qpos))
    paths = robot_paths(take)
    is_velocity = commands.shape[1] == len(_VELOCITY) and paths is not None
    for number, command in enumerate(commands.T):
        label = _VELOCITY[number] if is_velocity else f"command {number}"
        look = {"color": f"C{number}", "linewidth": 1.2, "label": label}
        panel.plot(seconds, command, "--", drawstyle="steps-post", **look)
    if is_velocity and paths is not None:
        for number, speeds in enumerate(velocities(take, paths).T):
            panel.plot(seconds, speeds, color=f"C{number}", linewidth=1)
    panel.set(ylabel="command (dashed), robot" if is_velocity else "command")

"""``python -m mjx_reinforce.watch RUN`` plays a trained policy and makes a film of it."""

import dataclasses
import math
import os
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from mjx_reinforce import envs
from mjx_reinforce.export.films import (
    Renderer,
    import_gymnasium,
    import_mujoco,
    mediapy_with_ffmpeg,
    write_film,
)
from mjx_reinforce.export.run_files import Run, Seed, Which, choose_seed, read_run
from mjx_reinforce.runs.alarms import silence_alarms
from mjx_reinforce.runs.commands import command
from mjx_reinforce.runs.flags import read
from mjx_reinforce.runs.heartbeat import heartbeat
from mjx_reinforce.runs.jax_setup import configure_jax
from mjx_reinforce.runs.lines import say_error
from mjx_reinforce.runs.newest import RUNS, choose_run
from mjx_reinforce.runs.own_code import check_named
from mjx_reinforce.runs.streams import accept_everything

#: Frames a second at most: what a film shows, and what GIF viewers play.
_MAX_RATE = 30
#: Pictures, spread over the film, whose colours it has.
_SAMPLES = 4
#: Settings that are whole numbers, with the least and the greatest that is accepted.
_RANGES = (
    *(("width", 1, 4096), ("height", 1, 4096)),
    *(("episode", 0, 2**31 - 1), ("episodes", 1, 10_000)),
)

Play = Callable[[int, bool], Any]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Play one episode of a trained policy, print its return, and make a film of it."""

    run: tyro.conf.Positional[Path] = RUNS
    """The run directory that training left, or a folder of runs, whose newest plays."""
    env: str | None = None
    """Needed where a run was trained on module:Class, code of your own or of another: that name
    again, for then it is run."""
    seed: Seed = "best"
    """Which of the run's seeds plays: best, worst or median by its final evaluation, or a number.
    """
    which: Which = "last"
    """The policy at the end of training, or the one that did best on the way, if it was kept."""
    backend: Literal["mjx", "gymnasium"] = "mjx"
    """Which simulation is filmed; "gymnasium" plays the same policy in the installed Gymnasium,
    and prints the returns of --episodes in both."""
    episodes: int = 16
    """With --backend gymnasium: how many episodes are compared."""
    episode: int = 0
    """Number of the start state; the same number, the same start."""
    noise: bool = False
    """Draw actions from the policy, as training does, instead of taking its mode."""
    output: Path | None = None
    """The film, .gif or, after pip install mediapy imageio-ffmpeg, .mp4.
    By default RUN/seed-NUMBER.gif, or RUN/seed-NUMBER-gymnasium.gif."""
    seconds: float = 20.0
    """Length of the film at most, in simulated seconds; the episode is played to its end."""
    width: int = 480
    """Pixels."""
    height: int = 360
    """Pixels."""
    overwrite: bool = False
    """Replace a film that exists."""


def main() -> None:
    """Reads the command line, films, and exits: 0 done, 2 bad input, 130 interrupted."""
    accept_everything()
    silence_alarms()
    try:
        settings = read(Settings, sys.argv[1:], command("watch"), Settings.__doc__ or "")
        film(dataclasses.replace(settings, run=choose_run(settings.run)))
    except (ValueError, OSError) as error:
        say_error(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def film(settings: Settings) -> None:
    """Plays the episode, says what it returned, and writes the film.

    Raises:
      ValueError: a setting is out of range, or the run is damaged, or nothing can be drawn here.
      OSError: a file cannot be read or written.
    """
    run = read_run(settings.run)
    _check_env(settings, run)
    output = check(settings, choose_seed(run, settings.seed, settings.which))
    if settings.backend == "gymnasium":
        import_gymnasium()
    import_mujoco()
    configure_jax()
    from mjx_reinforce.export.player import load_seed

    player, _ = load_seed(run, settings.seed, settings.which)
    env = _make(run, player.observation_size)
    renderer = Renderer(scene(env), settings.width, settings.height)
    simulators = _simulators(settings, env, player, run.horizon)
    name, play = list(simulators.items())[-1]
    with _waiting("compiling and playing"):
        episode = play(settings.episode, settings.noise)
        steps = f"{len(episode.rewards)} steps in {name}"
        print(f"{run.env}, seed {player.seed}: return {episode.total:.1f} in {steps}")
        if len(simulators) > 1:
            print(compare(settings, simulators))
    skip = max(1, math.ceil(1 / (env.dt * _MAX_RATE) - 1e-9))
    shown = episode.qpos[: max(1, round(settings.seconds / env.dt)) : skip]
    samples = [renderer.draw(qpos) for qpos in shown[:: -(-len(shown) // _SAMPLES)]]
    frames = track(map(renderer.draw, shown), "drawing", len(shown), transient=True)
    write_film(output, frames, 1 / (env.dt * skip), samples)
    print(f"{len(shown)} frames in {output}")


def _check_env(settings: Settings, run: Run) -> None:
    """Raises ValueError for another environment than the run's, or where one must be named."""
    if settings.env not in (None, run.env):
        raise ValueError(f"--env is {settings.env}, but {run.directory} was trained on {run.env}")
    check_named(run.env, settings.env, run.directory)


def _waiting(what: str) -> AbstractContextManager[Any]:
    """Returns a ``with`` block that shows that its contents go on."""
    console = Console(stderr=True)
    return console.status(what) if console.is_terminal else heartbeat(console.print, None, what)


def _make(run: Run, size: int) -> Any:
    """Returns the run's environment; raises ValueError if its observations are not of a size."""
    from mjx_reinforce.types import observation_size

    env = envs.make(run.env)
    if observation_size(env) != size:
        raise ValueError(
            f"the policy in {run.directory} takes observations of {size} entries, {run.env} has "
            f"{observation_size(env)}: config.json and policy/ are of different runs"
        )
    return env


def _simulators(settings: Settings, env: Any, player: Any, horizon: int) -> dict[str, Play]:
    """Returns what plays, by name; the last is filmed."""
    from mjx_reinforce.runs.playing import gymnasium_simulator, simulator

    simulators: dict[str, Play] = {"mjx": simulator(env, player, horizon)}
    if settings.backend == "gymnasium":
        version, play = gymnasium_simulator(player, horizon)
        simulators[f"gymnasium {version}"] = play
    return simulators


def compare(settings: Settings, simulators: dict[str, Play]) -> str:
    """Returns the mean and range of the returns in each simulation, side by side."""
    said = []
    for name, play in simulators.items():
        totals = [play(i, settings.noise).total for i in range(settings.episodes)]
        worst, best = np.min(totals), np.max(totals)
        said.append(f"{name} {np.mean(totals):.1f} ({worst:.1f} to {best:.1f})")
    return f"mean return of {settings.episodes} episodes: {', '.join(said)}"


def check(settings: Settings, seed: int) -> Path:
    """Returns the film's path.

    Args:
      settings: the command line.
      seed: the number of the seed that plays.

    Raises:
      ValueError: a setting is out of range, or the film exists or cannot be written.
    """
    if not 0 < settings.seconds < float("inf"):
        raise ValueError(f"--seconds must be positive and finite, got {settings.seconds}")
    for name, least, most in _RANGES:
        value = getattr(settings, name)
        if not least <= value <= most:
            raise ValueError(f"--{name} must be in [{least}, {most}], got {value}")
    name = f"seed-{seed}{'-gymnasium' * (settings.backend == 'gymnasium')}.gif"
    output = settings.output or settings.run / name
    if output.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"{output} is no film; end --output in .gif or .mp4")
    if not (output.parent.is_dir() and os.access(output.parent, os.W_OK)):
        raise ValueError(f"cannot write to {output.parent}; choose another --output")
    if output.is_dir() or (output.exists() and not settings.overwrite):
        raise ValueError(f"{output} exists; pass --overwrite or another --output")
    if output.suffix.lower() == ".mp4":
        mediapy_with_ffmpeg(output)
    return output


def scene(env: Any) -> Any:
    """Returns the MuJoCo model that an environment's ``qpos`` moves.

    Raises:
      ValueError: it has none.
    """
    if hasattr(env, "mj_model"):
        return env.mj_model
    if hasattr(env, "scene"):
        from mjx_reinforce.envs import models

        return models.load(env.scene)
    raise ValueError(
        f"{type(env).__name__} has no mj_model, so there is nothing to draw; in a wrapper, set "
        "self.mj_model and self.dt to those of what it wraps; or play with mjx_reinforce.load"
    )


if __name__ == "__main__":
    main()

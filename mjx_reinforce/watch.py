"""``python -m mjx_reinforce.watch RUN`` plays a trained policy and makes a film of it."""

import dataclasses
import os
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import accept_everything, heartbeat, say_error, silence_alarms
from mjx_reinforce.export.films import (
    Renderer,
    import_gymnasium,
    import_mujoco,
    mediapy_with_ffmpeg,
    write_film,
)
from mjx_reinforce.export.run_files import SeedChoice, Which
from mjx_reinforce.files import check_folder
from mjx_reinforce.playing.cast import (
    RUNS,
    PolicySource,
    Role,
    cast,
    choose_run,
    main_seed,
    read_source,
)
from mjx_reinforce.settings.flags import read_command_line
from mjx_reinforce.settings.own_code import check_named

if TYPE_CHECKING:
    from mjx_reinforce.envs.base import MujocoEnv
    from mjx_reinforce.types import MjModel

#: Settings that are whole numbers, with the least and the greatest that is accepted.
_RANGES = (
    *(("width", 1, 4096), ("height", 1, 4096)),
    *(("episode", 0, 2**31 - 1), ("episodes", 1, 10_000)),
)


@dataclasses.dataclass(frozen=True)
class WatchSettings:
    """Play one episode of a trained policy, print its return, and make a film of it."""

    run: tyro.conf.Positional[Path] = RUNS
    """The run directory that training left; or a folder of runs, whose newest plays; or the name of
    a task, such as HalfCheetah-v5, whose trained policy comes with the package."""
    env: str | None = None
    """Needed where a run was trained on module:Class, code of your own or of another: that name
    again, for then it is run."""
    policy: str | None = None
    """Needed where the distribution of a run is module:name, as --env is."""
    seed: SeedChoice = "best"
    """Which of the run's seeds plays: best, worst or median by its final evaluation, or a number.
    """
    which: Which = "last"
    """The policy at the end of training, or the one that did best on the way, if it was kept."""
    beside: Literal["untrained"] | SeedChoice | None = None
    """A second policy, on the left, from the same start: untrained (before and after), or another
    seed of the run, such as worst."""
    live: bool = False
    """Show episode after episode in MuJoCo's viewer, in place of a film; the mouse pulls at bodies
    (a double click selects, Ctrl and a drag pulls). Needs a screen."""
    backend: Literal["mjx", "mujoco", "gymnasium"] | None = None
    """Which simulation is filmed: "mjx", as in training; "mujoco", C MuJoCo, which starts at once;
    "gymnasium", the installed Gymnasium, and then the returns of --episodes in it and in mjx are
    printed. By default mjx for a run, mujoco with --live and for a policy of the package."""
    episodes: int = 16
    """With --backend gymnasium: how many episodes are compared."""
    episode: int = 0
    """Number of the start state; the same number, the same start."""
    noise: bool = False
    """Draw actions from the policy, as training does, instead of taking its mode."""
    output: Path | None = None
    """The film, .gif or, after pip install mediapy imageio-ffmpeg, .mp4.
    By default RUN/seed-NUMBER.gif, or RUN/seed-NUMBER-gymnasium.gif; for a policy of the package
    TASK.gif."""
    seconds: float = 20.0
    """Length of the film at most, in simulated seconds; the episode is played to its end."""
    width: int = 480
    """Pixels of each policy's picture."""
    height: int = 360
    """Pixels, without the words below."""
    overwrite: bool = False
    """Replace a film that exists."""


def main() -> None:
    """Reads the command line, films, and exits: 0 done, 2 bad input, 130 interrupted."""
    accept_everything()
    silence_alarms()
    try:
        settings = read_command_line(
            WatchSettings, sys.argv[1:], command("watch"), WatchSettings.__doc__ or ""
        )
        film(dataclasses.replace(settings, run=choose_run(settings.run)))
    except (ValueError, OSError) as error:
        say_error(str(error))
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def film(settings: WatchSettings) -> None:
    """Plays the episode, says what it returned, and writes the film.

    Raises:
      ValueError: a setting is out of range, or the run is damaged, or nothing can be drawn here.
      OSError: a file cannot be read or written.
    """
    source = read_source(settings.run)
    _check_env(settings, source)
    output = film_path(settings, source)
    if settings.backend == "gymnasium":
        import_gymnasium()
    import_mujoco()
    configure_jax()
    from mjx_reinforce.playing.mujoco_playing import check_observations

    roles = cast(settings, source)
    env = envs.make_set(source.env, source.run.env_set if source.run else ())
    check_observations(env, roles[-1].player, source)
    if settings.live:
        from mjx_reinforce.playing.mujoco_playing import live

        live(env, scene(env), roles[-1].player, source.horizon, settings)
        return
    model = scene(env)
    size = settings.width, settings.height
    renderer = Renderer(model, *size)  # raises before anything is compiled
    from mjx_reinforce.export.takes import side_by_side

    takes = [_take(settings, source, env, model, role) for role in roles]
    shown = side_by_side(takes, *size, seconds=settings.seconds, renderer=renderer)
    samples = [*map(shown.draw, shown.samples)]
    frames = map(shown.draw, track(range(shown.length), "drawing", transient=True))
    write_film(output, frames, shown.rate, samples)
    lasting = max((len(take.qpos) - 1) * take.dt for take in takes)
    cut = f": {settings.seconds:g} of {lasting:g} s; --seconds {lasting:g} shows all"
    print(f"{shown.length} frames in {output}{cut * (settings.seconds < lasting)}")


def _take(
    settings: WatchSettings, source: PolicySource, env: "MujocoEnv", model: "MjModel", role: Role
) -> Any:
    """Returns the episode of one policy, and says what it earned."""
    from mjx_reinforce.export.takes import Take
    from mjx_reinforce.playing.mujoco_playing import simulators

    by_name = simulators(settings.backend, env, role.player, source)
    name, play = list(by_name.items())[-1]
    with _waiting("compiling and playing"):
        episode = play(settings.episode, settings.noise)
        steps = f"{len(episode.rewards)} steps in {name}"
        print(f"{source.env}, {role.name}: return {episode.total:.1f} in {steps}")
        if len(by_name) > 1:
            print(compare(settings, by_name))
    return Take(role.label, model, _within(env, "dt").dt, episode.qpos, episode.rewards)


def _check_env(settings: WatchSettings, source: PolicySource) -> None:
    """Raises ValueError for another environment than the run's, or where one must be named."""
    if settings.env not in (None, source.env):
        raise ValueError(f"--env is {settings.env}, but {settings.run} was trained on {source.env}")
    check_named({"env": source.env}, {"env": settings.env}, settings.run)


def _waiting(what: str) -> AbstractContextManager[Any]:
    """Returns a ``with`` block that shows on the screen that its contents are still running."""
    console = Console(stderr=True)
    return console.status(what) if console.is_terminal else heartbeat(console.print, what)


def compare(settings: WatchSettings, simulators: Mapping[str, Any]) -> str:
    """Returns the mean and range of the returns in each simulation, side by side."""
    said = []
    for name, play in simulators.items():
        totals = [play(i, settings.noise).total for i in range(settings.episodes)]
        worst, best = np.min(totals), np.max(totals)
        said.append(f"{name} {np.mean(totals):.1f} ({worst:.1f} to {best:.1f})")
    return f"mean return of {settings.episodes} episodes: {', '.join(said)}"


def film_path(settings: WatchSettings, source: PolicySource) -> Path:
    """Returns the film's path.

    Raises:
      ValueError: a setting is out of range, the run has no such seed, or the film exists or cannot
        be written.
    """
    if not 0 < settings.seconds < float("inf"):
        raise ValueError(f"--seconds must be positive and finite, got {settings.seconds}")
    for name, least, most in _RANGES:
        value = getattr(settings, name)
        if not least <= value <= most:
            raise ValueError(f"--{name} must be in [{least}, {most}], got {value}")
    _check_together(settings)
    number = main_seed(settings, source)
    suffix = "-gymnasium" * (settings.backend == "gymnasium")
    name = f"seed-{number}" if source.run else source.env
    folder = source.run.directory if source.run else Path()
    output = settings.output or folder / f"{name}{suffix}.gif"
    if settings.live:
        return output
    if output.suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"{output} is no film; end --output in .gif or .mp4")
    check_folder(output.parent)
    if output.is_dir() or (output.exists() and not settings.overwrite):
        raise ValueError(f"{output} exists; pass --overwrite or another --output")
    if output.suffix.lower() == ".mp4":
        mediapy_with_ffmpeg(output)
    return output


def _check_together(settings: WatchSettings) -> None:
    """Raises ValueError for settings that exclude each other, or where --live has no screen."""
    if settings.live and settings.backend not in (None, "mujoco"):
        raise ValueError(
            f"--live needs C MuJoCo, and --backend is {settings.backend}; leave one out"
        )
    if settings.live and settings.beside is not None:
        raise ValueError("--live shows one policy; leave --beside out")
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if settings.live and sys.platform == "linux" and not screen:
        raise ValueError(
            "--live needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
            "leave --live out to write a film"
        )


def scene(env: "MujocoEnv") -> Any:
    """Returns the MuJoCo model that an environment's ``qpos`` moves, with a floor and a sky.

    Raises:
      ValueError: it has none.
    """
    env = _within(env, "mj_model")
    settings = getattr(env, "settings", None)
    xml_file = getattr(env, "scene", None) or getattr(settings, "xml_file", None)
    if xml_file is not None and not hasattr(xml_file, "nbody"):  # no compiled model
        from mjx_reinforce.envs import models
        from mjx_reinforce.export.scenery import dress

        return dress(models.spec(xml_file), replace=not models.is_own(xml_file))
    if hasattr(env, "mj_model"):
        return env.mj_model
    raise ValueError(
        f"{type(env).__name__} has no mj_model, so there is nothing to draw; in a wrapper, set "
        "self.env to what it wraps; or play with mjx_reinforce.load"
    )


def _within(env: Any, name: str) -> Any:
    """Returns the outermost of wrappers that has an attribute, or what they wrap as ``env``."""
    while not hasattr(env, name) and hasattr(env, "env"):
        env = env.env
    return env


if __name__ == "__main__":
    main()

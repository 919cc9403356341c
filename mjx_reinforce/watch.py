"""``python -m mjx_reinforce.watch RUN`` plays a trained policy and makes a video of it."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.jax_setup import configure_jax, warn
from mjx_reinforce.console.streams import silence_alarms
from mjx_reinforce.engine.checks import explain
from mjx_reinforce.engine.vector.pictures import check_drawing
from mjx_reinforce.export.films import Take, gif, side_by_side, with_sky
from mjx_reinforce.export.run_files import PolicyChoice, Run, SeedChoice, choose_seed, read_run
from mjx_reinforce.export.term_charts import draw_terms
from mjx_reinforce.files import check_output, write_bytes
from mjx_reinforce.settings.config import check_named
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.export.policy_files import Player

#: Where runs are put that name no other place, see ``Design.directory``.
RUNS = Path("runs")
#: Settings that are whole numbers, with the least and the greatest that is accepted.
_RANGES = {"width": (1, 4096), "height": (1, 4096), "episode": (0, 2**31 - 1)}


@dataclasses.dataclass(frozen=True)
class WatchSettings:
    """Play one episode of a trained policy, print its return, and make a video of it."""

    run: tyro.conf.Positional[Path] = RUNS
    """A run directory; a folder of runs, of which the newest plays; or a task such as
    HalfCheetah-v5, whose trained policy comes with the package."""
    env: str | None = None
    """Your own task that the run was trained on, module:Class. Its code runs only if named here."""
    policy: str | None = None
    """Your own distribution that the run was trained with, module:name."""
    seed: SeedChoice = "best"
    """Seed that plays: best, worst or median by its final evaluation, or a number."""
    which: PolicyChoice = "last"
    """The policy at the end of training (last), or the best at any evaluation, if it was kept."""
    beside: Literal["untrained"] | None = None
    """Show the policy before training on the left, from the same start."""
    episode: int = 0
    """Number of the start state. The same number gives the same start."""
    chart: Path | None = None
    """Also draw a chart, .png: each term of the reward in every env step and, if the task has a
    command, the command beside what the robot does."""
    noise: bool = False
    """Draw actions from the policy, as training does, instead of taking its mode."""
    output: Path | None = None
    """The video, .gif. By default RUN/seed-NUMBER.gif, or TASK.gif for a policy of the package."""
    seconds: float = 20.0
    """The longest video, in simulated seconds. The episode is still played to its end."""
    width: int = 480
    """Width of each policy's picture, in pixels."""
    height: int = 360
    """Height of the picture, in pixels, without the caption."""
    overwrite: bool = False
    """Replace a video that exists."""


def main() -> None:
    """Reads the command line, films, and exits: 0 done, 2 bad input, 130 interrupted."""
    silence_alarms()
    run_command(WatchSettings, "watch", film)


def film(settings: WatchSettings) -> None:
    """Plays the episode, says what it returned, and writes the film.

    Raises:
      ValueError: a setting is out of range, or the run is damaged, or nothing can be drawn here.
      OSError: a file cannot be read or written.
    """
    # All that can be wrong is checked first, for JAX takes seconds to load.
    run = read_run(choose_run(settings.run))
    if settings.env not in (None, run.env):
        raise ValueError(f"--env is {settings.env}, but {run.directory} was trained on {run.env}")
    check_named({"env": run.env}, {"env": settings.env}, run.directory)
    output = film_path(settings, run)
    if settings.chart is not None:
        check_output(settings.chart, settings.overwrite, ".png")
    check_drawing()
    configure_jax()
    from mjx_reinforce.export.policy_files import load_seed

    player, _ = load_seed(run, settings.seed, settings.which, settings.policy)
    label = run.env if run.packaged else f"{run.env}, seed {player.seed}"
    players = {label: player}
    if settings.beside is not None:
        players = {"before training": untrained(player), "after training": player}
    env = envs.make_set(run.env, run.env_set)
    model = scene(env)
    takes = []
    for label, player in players.items():
        name, play = simulator(env, player, run.horizon)
        with Console(stderr=True).status("compiling and playing"):
            episode = play(settings.episode, settings.noise)
        print(f"{label}: return {episode.total:.1f} in {len(episode.rewards)} steps in {name}")
        takes.append(Take(label, model, _within(env, "dt").dt, *episode))
    shown = side_by_side(takes, settings.width, settings.height, seconds=settings.seconds)
    # A GIF has 256 colors: a few frames, drawn before, decide which.
    samples = [*map(shown.draw, shown.samples)]
    frames = map(shown.draw, track(range(shown.length), "drawing", transient=True))
    write_bytes(output, gif(frames, shown.rate, samples))
    if settings.chart is not None:
        write_bytes(settings.chart, draw_terms(takes[-1]))
        print(f"the terms of the reward in {settings.chart}")
    # ``qpos`` has a row more than there are steps: the start's.
    episode_seconds = max((len(take.qpos) - 1) * take.dt for take in takes)
    text = f"{shown.length} frames in {output}"
    if settings.seconds < episode_seconds:
        text += f": {settings.seconds:g} of {episode_seconds:g} s; "
        text += f"--seconds {episode_seconds:g} shows all"
    print(text)


def choose_run(directory: Path) -> Path:
    """Returns a directory, or of a folder of runs the one whose policies were written last.

    Raises:
      ValueError: the directory is ``RUNS``, and has no run that has policies.
    """
    if (directory / "config.json").exists():
        return directory
    policies = [x for x in directory.glob("*/policy") if (x.parent / "config.json").exists()]
    # By the time of the policies: that of a directory changes with every video in it.
    if policies:
        return max(policies, key=lambda policy: policy.stat().st_mtime).parent
    if directory == RUNS:
        raise ValueError(
            f"no run was named, and the folder {directory} has none: {command('train')} trains "
            f"one; one elsewhere is named as in {command('watch')} DIRECTORY"
        )
    return directory


def film_path(settings: WatchSettings, run: Run) -> Path:
    """Returns the film's path.

    Args:
      settings: of the film.
      run: whose policy plays.

    Raises:
      ValueError: a setting is out of range, the run has no such seed, or the film exists or cannot
        be written.
    """
    if not 0 < settings.seconds < float("inf"):
        raise ValueError(f"--seconds must be positive and finite, got {settings.seconds}")
    for name, (minimum, maximum) in _RANGES.items():
        if not minimum <= (value := getattr(settings, name)) <= maximum:
            raise ValueError(f"--{name} must be in [{minimum}, {maximum}], got {value}")
    seed = choose_seed(run, settings.seed, settings.which)
    by_default = Path(f"{run.env}.gif") if run.packaged else run.directory / f"seed-{seed}.gif"
    output = settings.output or by_default
    check_output(output, settings.overwrite, ".gif")
    return output


def untrained(player: "Player") -> "Player":
    """Returns a player whose policy has random parameters, as training begins with."""
    import jax

    from mjx_reinforce.learning import normalize
    from mjx_reinforce.learning.policy import Actor

    # Not the seed's own initial parameters, whose key depends on the settings of the run.
    params = player.policy.init(jax.random.key(player.seed))
    actor = Actor(params=params, normalizer=normalize.init(player.observation_size))
    return player._replace(actor=actor)


def simulator(env: "Environment", player: "Player", horizon: int) -> tuple[str, Any]:
    """Returns the name of a simulation and a ``playing.Simulator``: C MuJoCo's, if that can play.

    It starts at once. Ours is compiled first, which takes up to a minute; of the user's own tasks
    it says why.
    """
    from mjx_reinforce import playing

    try:
        return "C MuJoCo", playing.mujoco_simulator(env, player, horizon)
    except Exception as error:  # of what a task of the user's own asks
        if not envs.is_ours(player.env):
            warn(f"C MuJoCo cannot play this task ({explain(error)}), so JAX compiles it first")
        return "JAX", playing.simulator(env, player, horizon)


def scene(env: Any) -> Any:
    """Returns the MuJoCo model that an environment's ``qpos`` moves, with a sky.

    Raises:
      ValueError: it has none.
    """
    env = _within(env, "mj_model")
    # The file, where there is one, and not the compiled model, to which no sky can be added.
    settings = getattr(env, "settings", None)
    xml_file = getattr(env, "scene", None) or getattr(settings, "xml_file", None)
    if xml_file is not None and not hasattr(xml_file, "nbody"):  # no compiled model
        from mjx_reinforce.envs import models

        return with_sky(models.spec(xml_file))
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

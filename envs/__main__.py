"""``python -m mjx_reinforce.envs`` lists the environments, or describes one."""

import dataclasses
import inspect
import sys
from typing import TYPE_CHECKING

import numpy as np
import tyro

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.streams import say
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.envs.base import MujocoEnv


@dataclasses.dataclass(frozen=True)
class EnvsSettings:
    """List the tasks, or describe one: its sizes and its rules."""

    env: tyro.conf.Positional[str | None] = None
    """The task to describe, an id or module:Class for your own; all are listed if not given."""


def main() -> None:
    """Reads the command line, prints, and exits: 0 done, 2 bad input, 130 interrupted."""
    run_command(EnvsSettings, "envs", _print)


def _print(settings: EnvsSettings) -> None:
    """Prints what is asked for."""
    if settings.env is None:
        print("\n".join(envs.names()))
        return
    # A name that is mistyped is refused before JAX is imported, which takes seconds.
    envs.check_id(settings.env)
    from mjx_reinforce.console.jax_setup import configure_jax

    configure_jax()
    say(about_task(settings.env), sys.stdout)


def about_task(id: str) -> str:
    """Returns a page about a task, of paragraphs and lists.

    Args:
      id: of ours, or module:Class.

    Raises:
      ValueError: there is none, or it cannot be built.
    """
    env = envs.make(id)
    config = of_task(id)
    doc = inspect.cleandoc(type(env).__doc__ or "").replace("``", "`")
    # Each paragraph on one line, which ``say`` breaks at the width of the terminal.
    paragraphs = (" ".join(paragraph.split()) for paragraph in doc.split("\n\n") if paragraph)
    train = f"{command('train')} --env {id}"
    usage = f"""To train {config.num_seeds} seeds for {config.env_steps:,} env steps each:

  {train}

--minutes M sets a time in place of env steps. --help shows the defaults."""
    return "\n\n".join([id, _sizes(env), *paragraphs, *_settings(env), usage])


def _sizes(env: "MujocoEnv") -> str:
    """Returns the sizes of a task, a line each."""
    from mjx_reinforce.engine.base import observation_size

    # A class of the user's own may have none of these.
    limit = getattr(env, "max_episode_steps", None)
    threshold = getattr(env, "reward_threshold", None)
    seconds = f", of {env.dt:g} s each" if hasattr(env, "dt") else ""
    solved = "the task names no return"
    if threshold is not None:
        solved = f"at a return of {threshold:,g}"
    facts = {
        "observation": f"{observation_size(env)} numbers",
        "action": _action_in_words(env),
        "episode": f"at most {limit:,} env steps{seconds}" if limit else "give --horizon a number",
        "solved": solved,
    }
    return "\n".join(f"  {name:11}  {fact}" for name, fact in facts.items())


def _settings(env: "Environment") -> list[str]:
    """Returns the settings of a task and their values, one a line, if it has any."""
    settings = getattr(env, "settings", None)
    if not dataclasses.is_dataclass(settings):
        return []
    init_fields = dataclasses.fields(settings)
    lines = [f"  {f.name}={_as_text(getattr(settings, f.name))}" for f in init_fields if f.init]
    return ["\n".join(["Its settings, which --env-set NAME=VALUE changes:", *lines])]


def _as_text(value: object) -> str:
    """Returns the value of a setting as ``--env-set`` reads it."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _action_in_words(env: "Environment") -> str:
    """Returns how many numbers an action has and in which ranges, or how many actions there are."""
    from mjx_reinforce.engine.base import Discrete, action_space

    space = action_space(env)
    if isinstance(space, Discrete):
        return f"one of {space.num_actions}"
    # Each range once, though many entries may have it.
    bounds = np.unique(np.stack([space.low, space.high], axis=1), axis=0)
    ranges = " or ".join(f"[{low:g}, {high:g}]" for low, high in bounds)
    count = len(space.low)
    noun = "numbers" if count > 1 else "number"
    return f"{count} {noun} in {ranges}"


if __name__ == "__main__":
    main()

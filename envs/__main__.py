"""``python -m mjx_reinforce.envs`` lists the environments, or describes one."""

import dataclasses
import sys

import tyro

from mjx_reinforce import envs
from mjx_reinforce.console.streams import say
from mjx_reinforce.settings.flags import run_command


@dataclasses.dataclass(frozen=True)
class EnvsSettings:
    """List the tasks, or describe one: its sizes, its rules and its default settings."""

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
    envs.check_id(settings.env)
    from mjx_reinforce.console.jax_setup import configure_jax
    from mjx_reinforce.runs.about_task import about_task

    configure_jax()
    say(about_task(settings.env), sys.stdout)


if __name__ == "__main__":
    main()

"""Environments that are the user's own code: it runs only where the command line names it.

The files of a run may be another's, and they name a module to import.
"""

import shlex
from pathlib import Path

from mjx_reinforce import envs


def env_flag(env: str) -> str:
    """Returns what a command that goes on with a run, or plays its policies, has at its end."""
    return f" --env {shlex.quote(env)}" if ":" in env else ""


def check_named(env: str, named: str | None, directory: Path) -> None:
    """Raises ValueError if a command would import code that only a file names.

    Args:
      env: the environment, as the files of a run say.
      named: the environment, as the command line says, if it does.
      directory: of the run.
    """
    envs.check_id(env)
    if ":" in env and named != env:
        raise ValueError(
            f"{directory} was trained on {env}, and this would run that code; if you trust it, "
            f"add{env_flag(env)} to the command"
        )

"""Code of the user's own: it runs only where the command line names it.

The files of a run may be another's, and they name modules to import.
"""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjx_reinforce import envs
from mjx_reinforce.registry import check_choice, is_own

#: Settings that may name code.
CODE = ("env", "algorithm", "estimator", "policy")


def code_flags(settings: Mapping[str, Any]) -> str:
    """Returns what a command that goes on with a run, or plays its policies, has at its end.

    Args:
      settings: of the run; those that name no code, or are none of ``CODE``, are left out.
    """
    own = {name: settings[name] for name in CODE if is_own(settings.get(name, ""))}
    return "".join(f" --{name} {shlex.quote(value)}" for name, value in own.items())


def env_flag(env: str) -> str:
    """Returns ``code_flags`` of an environment alone."""
    return code_flags({"env": env})


def check_named(
    settings: Mapping[str, Any], named: Mapping[str, str | None], directory: Path
) -> None:
    """Raises ValueError if a command would import code that only a file names.

    Args:
      settings: as the files of a run say; ``CODE`` says which of them may name code.
      named: the same as the command line says, where it does.
      directory: of the run.
    """
    envs.check_id(settings["env"])
    for name in CODE:
        value = settings.get(name, "")
        if is_own(value) and named.get(name) != value:
            check_choice(name, value, {})
            how = "on" if name == "env" else f"with --{name}"
            raise ValueError(
                f"{directory} was trained {how} {value}, and this would run that code; if you "
                f"trust it, add{code_flags(settings)} to the command"
            )

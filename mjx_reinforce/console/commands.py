"""The commands of ``mjx-reinforce``, and how a user calls them."""

import shlex
import sys
from pathlib import Path

SCRIPT = "mjx-reinforce"
#: Command -> (the function that does it, what that is).
COMMANDS = {
    "train": ("mjx_reinforce.train:main", "train policies, many seeds at once"),
    "watch": (
        "mjx_reinforce.watch:main",
        "make a video of a trained policy, or of the newest run",
    ),
    "sweep": (
        "mjx_reinforce.runs.command_line:sweep",
        "train many configurations at once, and compare them",
    ),
    "report": ("mjx_reinforce.report:main", "make a page with figures of runs and sweeps"),
    "export": ("mjx_reinforce.export.__main__:main", "write a policy for NumPy, C, or ONNX"),
    "new": ("mjx_reinforce.new:main", "write the class of a task for a MuJoCo model"),
    "envs": ("mjx_reinforce.envs.__main__:main", "list the tasks, or describe one"),
}


def command(name: str) -> str:
    """Returns how to call a command, in the way in which this program was called."""
    return f"{SCRIPT} {name}" if _by_script() else f"python -m mjx_reinforce.{name}"


def typed(name: str) -> str:
    """Returns the command line of this process, whose command it is, to be typed again."""
    # With ``python -m`` the first word is the path of the module, which says which program ran.
    if not _by_script():
        return shlex.join(sys.argv)
    return f"{command(name)} {shlex.join(sys.argv[1:])}"


def _by_script() -> bool:
    """Returns whether the script took the name of the command from the command line."""
    program = Path(sys.argv[0])
    # ``python -m mjx_reinforce train`` is another way to call the script.
    return program.stem == SCRIPT or program.parts[-2:] == ("mjx_reinforce", "__main__.py")


def menu(version: str) -> str:
    """Returns what the script alone prints."""
    width = max(map(len, COMMANDS))
    lines = (f"  {SCRIPT} {name:{width}}  {line}" for name, (_, line) in COMMANDS.items())
    return (
        f"{SCRIPT} {version}: REINFORCE on MuJoCo, many seeds in one compiled program\n\n"
        + "\n".join(lines)
        + f"\n\nTo begin: {SCRIPT} train. Help for a command: {SCRIPT} COMMAND --help."
    )

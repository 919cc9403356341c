"""The run that a command is about where it names none."""

from pathlib import Path

from mjx_reinforce.console.commands import command

#: Where runs are put that name no other place, see ``files.choose_directory``.
RUNS = Path("runs")


def choose_run(directory: Path) -> Path:
    """Returns a directory, or of a folder of runs the one whose policies were written last.

    Raises:
      ValueError: the directory is ``RUNS``, and has no run that has policies.
    """
    if (directory / "config.json").exists():
        return directory
    policies = [x for x in directory.glob("*/policy") if (x.parent / "config.json").exists()]
    if policies:
        return max(policies, key=lambda policy: policy.stat().st_mtime).parent
    if directory == RUNS:
        raise ValueError(
            f"no run was named, and the folder {directory} has none: {command('train')} trains "
            f"one; one elsewhere is named as in {command('watch')} DIRECTORY"
        )
    return directory

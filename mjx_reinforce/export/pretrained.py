"""Trained policies that come with the package: a folder of NumPy files and JSON for each task.

``python -m experiments.studies.results pretrained DIR`` writes them.
"""

from pathlib import Path
from typing import Any

from mjx_reinforce.files import read_json

FOLDER = Path(__file__).parent / "trained"
PROVENANCE_FILE = "provenance.json"


def pretrained() -> dict[str, dict[str, Any]]:
    """Returns the tasks that ``load`` has a trained policy for, and where each policy comes from.

    Returns:
      By the id of the task: ``return``, the mean over ``episodes`` episodes without noise from
      starts that nothing else used; ``interval``, which covers the mean with 95 %; ``command``,
      ``git_commit``, ``machine``, ``seconds`` (of training) and ``compile_seconds``; ``env_steps``
      and ``seed`` of the policy; ``seeds``, of how many it is the best; ``horizon`` (env steps).

    Examples:
      >>> import mjx_reinforce as mr
      >>> round(mr.pretrained()["HalfCheetah-v5"]["return"]) > 9000
      True
    """
    return {path.name: provenance_of(path.name) for path in sorted(FOLDER.glob("*-v*"))}


def is_pretrained(name: str | Path) -> bool:
    """Returns whether there is a policy for a task of this id, and no folder here of this name."""
    return str(name) in {path.name for path in FOLDER.glob("*-v*")} and not Path(name).exists()


def provenance_of(name: str) -> dict[str, Any]:
    """Returns where the policy for a task comes from, as ``pretrained``."""
    return read_json(FOLDER / name / PROVENANCE_FILE)

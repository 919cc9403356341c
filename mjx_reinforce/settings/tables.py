"""The values that stand in TOML files: presets, what searches found, what was measured.

``presets.toml`` has published programs under names for the command line, ``tuned.toml`` settings
by task and budget, ``measured.toml`` the sizes of the tasks; each explains its words.
"""

from typing import Any, NamedTuple

from mjx_reinforce.settings.config import Config, read_tables

#: name -> (a line for --help, the settings).
PRESETS: dict[str, tuple[str, Config]] = {
    name: (table.pop("about"), Config(**table))
    for name, table in read_tables("presets.toml").items()
    if "about" in table
}


#: What a table says beside settings.
_NO_SETTINGS = ("task", "at_least", "minute")
_ROWS = [table for table in read_tables("tuned.toml").values() if "task" in table]


def _without_facts(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in _NO_SETTINGS}


_SMALLEST = {row["task"]: row for row in _ROWS if "at_least" not in row}
#: Environment id -> the settings that differ from those of ``groups``.
OF_TASKS: dict[str, dict[str, Any]] = {task: _without_facts(row) for task, row in _SMALLEST.items()}
#: Environment id -> from so many env steps of a seed on, what else differs.
OF_BUDGETS: dict[str, list[tuple[int, dict[str, Any]]]] = {}
for _row in _ROWS:
    if "at_least" in _row:
        OF_BUDGETS.setdefault(_row["task"], []).append((_row["at_least"], _without_facts(_row)))
#: Environment id -> the env steps of a seed that a default run trains, on a CPU and on a GPU.
MINUTES: dict[str, tuple[int, int]] = {
    task: row["minute"] for task, row in _SMALLEST.items() if "minute" in row
}


class Task(NamedTuple):
    """The sizes of a task, and what its runs are like.

    observation: O, entries of an observation
    action: A, entries of an action
    horizon: the task's time limit (env steps)
    base_memory: what a small run takes on a CPU, mostly for compiling (bytes)
    """

    observation: int
    action: int
    horizon: int
    base_memory: float


#: Environment id -> its sizes.
TASKS = {name: Task(**table["sizes"]) for name, table in read_tables("measured.toml").items()}

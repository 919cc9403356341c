"""What searches found, by task and budget; ``tuned.toml`` has it and explains its words."""

from typing import Any

from mjx_reinforce.settings.config import read_tables

#: What a table says beside settings.
_NO_SETTINGS = ("task", "at_least", "solved", "enough")
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
#: Nothing more is to be had of these in a minute than in what is said above,
SOLVED = tuple(task for task, row in _SMALLEST.items() if row.get("solved"))
#: or than in so many env steps of a seed.
ENOUGH = {task: row["enough"] for task, row in _SMALLEST.items() if "enough" in row}

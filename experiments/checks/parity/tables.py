"""Writes the tables of docs/parity.md from docs/parity.csv, the rows that were measured.

``python -m experiments.checks.parity.tables`` replaces what stands between ``<!-- vmap -->`` or
``<!-- native -->`` and ``<!-- end -->``. A task measured twice has its last rows.
"""

import functools

from experiments.checks.parity.__main__ import DTYPES
from experiments.kit.markdown import filled, table
from experiments.kit.places import DOCS
from experiments.kit.rows import read
from mjx_reinforce import envs

PAGE, RAW = DOCS / "parity.md", DOCS / "parity.csv"
HEADER = (
    "task",
    "states",
    "float64: qpos / qvel",
    "observation",
    "reward",
    "float32: qpos / qvel",
    "ends that differ",
    "starts p",
    "returns p",
)


def main() -> None:
    """Writes."""
    rows = read(RAW)
    tables = {engine: functools.partial(errors, rows, engine) for engine in ("vmap", "native")}
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")


def errors(rows: list[dict[str, str]], engine: str) -> str:
    """The table of an engine: largest errors of one env step, and p in float64 and float32."""
    last = {(row["env"], row["dtype"]): row for row in rows if row["engine"] == engine}
    tasks = [task for task in envs.names() if (task, "float32") in last]
    return table(HEADER, [line(task, *(last[task, x] for x in DTYPES)) for task in tasks])


def line(task: str, double: dict[str, str], single: dict[str, str]) -> tuple[str, ...]:
    """A task's cells, of its rows in both precisions."""
    ends = int(double["terminated_mismatches"]) + int(single["terminated_mismatches"])
    return (
        task,
        double["states"],
        moved(double),
        error(double["observation"]),
        error(double["reward"]),
        moved(single),
        str(ends),
        p_values(double, single, "reset_p_value"),
        p_values(double, single, "return_p_value"),
    )


def moved(row: dict[str, str]) -> str:
    """The errors of positions and velocities."""
    return f"{error(row['qpos'])} / {error(row['qvel'])}"


def error(number: str) -> str:
    """An error with one digit: "4e-9"."""
    x = float(number)
    return f"{x:.0f}" if x == 0 or x >= 10 else f"{x:.0e}".replace("e-0", "e-").replace("e+00", "")


def p_values(double: dict[str, str], single: dict[str, str], name: str) -> str:
    """Two p: in float64 and in float32."""
    return ", ".join(f"{float(row[name]):.2g}" for row in (double, single))


if __name__ == "__main__":
    main()

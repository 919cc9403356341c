"""metrics.jsonl: every row of metrics.csv as a JSON object on a line of its own."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.export.files import finite, write_bytes
from mjx_reinforce.runs.files import append

NAME = "metrics.jsonl"


class JsonLines:
    """Writes the rows of every seed; a number that is not finite, or was not measured, is null."""

    def __init__(self, directory: Path):
        """Writes the rows that metrics.csv has already, in place of what was there."""
        self._path = directory / NAME
        with (directory / "metrics.csv").open(encoding="utf-8", newline="") as file:
            rows = [{name: _number(x) for name, x in row.items()} for row in csv.DictReader(file)]
        write_bytes(self._path, _lines(rows))

    def write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Adds rows, or raises OSError and adds none."""
        append(self._path, _lines(rows))

    def close(self) -> None:
        """Does nothing: every line is written."""


def _lines(rows: Sequence[Mapping[str, Any]]) -> bytes:
    cells = ({name: None if x == "" else x for name, x in row.items()} for row in rows)
    return "".join(json.dumps(finite(row), allow_nan=False) + "\n" for row in cells).encode()


def _number(text: str) -> int | float | None:
    """Returns what a cell of metrics.csv says; None if it is empty."""
    if text.lstrip("-").isdigit():
        return int(text)
    return float(text) if text else None

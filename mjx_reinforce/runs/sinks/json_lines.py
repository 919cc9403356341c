"""metrics.jsonl: every row of metrics.csv as a JSON object on a line of its own."""

import csv
import json
from pathlib import Path

from mjx_reinforce.files import append, finite, write_bytes
from mjx_reinforce.training.records.rows import Cells, parse_cell

NAME = "metrics.jsonl"


class JsonLines:
    """Writes the rows of every seed; a number that is not finite, or was not measured, is null."""

    def __init__(self, directory: Path):
        """Writes the rows that metrics.csv has already, in place of what was there."""
        self._path = directory / NAME
        with (directory / "metrics.csv").open(encoding="utf-8", newline="") as file:
            written = [*csv.reader(file)]
        names = written[0]
        columns = zip(*written[1:], strict=True) if written[1:] else ([] for _ in names)
        write_bytes(self._path, _as_json_lines(dict(zip(names, columns, strict=True))))

    def write(self, rows: Cells) -> None:
        """Adds rows, or raises OSError and adds none."""
        append(self._path, _as_json_lines(rows))

    def close(self) -> None:
        """Does nothing: every line is written."""


def _as_json_lines(rows: Cells) -> bytes:
    numbers = zip(*(map(parse_cell, cells) for cells in rows.values()), strict=True)
    objects = (finite(dict(zip(rows, row, strict=True))) for row in numbers)
    return "".join(json.dumps(each, allow_nan=False) + "\n" for each in objects).encode()

"""The speed over time: docs/speed.md explains each row of docs/speed.jsonl, and it is drawn."""

import json
import re

from experiments.speed import over_time


def test_rows_are_explained_and_drawn(tmp_path):
    text = (over_time.DOCS / "speed.jsonl").read_text("utf-8")
    (tmp_path / "speed.jsonl").write_text(text, "utf-8")
    over_time.main(over_time.Settings(measure=False), tmp_path)
    assert (tmp_path / "speed.png").stat().st_size > 1000
    explained = set(
        re.findall(r"^\| `(\w+)`", (over_time.DOCS / "speed.md").read_text("utf-8"), re.M)
    )
    for line in text.splitlines():
        assert {
            name for name in json.loads(line) if name.endswith(("second", "seconds"))
        } == explained

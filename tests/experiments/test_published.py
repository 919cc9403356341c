"""docs/published.csv: every published figure says where it stands."""

import csv
import re

from places import ROOT

from mjx_reinforce import envs

PUBLISHED = ROOT / "docs" / "published.csv"


def test_published_figures_say_all_of_their_source():
    with PUBLISHED.open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    bases = {name.partition("-v")[0] for name in envs.names()}
    for row in found:
        assert row["task"] in bases
        assert re.fullmatch(r"v\d", row["version"])
        assert row["policy"] in ("on-policy", "off-policy", "policy search")
        assert re.fullmatch(r"\S+/\S+ \S+", row["source"])
        assert re.fullmatch(r"[0-9a-f]{40}", row["commit"])
        assert int(row["env_steps"]) >= 50_000
        assert int(row["seeds"]) >= 1
        float(row["mean"])
        assert (row["spread"] == "") == (row["spread_is"] == "")
        if row["spread"]:
            assert float(row["spread"]) >= 0
    keys = [
        tuple(row[k] for k in ("algorithm", "implementation", "task", "version", "env_steps"))
        for row in found
    ]
    assert len(set(keys)) == len(keys)

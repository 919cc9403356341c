"""The cells of the matrix are as docs/own_models.csv and docs/parity.md say."""

import csv
import math
import re
from fnmatch import fnmatch

import jax
import numpy as np
import pytest
from places import ROOT

from experiments.checks import matrix
from experiments.checks.mechanisms import mechanisms

ALL = list(mechanisms())
PROGRAMS = {" ".join((*each[0].title, str(len(each)))): each for each in matrix.sample()}


def written():
    """Returns the row of each mechanism under each option, by its title."""
    with (ROOT / "docs" / "own_models.csv").open(encoding="utf-8", newline="") as file:
        return {tuple(row.values())[:3]: row for row in csv.DictReader(file)}


def check(cells):
    """Checks cells against what is written: who is refused, and else the largest error."""
    _, *found = matrix.summarized(cells)
    rows = written()
    for *title, _, start, error, words in found:
        row = rows[tuple(title)]
        if row["error"] == "nan" or float(row["error"]) < matrix.EQUAL:
            assert np.isnan(float(error)) == (row["error"] == "nan"), (title, words)
            assert not float(error) >= matrix.EQUAL, (title, start, words)
            assert error != "nan" or words == row["field or refusal"]
        else:
            # What a solver leaves undone depends on how a processor rounds: on one 8 times as much.
            assert abs(math.log10(float(error) / float(row["error"]))) < 1, (title, start)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_sample_is_as_written(name):
    with jax.enable_x64(True):
        check(list(matrix.compare(PROGRAMS[name])))


def test_an_error_that_is_not_ours_is_no_refusal(monkeypatch):
    """It ends the matrix."""
    [each] = [x for x in ALL if x.title == ("features", "", "filter")]
    monkeypatch.setattr(matrix.models.mjx, "put_model", lambda *_, **__: int("not ours"))
    model = matrix.load([each])
    with pytest.raises(ValueError, match="not ours"):
        matrix.refusal(model)


def test_every_clamp_is_reached_and_is_not():
    """From some start, what is clamped moves in another way than what is not; from some, alike."""
    qvel = matrix.FIELDS.index("qvel")
    actuated = {each.name: each for each in ALL if each.title[:2] == ("actuators", "Euler")}
    for name, each in actuated.items():
        free = actuated[f"{name.rpartition(', ')[0]}, none"]
        velocity = [
            [matrix.by_c(x, start)[qvel] for x in (each, free)] for start in each.starts.values()
        ]
        assert any(np.allclose(x[0], y[0], rtol=1e-12, atol=0) for x, y in velocity), name
        reached = any(not np.allclose(x, y, rtol=1e-12, atol=0) for x, y in velocity)
        assert reached == (each is not free), name


def test_the_table_of_parity_is_that_of_the_matrix():
    """It has what differs, with the largest error, and what is refused, and nothing else."""
    text = (
        (ROOT / "docs" / "parity.md").read_text(encoding="utf-8").partition("## Your own models")[2]
    )
    table = re.findall(r"^\| (`.+?`) \| (\S+) \|", text, re.MULTILINE)
    errors = {" ".join(filter(None, title)): row["error"] for title, row in written().items()}
    left = {name for name, error in errors.items() if not float(error) < matrix.EQUAL}
    for cells, said in table:
        patterns = re.findall("`(.+?)`", cells)
        kind = {name for name in errors if (errors[name] == "nan") == (said == "refused")}
        found = {name for name in kind & left for each in patterns if fnmatch(name, each)}
        assert found, cells
        if said != "refused":
            largest = max(float(errors[name]) for name in found)
            assert float(said) == float(f"{largest:.0e}"), cells
        left -= found
    assert not left

"""The reports of docs/upstream: MJX still departs from C MuJoCo as each page says."""

import contextlib
import io
import re
from pathlib import Path

import jax
import numpy as np
import pytest

PAGES = Path(__file__).resolve().parents[3] / "docs" / "upstream"
REPORTS = sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index")


def printed_lines(text):
    """Returns what follows "C" and "MJX" in a printed text, without brackets, in words."""
    ((c, mjx),) = re.findall(r"^C +(.*)^MJX +(.*)\Z", text, re.M | re.S)
    return [re.sub(r"[\[\]]", " ", part).split() for part in (c, mjx)]


def numbers(words):
    return np.array(words, float)


@pytest.mark.slow
@pytest.mark.parametrize("name", REPORTS)
def test_departure_is_as_reported(name):
    """If MJX agrees with C by now, delete the page, and the code or the refusal that it names."""
    text = (PAGES / f"{name}.md").read_text("utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.S)
    (reported,) = re.findall(r"```text\n(.*?)```", text, re.S)
    output = io.StringIO()
    with jax.enable_x64(True), contextlib.redirect_stdout(output):
        # Inside, the program's own line changes nothing that stays.
        exec(program.replace('jax.config.update("jax_enable_x64", True)\n', ""), {})
    c, mjx = printed_lines(output.getvalue())
    reported_c, reported_mjx = printed_lines(reported)
    np.testing.assert_allclose(numbers(c), numbers(reported_c), rtol=1e-4, atol=1e-5)
    if mjx[0].endswith("Error"):
        assert mjx == reported_mjx
    else:
        np.testing.assert_allclose(numbers(mjx), numbers(reported_mjx), rtol=1e-4, atol=1e-5)
        assert np.abs(numbers(c) - numbers(mjx)).max() > 1e-5


def test_every_report_is_whole_and_in_the_list():
    index = (PAGES / "index.md").read_text("utf-8")
    assert sorted(re.findall(r"\((\w+)\.md\) \|", index)) == REPORTS
    parts = ("Versions", "Input", "Printed", "Expected", "Cause", "In this package")
    for name in REPORTS:
        text = (PAGES / f"{name}.md").read_text("utf-8")
        assert tuple(re.findall(r"^\*\*(.+?)\.\*\*", text, re.M)) == parts, name
        assert f"[{text.splitlines()[0][2:]}]({name}.md)" in index

"""What is on a page of a report, read from its file."""

import html
import json
import re
import subprocess
import sys

import numpy as np

from mjx_reinforce.reports.findings import compute_findings
from mjx_reinforce.reports.sources import read_experiment

#: Tables that are wider than their place, which cuts columns or hides them behind a scroll bar.
CUT = """[...document.querySelectorAll('.scroll, .numbers')].filter((place) =>
  !place.clientWidth || place.scrollWidth > place.clientWidth || place.innerText.length < 20
).map((place) => place.getAttribute('aria-label'))"""


def findings_of(*directories):
    return compute_findings(read_experiment(directories))


def change_curves(directory, change):
    """Changes the arrays of a sweep's curves: change(arrays) in place."""
    with np.load(directory / "curves.npz") as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(directory / "curves.npz", **arrays)
    return arrays


def content(page):
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'id="content">(.*?)</script>', text, re.S)[1])


def visible(page):
    """What the page says, without scripts and styles."""
    text = re.sub(r"<(script|style)\b.*?</\1>", " ", page.read_text(encoding="utf-8"), flags=re.S)
    text = html.unescape(re.sub(r"<[^>]+>", " ", text)).replace("\u00a0", " ")
    return " ".join(text.split())


def run_report(*arguments):
    command = [sys.executable, "-m", "mjx_reinforce.report", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)

"""What is on a page of a report, read from its file."""

import html
import json
import re
import subprocess
import sys

#: Tables that are wider than their place, which cuts columns or hides them behind a scroll bar.
CUT = """[...document.querySelectorAll('.scroll, .numbers')].filter((place) =>
  !place.clientWidth || place.scrollWidth > place.clientWidth || place.innerText.length < 20
).map((place) => place.getAttribute('aria-label'))"""


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

"""A page in headless Chromium: JavaScript runs in it, and what it returns comes back."""

import html
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

_NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--no-first-run", "--hide-scrollbars"),
    *("--disable-dev-shm-usage", "--allow-file-access-from-files", "--dump-dom"),
    "--virtual-time-budget=300000",
)
#: Before all of the page's own scripts: collects what it says on the console.
_LISTEN = """<script>var errors = [];
addEventListener('error', (event) => errors.push(event.message));
addEventListener('unhandledrejection', (event) => errors.push(String(event.reason)));
console.error = console.warn = (...words) => errors.push(words.join(' '));</script>"""
#: After them: waits until the page says that it is ready, and hands on what a script returns.
_RUN = """<script>(async () => {
const until = async (truth) => {
  for (let tries = 0; !truth(); tries++) {
    if (tries > 300) throw Error('never: ' + truth);
    await new Promise((done) => setTimeout(done, 50));
  }
};
const resize = async (width) => {
  frameElement.style.width = width + 'px';
  await until(() => innerWidth === width);
  await new Promise((done) => setTimeout(done, 200));
};
let said = null;
try {
  await until(() => document.documentElement.dataset.ready === 'yes');
  said = await (async () => { SCRIPT })();
} catch (error) { errors.push(String(error)); }
const requests = performance.getEntriesByType('resource').map((x) => x.name);
parent.document.body.textContent = JSON.stringify({said, errors, requests});
})()</script>"""


def in_browser(page, script, width=1280):
    """Returns what JavaScript returns on a page of so many pixels, which may ask for nothing.

    It may await ``until(() => truth)`` and ``resize(width)``.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        text = page.read_text("utf-8").replace("<head>", f"<head>{_LISTEN}", 1)
        Path(folder, "page.html").write_text(text + _RUN.replace("SCRIPT", script), "utf-8")
        style = f"width: {width}px; height: 900px; border: 0"
        frame = Path(folder, "frame.html")
        frame.write_text(f'<body><iframe src="page.html" style="{style}"></iframe></body>')
        command = [CHROMIUM, *_FLAGS, f"--user-data-dir={folder}/profile", frame.as_uri()]
        done = subprocess.run(command, capture_output=True, check=True, text=True, timeout=120)
    found = json.loads(html.unescape(re.search("<body>(.*)</body>", done.stdout, re.S)[1]))
    assert found["errors"] == []
    outside = [x for x in found["requests"] if not x.startswith(("file:", "data:", "blob:"))]
    assert outside == []
    return found["said"]

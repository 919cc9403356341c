"""A page in headless Chromium, through the DevTools protocol over a pipe: no driver is needed."""

import base64
import contextlib
import io
import json
import os
import select
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

_NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--no-first-run", "--hide-scrollbars"),
    *("--remote-debugging-pipe", "--disable-dev-shm-usage"),
)
_SECONDS = 60


class Browser:
    """One page; ``errors`` collects what it says on the console, and every request it makes."""

    def __init__(self, profile):
        reading, self._write = os.pipe()
        self._read, writing = os.pipe()
        # Chromium reads from 3 and writes to 4. A shell puts the pipes there: Python would have to
        # fork for it, and JAX may not be forked.
        chromium = shlex.join([CHROMIUM, *_FLAGS, f"--user-data-dir={profile}", "about:blank"])
        command = ["bash", "-c", f"exec {chromium} 3<&{reading} 4>&{writing}"]
        self._process = subprocess.Popen(
            command, pass_fds=(reading, writing), stderr=subprocess.DEVNULL
        )
        os.close(reading)
        os.close(writing)
        self._buffer, self._number, self._session = b"", 0, None
        self.errors, self.requests = [], []
        found = self._wait_for_page()
        attached = self.call("Target.attachToTarget", targetId=found, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def _wait_for_page(self):
        until = time.monotonic() + _SECONDS
        while time.monotonic() < until:
            targets = self.call("Target.getTargets")["targetInfos"]
            pages = [target["targetId"] for target in targets if target["type"] == "page"]
            if pages:
                return pages[0]
            time.sleep(0.1)
        raise TimeoutError("Chromium opened no page")

    def call(self, method, **params):
        """Returns the answer to a command, and takes note of events on the way."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                return answer["result"]
            self._note(answer)

    def _receive(self):
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], _SECONDS)[0]:
                raise TimeoutError("Chromium does not answer")
            part = os.read(self._read, 2**20)
            if not part:
                raise RuntimeError("Chromium has ended")
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, event):
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.errors.append(" ".join(str(a.get("value", a)) for a in params["args"]))
        elif method == "Log.entryAdded":
            self.errors.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"][:200])

    def run(self, script):
        """Returns the value of JavaScript, awaited."""
        result = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"])
        return result["result"].get("value")

    def open(self, path, width=1280, height=900, dark=False):
        """Opens a file at a width in CSS pixels, and waits until the page says that it is ready."""
        self.resize(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait_for("document.documentElement?.dataset.ready === 'yes'")

    def resize(self, width, height=900):
        """Gives the page a width in CSS pixels; below 600 it is on a phone."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    def wait_for(self, condition):
        """Waits until JavaScript is true."""
        until = time.monotonic() + _SECONDS
        while time.monotonic() < until:
            if self.run(condition):
                return
            time.sleep(0.1)
        raise TimeoutError(f"never: {condition}; {self.errors}")

    def press(self, key, code=None):
        """Presses a key of the keyboard."""
        keys = {"Tab": 9, "ArrowLeft": 37, "ArrowRight": 39, "Home": 36, " ": 32}
        common = {"key": key, "code": code or key, "windowsVirtualKeyCode": keys[key]}
        text = {"text": " "} if key == " " else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **common, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **common)

    def hover(self, selector, until):
        """Moves the mouse in the middle of an element until JavaScript is true.

        A chart that is still being drawn misses the first move.
        """
        x, y = self.run(
            "(() => { document.documentElement.style.scrollBehavior = 'auto';"
            f"const found = document.querySelector('{selector}');"
            "found.scrollIntoView({block: 'center'}); const r = found.getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        end = time.monotonic() + _SECONDS
        while not self.run(until):
            if time.monotonic() > end:
                raise TimeoutError(f"never: {until}; {self.errors}")
            for at in (x - 2, x):
                self.call("Input.dispatchMouseEvent", type="mouseMoved", x=at, y=y)
            time.sleep(0.1)

    def screenshot(self, *, whole=False, clip=None):
        """Returns a PNG of what is seen, or of the whole page."""
        options = {"format": "png", "captureBeyondViewport": whole}
        if whole:
            size = self.call("Page.getLayoutMetrics")["cssContentSize"]
            options["clip"] = {**size, "scale": 1}
        if clip:
            options["clip"] = {**clip, "scale": 1}
        return base64.b64decode(self.call("Page.captureScreenshot", **options)["data"])

    def print(self):
        """Returns the page as it would be printed, a PDF file."""
        done = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=False)
        return base64.b64decode(done["data"])

    def close(self):
        """Ends Chromium."""
        with contextlib.suppress(OSError, RuntimeError, TimeoutError):
            self._session = None
            self.call("Browser.close")
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)
        os.close(self._write)


@contextlib.contextmanager
def opened_browser():
    """Starts Chromium with a fresh profile, and ends it."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(profile)
        try:
            yield browser
        finally:
            browser.close()


def picture(image, height):
    """Returns the top of a picture as a small PNG file."""
    content = io.BytesIO()
    with Image.open(io.BytesIO(image)) as whole:
        top = whole.crop((0, 0, whole.width, min(height, whole.height)))
        # By coverage: a curve's colour is that of few points among much white and grey.
        few = top.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(content, "png", optimize=True)
    return content.getvalue()


if __name__ == "__main__":  # python tests/helpers/browser.py PAGE PREFIX: the pictures in docs/
    page, prefix = Path(sys.argv[1]), sys.argv[2]
    with opened_browser() as browser:
        for name, width, height in (("", 1100, 2600), ("_phone", 390, 2600)):
            browser.open(page, width=width)
            shot = picture(browser.screenshot(whole=True), height)
            Path(f"{prefix}{name}.png").write_bytes(shot)
        print(browser.errors or "no error on the console")

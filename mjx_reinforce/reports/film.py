"""The film on a run's page, which ``mjx_reinforce.watch`` makes."""

import base64
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

#: So long is waited for a film (s); a humanoid takes a minute to compile on few cores.
_TIMEOUT = 600
#: Length (s) and size (pixels) of the film: the page holds it, so that it has to be small.
_FORM = ("--seconds", "8", "--width", "360", "--height", "270")


class PageFilm(NamedTuple):
    """A film for the page: what is seen in it, and the GIF as a data URL; or why there is none."""

    said: str
    url: str = ""


def film_of_median(run: Path, output: Path) -> PageFilm:
    """Films the seed of a run whose last return is the median, and returns the film.

    Args:
      run: the directory of a run with saved policies.
      output: the .gif file, which is replaced.
    """
    command = [sys.executable, "-m", "mjx_reinforce.watch", str(run), "--seed", "median"]
    command += [*_FORM, "--output", str(output), "--overwrite"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return PageFilm(f"There is no film: it was not ready after {_TIMEOUT} s.")
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"watch exited with {done.returncode}"]
        return PageFilm(f"There is no film: {lines[-1].removeprefix('error: ')}.")
    encoded = base64.b64encode(output.read_bytes()).decode()
    return PageFilm(done.stdout.splitlines()[0], f"data:image/gif;base64,{encoded}")

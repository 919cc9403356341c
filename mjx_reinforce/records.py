"""The files of a run, each written whole or not at all."""

import contextlib
import csv
import datetime
import io
import json
import os
import platform
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = ("mjx-reinforce", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "optax", "flax")


def prepare(output: Path | None, env: str, overwrite: bool) -> Path:
    """Makes the run directory.

    Args:
      output: where, or None for ``runs/<env>-<time>``.
      env: the environment's id.
      overwrite: accept a directory that is not empty.

    Raises:
      ValueError: it exists and is not empty, is no directory, or cannot be written.
    """
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")[:-3]
    directory = Path("runs") / f"{env.replace(':', '.')}-{stamp}" if output is None else output
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()) and not overwrite:
            raise ValueError(
                f"the run directory {directory} is not empty; choose another --output, "
                "or pass --overwrite to replace the run in it"
            )
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ValueError(
            f"cannot write to the run directory {directory} ({error.strerror}); "
            "choose another --output"
        ) from error
    return directory


def write_bytes(path: Path, content: bytes) -> None:
    """Replaces a file at once: a reader, or a crash, sees the old one or the new one."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Writes JSON; numbers that are not finite become null, which JSON has."""
    text = json.dumps(_finite(value), indent=2, default=str, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows under the names of the first one; the others have the same names."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())


def provenance() -> dict[str, Any]:
    """Returns what a result depends on besides its settings."""
    import jax

    return {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "git_commit": _git_commit(),
        "device": str(jax.devices()[0].device_kind),
        "num_devices": jax.device_count(),
        "cpu_count": os.cpu_count(),
        "x64": jax.numpy.zeros(()).dtype == "float64",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def _version(package: str) -> str | None:
    with contextlib.suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def _git_commit() -> str | None:
    """Returns the commit this package runs from, or None outside a checkout."""
    here = Path(__file__).parent
    command = ["git", "-C", str(here), "rev-parse", "HEAD"]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        tracked = subprocess.run(
            ["git", "-C", str(here), "ls-files", "--error-unmatch", Path(__file__).name],
            capture_output=True,
        )
        if tracked.returncode == 0:
            done = subprocess.run(command, capture_output=True, check=True, text=True)
            return done.stdout.strip()
    return None


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not (-float("inf") < value < float("inf")):
        return None
    return value

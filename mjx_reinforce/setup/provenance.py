"""What a result depends on besides its settings: versions, the commit, the device."""

import contextlib
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

_PACKAGES = ("mjx-reinforce", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "optax", "flax")


def provenance() -> dict[str, Any]:
    """Returns what a result depends on besides its settings."""
    import jax

    from mjx_reinforce.engine.play import available
    from mjx_reinforce.settings.defaults import num_cores

    return {
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "git_commit": _git_commit(),
        "device": str(jax.local_devices()[0].device_kind),
        **available.known_by(),
        "num_devices": jax.device_count(),
        "cpu_count": os.cpu_count(),
        # Among so many threads XLA divides sums on a CPU, which decides their rounding.
        "cores": num_cores() if available.platform() == "cpu" else None,
        "x64": jax.numpy.zeros(()).dtype == "float64",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def version(package: str) -> str | None:
    """Returns the version of an installed package, None if it is not installed."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def _git_commit() -> str | None:
    """Returns the last commit that changed this package, or None outside a checkout.

    A commit of documents or tests changes no result, and a run goes on after it.
    """
    package = Path(__file__).parent.parent
    # In a checkout the environments are a link to a folder beside the package: git follows none.
    folders = [str(package), str((package / "envs").resolve())]
    command = ["git", "-C", str(package), "log", "-1", "--format=%H", "--", *folders]
    # There may be no git; and where the package is installed, no repository, or one that is not
    # ours and has no commit of these files: then the output is empty.
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        log = subprocess.run(command, capture_output=True, check=True, text=True)
        return log.stdout.strip() or None
    return None

"""Whether machine code can play here."""

import sys

import jax

from mjx_reinforce.engines.native.cpu import machine
from mjx_reinforce.engines.native.gpu import seam as gpu

#: LLVM 20, which llvmlite 0.45 has, is the first that reads the IR as it is written here.
_OLDEST = (20,)
#: JAX's generator whose noise it draws; `rollout` looks at the keys that it gets.
GENERATOR = "threefry2x32"


def platform() -> str:
    """Returns what JAX computes on: "cpu", "gpu" or another name."""
    return jax.default_backend()


def made_for() -> str:
    """Returns what machine code is made by, and for which machine; or why there is none here."""
    reason = unavailable()
    if reason:
        return reason
    import llvmlite

    made_for = gpu.this_machine() if platform() == "gpu" else machine.this_machine()
    return f"{llvmlite.__version__} {made_for}"


def unavailable() -> str | None:
    """Returns why JAX cannot run machine code of ours here, None if it can."""
    if platform() not in ("cpu", "gpu"):
        return f"it runs on CPUs and NVIDIA GPUs, this is JAX on a {platform()}"
    if sys.platform == "win32":
        return "it was never tried on Windows"
    if sys.maxsize < 2**32 or sys.byteorder != "little":
        return "it needs a little-endian machine of 64 bits"
    try:
        import llvmlite.binding
    except (ImportError, OSError) as error:
        return f"llvmlite cannot be loaded: {error}; pip install 'llvmlite>=0.45'"
    if llvmlite.binding.llvm_version_info < _OLDEST:
        return f"llvmlite {llvmlite.__version__} is too old; pip install 'llvmlite>=0.45'"
    generator = jax.config.values["jax_default_prng_impl"]
    if generator != GENERATOR:
        return f"it draws noise as {GENERATOR} does, not as {generator}"
    if not jax.config.values["jax_threefry_partitionable"]:
        return "it draws noise as JAX does with jax_threefry_partitionable"
    return gpu.unavailable() if platform() == "gpu" else None

"""Whether machine code can play here, and what its numbers depend on."""

import hashlib
import platform as host
import sys
from typing import Any

import jax

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.gpu import seam as gpu

#: LLVM 20, which llvmlite 0.45 has, is the first that reads the IR as it is written here.
_MIN_LLVM = (20,)
#: JAX's generator whose noise it draws; ``rollout`` looks at the keys that it gets.
GENERATOR = "threefry2x32"
#: Settings of JAX that change numbers.
_JAX_SETTINGS = (
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_disable_most_optimizations",
    "jax_numpy_dtype_promotion",
)


def platform() -> str:
    """Returns what JAX computes on: "cpu", "gpu" or another name."""
    return jax.default_backend()


def made_for() -> str:
    """Returns what machine code is made by, and for which machine; or why there is none here."""
    if reason := unavailable():
        return reason
    import llvmlite

    target = gpu.kernel_dependencies() if platform() == "gpu" else machine.this_machine()
    return f"{llvmlite.__version__} {target}"


def known_by() -> dict[str, Any]:
    """Returns what decides how this machine rounds, in a few words each.

    XLA compiles for the CPU that is here; native code may be made for an older one.
    """
    if reason := unavailable():
        code = reason
    elif platform() == "gpu":
        code = made_for()
    else:
        code = f"llvmlite {made_for().partition(' ')[0]}, {_short(machine.this_machine())}"
    # A GPU's numbers do not depend on the CPU beside it: such a run may move to another host.
    cpu = _host_cpu() if platform() == "cpu" else None
    settings = {name: str(jax.config.values[name]) for name in _JAX_SETTINGS}
    return {"cpu": cpu, "machine_code": code, "jax_settings": settings}


def _host_cpu() -> str:
    """Returns the CPU that XLA compiles for."""
    try:
        return _short(machine.this_machine(machine.HOST))
    except (ImportError, OSError):  # no llvmlite
        return host.processor() or host.machine()


def _short(target: machine.Machine) -> str:
    """Returns a machine's name, with a hash of its many features."""
    digest = hashlib.sha256(target.features.encode()).hexdigest()[:8]
    return f"{target.cpu}, {target.lanes} lanes, features {digest}"


def check_variables() -> None:
    """Raises ValueError for an environment variable of ours whose value means nothing here.

    Made into a reason against machine code, it would have another engine play, without a word.
    """
    objects.is_described()
    machine.asked_level()
    if platform() == "cpu" and not unavailable():
        machine.this_machine()


def unavailable() -> str | None:
    """Returns why JAX cannot run machine code of ours here, None if it can."""
    if platform() not in ("cpu", "gpu"):
        return f"it runs on CPUs and NVIDIA GPUs, this is JAX on a {platform()}"
    if sys.platform == "win32":
        return "it was never tried on Windows"
    if sys.maxsize < 2**32 or sys.byteorder != "little":
        return "it needs a little-endian machine of 64 bits"
    # A damaged or foreign build raises OSError when its library is loaded, not ImportError.
    try:
        import llvmlite.binding
    except (ImportError, OSError) as error:
        return f"llvmlite cannot be loaded: {error}; pip install 'llvmlite>=0.45'"
    if llvmlite.binding.llvm_version_info < _MIN_LLVM:
        return f"llvmlite {llvmlite.__version__} is too old; pip install 'llvmlite>=0.45'"
    # The kernels write Threefry out themselves, so no other generator has the noise that ``vmap``
    # draws; nor has Threefry itself, where it is not partitionable.
    generator = jax.config.values["jax_default_prng_impl"]
    if generator != GENERATOR:
        return f"it draws noise as {GENERATOR} does, not as {generator}"
    if not jax.config.values["jax_threefry_partitionable"]:
        return "it draws noise as JAX does with jax_threefry_partitionable"
    if platform() == "gpu":
        return gpu.kernels_unavailable()
    return None

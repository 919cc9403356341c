"""How this program's commands set up JAX."""

import os
from pathlib import Path

#: Settings of JAX's that the commands cannot work with, and why.
_REFUSED = {
    "JAX_ENABLE_X64": "the commands compute in float32",
    "JAX_DISABLE_JIT": "the commands compile before they begin",
}


def configure_jax() -> None:
    """Turns on exact float32 products and the compilation cache, unless the user chose.

    Raises:
      ValueError: JAX finds no device, such as where JAX_PLATFORMS names one that is not here, or is
        set to what the commands cannot work with.
    """
    import jax

    for name, what in _REFUSED.items():
        if jax.config.values[name.lower()]:
            raise ValueError(f"{name} is set, but {what}; unset it")
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(cache) / "mjx_reinforce"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if settings["jax_default_matmul_precision"] is None:
        jax.config.update("jax_default_matmul_precision", "highest")
    try:
        jax.devices()
    except RuntimeError as error:
        raise ValueError(f"JAX cannot compute here: {error}") from error

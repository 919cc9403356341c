"""How this program's commands set up JAX."""

import os
from pathlib import Path


def configure_jax() -> None:
    """Turns on exact float32 products and the compilation cache, unless the user chose."""
    import jax

    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(cache) / "mjx_reinforce"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if settings["jax_default_matmul_precision"] is None:
        jax.config.update("jax_default_matmul_precision", "highest")

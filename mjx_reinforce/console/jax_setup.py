"""How this program's commands set up JAX."""

import functools
import os
import sys
from pathlib import Path

from mjx_reinforce.engine.objects import distrust, make_folder

#: Settings of JAX's that the commands cannot work with, and why.
_REFUSED = {
    "JAX_ENABLE_X64": "the commands compute in float32",
    "JAX_DISABLE_JIT": "the commands compile before they begin",
    "JAX_TRANSFER_GUARD": "the commands move numbers between Python and the device",
}
#: Values of these with which the commands can work.
_HARMLESS = (False, None, "allow", "log", "log_explicit")


def configure_jax() -> None:
    """Turns on exact float32 products and the compilation cache, unless the user chose.

    Products that name a precision have that one, such as those of ``value_network``.

    Raises:
      ValueError: JAX finds no device, such as where JAX_PLATFORMS names one that is not here, or is
        set to what the commands cannot work with.
    """
    import jax

    settings = jax.config.values
    for name, reason in _REFUSED.items():
        if settings[name.lower()] not in _HARMLESS:
            raise ValueError(f"{name} is set, but {reason}; unset it")
    if settings["jax_enable_compilation_cache"]:
        _choose_cache()
    if settings["jax_default_matmul_precision"] is None:
        jax.config.update("jax_default_matmul_precision", "highest")
    # JAX looks for devices when it is first asked, which would else be deep in a program.
    try:
        jax.devices()
    except RuntimeError as error:
        raise ValueError(f"JAX cannot compute here: {error}") from error
    # That is what JAX raises for a platform that it knows and has no plugin for.
    except AssertionError as error:
        raise ValueError(
            f"JAX cannot compute here: JAX_PLATFORMS is {settings['jax_platforms']!r}, for which "
            "no plugin is installed; install JAX for it (pip install 'jax[cuda12]'), or unset it"
        ) from error


def _choose_cache() -> None:
    """Chooses where programs are kept, unless the user did.

    A folder that cannot be used, or in which others may write, keeps none: what is in it is run.
    """
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    variable = "JAX_COMPILATION_CACHE_DIR"
    cache_folder = jax.config.values["jax_compilation_cache_dir"]
    if cache_folder is None:
        variable = "XDG_CACHE_HOME"
        cache = os.environ.get(variable) or os.path.expanduser("~/.cache")
        cache_folder = os.path.join(cache, "mjx_reinforce")
        # JAX keeps by default what took a second or more; a run has many programs that take less.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # A cache with :// is a bucket in a cloud, of which no folder is checked.
    if cache_folder and "://" not in cache_folder and (obstacle := _unusable(Path(cache_folder))):
        warn(
            f"the cache {cache_folder} is not used ({obstacle}), so the next start compiles again; "
            f"set {variable} to a folder of your own"
        )
        cache_folder = None
        # A module of the user's may have compiled before this, and so have opened the cache.
        compilation_cache.reset_cache()
    elif cache_folder and "://" not in cache_folder and not os.access(cache_folder, os.W_OK):
        warn(
            f"nothing can be kept in the cache {cache_folder} (it cannot be written), so the next "
            f"start compiles again what is not there; set {variable} to a folder of your own"
        )
    jax.config.update("jax_compilation_cache_dir", cache_folder)


def _unusable(folder: Path) -> str | None:
    """Returns why programs cannot be kept in a folder, which is made, None if they can."""
    if folder.parts[0] == "~":
        return "there is no home"
    try:
        make_folder(folder)
    except OSError as error:
        return f"{type(error).__name__}: {error.strerror}"
    return distrust(folder)


@functools.cache
def warn(text: str) -> None:
    """Says something once."""
    print(f"warning: {text}", file=sys.stderr)

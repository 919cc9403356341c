"""How long programs take to compile here, for a line that says so before they do."""

import contextlib
import hashlib
import json
from collections.abc import Iterable

import jax

from mjx_reinforce.engine.cache import Cache
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import num_cores

#: What decides how long they take, of the settings.
_SETTINGS = ("env", "env_set", "algorithm", "engine", "hidden_sizes", "estimator", "update")
#: Of most of the package's tasks, on two CPU cores and on a GPU, roughly.
_TYPICAL_TIME = "usually 5 to 40 s on a quiet machine"


def describe_compiling(config: Config, swept: Iterable[str] = ()) -> str:
    """Returns a sentence on how long the programs of some settings will take.

    Args:
      config: the settings.
      swept: the names of the settings of a sweep that it goes over.
    """
    cache = Cache.find()
    if cache is None:
        return f"compiling, {_TYPICAL_TIME}; nothing is kept here, so the next start compiles again"
    # Nothing is there before the first time, and what is there may be damaged.
    with contextlib.suppress(ValueError, TypeError):
        seconds = float(json.loads(cache.read(_key(config, swept)) or b"null"))
        return f"compiling, about {max(seconds, 1.0):.0f} s the last time"
    return f"compiling, {_TYPICAL_TIME}, less where the programs are on disk"


def keep_seconds(config: Config, swept: Iterable[str], seconds: float) -> None:
    """Keeps how long that took (s), for ``describe_compiling``."""
    if (cache := Cache.find()) is not None:
        cache.write(_key(config, swept), json.dumps(seconds).encode())


def _key(config: Config, swept: Iterable[str]) -> str:
    """Returns the name under which the time is kept, on this machine."""
    machine = [jax.local_devices()[0].device_kind, num_cores()]
    description = repr([machine, *(getattr(config, name) for name in _SETTINGS), sorted(swept)])
    return f"{hashlib.sha256(description.encode()).hexdigest()}-seconds"

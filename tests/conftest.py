"""Shared settings of the tests: what they compile is kept, and nothing is optimised for speed."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

# Before JAX is imported, which reads them once. The workers of pytest-xdist and the command lines
# that tests run inherit them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true",
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    cache = tempfile.mkdtemp(prefix="mjx-reinforce-tests-")
    atexit.register(shutil.rmtree, cache, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = cache

import jax

sys.path.insert(0, str(Path(__file__).parent))

jax.config.update("jax_default_matmul_precision", "highest")


def pytest_collection_modifyitems(items):
    """What takes longest comes first, so that no worker is left alone with it at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)

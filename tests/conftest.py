"""Shared settings of the tests: what they compile is kept, and nothing is optimized for speed.

They run on the CPU unless JAX_PLATFORMS names something else.
"""

import os
import sys
from importlib.metadata import version
from pathlib import Path

# Before JAX is imported, which reads them once. The workers of pytest-xdist and the command lines
# that tests run inherit them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    # The workers share the cores: a program compiled in parts takes longer in all.
    + " --xla_cpu_parallel_codegen_split_count=1"
    # On a GPU a program compiled again may else round otherwise.
    + " --xla_gpu_deterministic_ops=true"
    # JAX 0.10's older emitters of fusions compile twice as fast; its users have the newer ones.
    + " --xla_cpu_use_fusion_emitters=false" * version("jaxlib").startswith("0.10."),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# All workers share what they compile, and the next run finds it.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "programs")
)

import jax
import pytest
from command_lines import added_environments, run_command
from places import WITHOUT_WARP

# Where Playground has installed Warp, MJX imports it, which takes longer than all else that it
# imports. Processes that tests start do without. The workers inherit the path, and do not.
_PATHS = [x for x in os.environ.get("PYTHONPATH", "").split(os.pathsep) if x]
os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys([str(WITHOUT_WARP), *_PATHS]))
sys.path[:] = [x for x in sys.path if x != str(WITHOUT_WARP)]
jax.config.update("jax_default_matmul_precision", "highest")


def pytest_collection_modifyitems(items):
    """Puts slow tests first, so that no worker ends with one; skips those of CPUs elsewhere."""
    for item in items:
        if item.get_closest_marker("cpu") and jax.default_backend() != "cpu":
            item.add_marker(pytest.mark.skip(reason="it is for CPUs"))
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture
def register():
    """Adds an environment for the test, or replaces one: a name, and a class or function."""
    with added_environments() as register:
        yield register


@pytest.fixture
def run(register, tmp_path):
    """Runs a command line, that of ``train`` unless told, in an empty folder: its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        patch.chdir(tmp_path)
        yield run_command

"""Shared settings of the tests: what they compile is kept, and nothing is optimised for speed.

They run on the CPU unless JAX_PLATFORMS names something else.
"""

import argparse
import atexit
import os
import shutil
import tempfile
import zlib
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
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    cache = tempfile.mkdtemp(prefix="mjx-reinforce-tests-")
    atexit.register(shutil.rmtree, cache, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = cache

import jax
import pytest
from command_lines import added_environments, run_command
from verify import verify

from mjx_reinforce.fused import scalarized

SLOW = Path(__file__).with_name("slow.txt")
_STALE = pytest.StashKey[list[str]]()

scalarized.inspect = verify
jax.config.update("jax_default_matmul_precision", "highest")


def _share(words):
    shares, _, text = words.partition(":")
    if not (shares.isdecimal() and int(shares)):
        raise argparse.ArgumentTypeError(f"must be K:TEXT, with K 1 or more, got {words!r}")
    return int(shares), text


def pytest_addoption(parser):
    parser.addoption(
        "--slow-share",
        type=_share,
        default=(1, ""),
        metavar="K:TEXT",
        help="of the slow tests, run one in K; TEXT says which, by chance but always the same",
    )


def pytest_collection_modifyitems(config, items):
    """Marks what slow.txt lists, and puts it first, so that no worker ends with a slow test."""
    slow = {line for line in SLOW.read_text().splitlines() if not line.startswith("#")}
    found = set()
    for item in items:
        case = f"{item.path.name}::{item.name}"
        if lines := slow & {case, case.partition("[")[0]}:
            item.add_marker("slow")
            found |= lines
        if item.get_closest_marker("cpu") and jax.default_backend() != "cpu":
            item.add_marker(pytest.mark.skip(reason="it is for CPUs"))
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
    _deselect(config, items)
    whole = not (any("::" in each for each in config.args) or config.getoption("lf", False))
    collected = {item.path.name for item in items} if whole else set()
    config.stash[_STALE] = _stale(slow - found, collected)


def _deselect(config, items):
    """Takes those slow tests away that are of another share."""
    shares, text = config.getoption("slow_share")

    def left_out(item):
        drawn = zlib.crc32(f"{text} {item.nodeid}".encode()) % shares == 0
        return item.get_closest_marker("slow") and not drawn

    config.hook.pytest_deselected(items=[item for item in items if left_out(item)])
    items[:] = [item for item in items if not left_out(item)]


@pytest.fixture
def stale_lines(request):
    """The lines of slow.txt that name no file, or nothing in a file that was collected whole."""
    return request.config.stash[_STALE]


def _stale(lines, collected):
    """Returns those of some lines whose file is among the collected ones, or is not there."""
    files = {line: line.partition("::")[0] for line in lines}
    there = {path.name for path in SLOW.parent.rglob("test_*.py")}
    return sorted(line for line, file in files.items() if file in collected or file not in there)


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

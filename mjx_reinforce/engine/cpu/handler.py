"""The way from XLA to the kernel, in LLVM IR: a handler of XLA's FFI, and the threads of a job.

The kernel defines ``@work(ptr %job)``. All threads of a job call it once; it fetches items by
adding 1 to ``next``, atomically, until that is ``total`` or more. Item k is episode
k % ``episodes`` of seed k / ``episodes``. All results are zero when it starts, unless it writes
each entry itself; arrays are aligned to 16 bytes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from mjx_reinforce.engine.llvm.text import Text

_HANDLER = Path(__file__).with_name("handler.ll")
#: What every handler begins with.
_ENTRY = Path(__file__).with_name("entry.ll")
#: The functions to be called from outside; tests call others.
SYMBOLS = ("handler",)
#: The fields of a job, %Job.
JOB = (
    "refs",  # i64: who may still look at the job; the last one frees it
    "running",  # i64: threads of the pool that work
    "next",  # i64: the item to be fetched next
    "total",  # i64: items
    "episodes",  # i64: episodes of each seed, N
    "horizon",  # i64: steps of an episode at most, T
    "data",  # ptr to ptr: the arguments' data, then the results'
    "bytes",  # ptr to i64: the size of each result
    "chunks",  # i64: parts in which the results are set to zero
    "chunk",  # i64: the part to be set to zero next
    "filled",  # i64: parts that are zero
)
_POINTERS = ("data", "bytes")
#: The arguments and results that mean something here.
LIMITS, THREADS, KEYS = range(3)
REWARD = 2
SIMULATED = 5


class Positions(NamedTuple):
    """Where a call's sizes are read from.

    threads: the argument [*B] that says how many threads there are at most
    items: the argument [*B, N, ...] of two axes behind B that says how many items a seed has
    steps: the result [*B, T, ...] of two axes behind B that says how many steps an item has
    """

    threads: int
    items: int
    steps: int


#: Of a rollout, whose items are episodes.
EPISODES = Positions(THREADS, KEYS, REWARD)
#: Bytes from the start of a struct to a member, in xla/ffi/api/c_api.h of major version 0.
OFFSETS = {
    f"{struct}.{member.split()[0]}": int(member.split()[1])
    for struct, members in (
        ("XLA_FFI_CallFrame", "extension_start 8, api 16, ctx 24, args.size 56, args.args 72"),
        ("XLA_FFI_CallFrame", "rets.size 96, rets.rets 112, attrs.attrs 160"),
        ("XLA_FFI_Buffer", "data 24, rank 32, dims 40"),
        ("XLA_FFI_Scalar", "value 8"),
        ("XLA_FFI_Metadata_Extension", "extension_base.type 8, metadata 24"),
        ("XLA_FFI_Metadata", "api_version.major_version 24, api_version.minor_version 28"),
        ("XLA_FFI_Metadata", "traits 32"),
        ("XLA_FFI_Api", "api_version.minor_version 36, XLA_FFI_Error_Create 48"),
        ("XLA_FFI_Api", "XLA_FFI_Error_Destroy 64, XLA_FFI_Stream_Get 80"),
        ("XLA_FFI_Api", "XLA_FFI_ThreadPool_Schedule 136, XLA_FFI_ThreadPool_NumThreads 144"),
    )
    for member in members.split(", ")
}


def handler_text(
    num_args: int,
    result_bytes: Sequence[int],
    lanes: int = 1,
    positions: Positions = EPISODES,
    is_zeroed: bool = True,
) -> str:
    """Returns the IR of all but ``@work``; it defines %Job.

    ``@handler`` is what XLA calls. It opens a job by ``@open``, which any number of threads
    ``@share``, and ends it by ``@close`` when these have returned.

    Args:
      num_args: the number of arguments: limits [*B, N] int32 (of ``episode.signed_limits``),
      threads [*B] int32 (at most so many, 0 for all), keys [*B, N, 2] uint32, and the kernel's.
      result_bytes: the bytes of an element of each result: observation [*B, T, N, O],
      action [*B, T, N, A], reward [*B, T, N (1 + K)] with its K terms behind each, length [*B, N],
      broken [*B, N], simulated [*B] int32.
      lanes: the items that a thread plays at once; fewer are not worth a thread.
      positions: where other arguments and results than these have their sizes.
      is_zeroed: whether results are zero when ``@work`` begins.
    """
    num_results = len(result_bytes)
    # A job is one piece of memory: its fields, the buffers' addresses, the results' sizes.
    job_bytes = 8 * len(JOB)
    data_bytes = 8 * (num_args + num_results)
    sizes_bytes = 8 * num_results
    values: dict[str, Any] = {field: f"i32 0, i32 {number}" for number, field in enumerate(JOB)}
    values |= {
        "job": ", ".join("ptr" if field in _POINTERS else "i64" for field in JOB),
        "num_args": num_args,
        "num_results": num_results,
        "num_buffers": num_args + num_results,
        "element_bytes": ", ".join(f"i64 {size}" for size in result_bytes),
        "job_bytes": job_bytes,
        "data_bytes": data_bytes,
        "sizes_bytes": sizes_bytes,
        "fixed_bytes": job_bytes + data_bytes + sizes_bytes,
        "lanes": lanes,
        "lanes_less_1": lanes - 1,
        "threads_arg": positions.threads,
        "items_arg": positions.items,
        "steps_ret": positions.steps,
        "zeroed": int(is_zeroed),
    }
    return with_entry(_HANDLER, values)


def with_entry(file: Path, values: Mapping[str, Any]) -> str:
    """Returns the IR of a handler, of a file that defines ``@execute``."""
    offsets = {name.replace(".", "_"): offset for name, offset in OFFSETS.items()}
    text = _ENTRY.read_text("utf-8") + file.read_text("utf-8")
    return Template(text).substitute(offsets | dict(values))


class JobText:
    """Writes a function that has ``ptr %job`` among its arguments."""

    def __init__(self, text: Text):
        self.text = text

    def field(self, name: str) -> str:
        """Returns the pointer to a field of the job."""
        number = JOB.index(name)
        return self.text.let(f"getelementptr inbounds %Job, ptr %job, i32 0, i32 {number}")

    def job(self, name: str, kind: str) -> str:
        """Returns the value of a field of the job."""
        return self.text.let(f"load {kind}, ptr {self.field(name)}")

    def element(self, pointers: str, number: int) -> str:
        """Returns one of several pointers, such as those to the job's data."""
        address = self.text.let(f"getelementptr inbounds ptr, ptr {pointers}, i64 {number}")
        return self.text.let(f"load ptr, ptr {address}")


#: The architectures of which it is known how.
_FLUSHES = ("x86_64", "aarch64")


def flush(triple: str) -> str:
    """Returns the IR of ``@flush``, by which numbers too small for full precision count as zero.

    XLA's own threads do so too. All threads of a job do the same, so that an episode is the same on
    any of them. ``@unflush`` undoes it, with what ``@flush`` returned.
    """
    # macOS calls this architecture arm64 in its triples, LLVM and Linux aarch64.
    architecture = triple.partition("-")[0].replace("arm64", "aarch64")
    if architecture not in _FLUSHES:
        architecture = "unknown"
    return Path(__file__).with_name(f"flush_{architecture}.ll").read_text("utf-8")

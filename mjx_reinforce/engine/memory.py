"""How much memory and how many cores this machine has, and bytes in words; without JAX."""

import os
from pathlib import Path


def host_memory() -> float:
    """Returns the bytes of main memory that this process may use."""
    memory = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    # A container may use less than the machine has; "max" is no limit.
    limit_file = Path("/sys/fs/cgroup/memory.max")
    if not limit_file.is_file():
        return memory
    limit = limit_file.read_text(encoding="ascii").strip()
    if limit == "max":
        return memory
    return min(memory, float(limit))


def gigabytes(size: float) -> str:
    """Returns a number of bytes for people: in GB, or where that is nearly none, in MB."""
    if size < 5e7:
        return f"{max(1, round(size / 1e6))} MB"
    decimals = 1 if size < 1e10 else 0
    return f"{size / 1e9:,.{decimals}f} GB"


def num_cores() -> int:
    """Returns how many CPU cores this process may use."""
    # A container or taskset allows fewer than there are; macOS cannot say.
    affinity = getattr(os, "sched_getaffinity", None)
    if affinity:
        return len(affinity(0))
    return os.cpu_count() or 1

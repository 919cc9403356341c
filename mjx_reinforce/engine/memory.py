"""How much memory this machine has, and bytes in words. JAX is not imported."""

import os
from pathlib import Path


def host_memory() -> float:
    """Returns the bytes of main memory that this process may use."""
    memory = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    limit = Path("/sys/fs/cgroup/memory.max")  # of a container
    text = limit.read_text(encoding="ascii").strip() if limit.is_file() else "max"
    return memory if text == "max" else min(memory, float(text))


def gigabytes(size: float) -> str:
    """Returns a number of bytes for people: in GB, or where that is nearly none, in MB."""
    if size < 5e7:
        return f"{max(1, round(size / 1e6))} MB"
    return f"{size / 1e9:,.1f} GB" if size < 1e10 else f"{size / 1e9:,.0f} GB"

"""Whether programs fit into memory: what XLA says of them once compiled, before they run."""

import jax

from mjx_reinforce.engine.memory import gigabytes, host_memory


def memory_here() -> float:
    """Returns the memory that a device has for arrays (bytes); on a CPU it is the host's."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return host_memory()
    return float((device.memory_stats() or {}).get("bytes_limit", float("inf")))


def check_room(needed: float) -> None:
    """Raises ValueError if so many bytes are not there."""
    if needed > (here := memory_here()):
        raise ValueError(
            f"this does not fit into memory: it needs about {gigabytes(needed)}, "
            f"{gigabytes(here)} are here; lower --num-seeds (of a sweep --chunk-runs), "
            "--num-episodes, --eval-episodes, --hidden-sizes or --horizon"
        )


def check_fits(program: jax.stages.Compiled) -> None:
    """Raises ValueError if a program's arrays need more memory than there is."""
    if (found := program.memory_analysis()) is not None:
        arrays = found.argument_size_in_bytes + found.output_size_in_bytes
        check_room(arrays + found.temp_size_in_bytes - found.alias_size_in_bytes)

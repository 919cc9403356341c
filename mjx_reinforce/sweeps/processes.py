"""The processes of a sweep on several hosts: each trains chunks of its own with its own devices."""

import dataclasses
from typing import NamedTuple


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessSettings:
    """Several hosts, one process each, and a directory that all of them see."""

    distributed: bool = False
    """Start the same command on every host. SLURM, Open MPI and Kubernetes say by themselves who is
    who; elsewhere give the three settings below."""
    coordinator: str | None = None
    """HOST:PORT of the first process."""
    num_processes: int | None = None
    """How many processes there are."""
    process_id: int | None = None
    """Which one this is, from 0."""


class Processes(NamedTuple):
    """Which process this is, of how many."""

    index: int = 0
    count: int = 1

    def meet(self, name: str) -> None:
        """Waits until all processes are at the place of that name."""
        if self.count > 1:
            from jax.experimental import multihost_utils

            multihost_utils.sync_global_devices(name)


def check_processes(settings: ProcessSettings) -> None:
    """Raises ValueError for settings that do not go together."""
    by_hand = (settings.coordinator, settings.num_processes, settings.process_id)
    given = [x is not None for x in by_hand]
    if any(given) and not settings.distributed:
        raise ValueError(
            "--coordinator, --num-processes and --process-id are of --distributed: add it"
        )
    if any(given) and not all(given):
        raise ValueError("give --coordinator, --num-processes and --process-id together")
    index, count = settings.process_id or 0, settings.num_processes or 1
    if not 0 <= index < count:
        raise ValueError(f"--process-id must lie in [0, {count}), got {index}")


def join_processes(settings: ProcessSettings) -> Processes:
    """Waits for the other processes, if there are to be any; the first use of JAX.

    Raises:
      ValueError: they cannot be found.
    """
    if not settings.distributed:
        return Processes()
    import jax

    try:
        jax.distributed.initialize(
            settings.coordinator, settings.num_processes, settings.process_id
        )
    except (ValueError, RuntimeError) as error:
        raise ValueError(
            f"cannot find the other processes ({error}); give --coordinator HOST:PORT, "
            "--num-processes and --process-id"
        ) from error
    return Processes(jax.process_index(), jax.process_count())

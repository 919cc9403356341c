"""The processes of a run on several hosts.

Each computes alone, with its own devices: JAX knows of no other process. What they have to say to
each other goes through process 0, to which all others are connected (``links``). One that dies ends
the others at once.
"""

import contextlib
import dataclasses
import itertools
import json
import os
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mjx_reinforce.console.heartbeat import heartbeat, to_screen
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.hosts.links import (
    BYE,
    DATA,
    DIED,
    GREETING,
    STOP,
    Link,
    address,
    greeting,
    listener,
    send,
)

#: Seconds to wait for processes that have not come yet, and between two tries.
_PATIENCE, _PAUSE = 300.0, 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessSettings:
    """Several hosts with a process each: it trains a part of the seeds, on all GPUs it sees."""

    distributed: bool = False
    """Start the same command on every host. SLURM, Open MPI and Kubernetes say by themselves who is
    who; elsewhere give the three settings below. If one process dies, the others say so and end."""
    coordinator: str | None = None
    """HOST:PORT of the first process, which listens there for the others."""
    num_processes: int | None = None
    """How many processes there are."""
    process_id: int | None = None
    """Which one this is, from 0."""


class Processes:
    """Which process this is, of how many, and what it says to the others."""

    def __init__(self, index: int = 0, names: Sequence[str] = ("process 0",)):
        """Takes the number of this process, and the names of all; links come later."""
        self.index, self.count = index, len(names)
        self.names = list(names)
        self.links: dict[int, Link] = {}

    def tell(self, *contents: bytes) -> None:
        """Sends one message to every process that is connected, or to each its own."""
        links = [link for _, link in sorted(self.links.items())]
        each = contents if len(contents) == len(links) else contents * len(links)
        for link, content in zip(links, each, strict=True):
            link.send(DATA, content)

    def hear(self) -> list[bytes] | None:
        """Waits for a message of every process that is connected; None where one left."""
        heard = [link.receive() for _, link in sorted(self.links.items())]
        return None if None in heard else [content for content in heard if content is not None]

    def meet(self) -> bool:
        """Waits until all processes are here; returns False where one left before."""
        if self.index:
            self.tell(b"")
            return self.hear() is not None
        met = self.hear() is not None
        if met and self.links:
            self.tell(b"")
        return met

    def shares(self, num_seeds: int) -> list[slice]:
        """Returns the seeds of each process: all have the same number of them, or one more.

        Raises:
          ValueError: there are more processes than seeds.
        """
        if num_seeds < self.count:
            raise ValueError(
                f"--num-seeds {num_seeds} is less than the {self.count} processes; each trains one "
                "at least"
            )
        ends = [i * num_seeds // self.count for i in range(self.count + 1)]
        return [slice(*pair) for pair in itertools.pairwise(ends)]

    def share(self, num_seeds: int) -> slice:
        """Returns the seeds of this process, see ``shares``."""
        return self.shares(num_seeds)[self.index]

    def stop(self, number: int) -> None:
        """Asks all others to stop, as that signal does."""
        for link in self.links.values():
            link.send(STOP, bytes([number]))

    def close(self) -> None:
        """Takes leave, so that the others do not end."""
        for link in self.links.values():
            link.send(BYE)

    def connect(self, index: int, connection: socket.socket, interrupt: Interrupt) -> Link:
        """Keeps the connection to a process, and begins to read it."""

        def heard(kind: bytes, content: bytes) -> None:
            others = [link for other, link in self.links.items() if other != index]
            if kind == STOP:
                for link in others:
                    link.send(STOP, content)
                interrupt.ask(content[0])
            elif kind == DIED:
                name = content.decode() or self.names[index]
                for link in others:
                    link.send(DIED, name.encode())
                interrupt.leave(1, lambda: print(_gone(name), file=sys.stderr, flush=True))

        self.links[index] = link = Link(connection, heard)
        link.listen()
        return link


def _gone(name: str) -> str:
    """Returns what is said where a process died."""
    return (
        f"error: {name} is gone (its own output may say why), so this process ends too; start all "
        "again, with --resume if files were begun"
    )


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
    if settings.coordinator is not None:
        address(settings.coordinator)


@contextlib.contextmanager
def joined(
    settings: ProcessSettings, interrupt: Interrupt | None, common: Mapping[str, Any]
) -> Iterator[Processes]:
    """Waits for the other processes, if there are to be any, and takes leave of them at the end.

    A block that raises, ``SystemExit`` too, ends the others as a death does.

    Args:
      settings: who is who.
      interrupt: what listens to signals.
      common: what all processes must have in common, in JSON's types.

    Raises:
      ValueError: they cannot be found, or do not belong together.
    """
    if not settings.distributed:
        yield Processes()
        return
    assert interrupt is not None
    coordinator, count, index = _who(settings)
    hello = {"index": index, "count": count, "common": dict(common)}
    hello["name"] = f"process {index} (host {socket.gethostname()}, pid {os.getpid()})"
    with heartbeat(to_screen, None, "waiting for the other processes"):
        if index == 0:
            processes = _gather(coordinator, hello, interrupt)
        else:
            processes = _follow(coordinator, hello, interrupt)
    to_screen(f"{hello['name']}: all {count} are here")
    yield processes
    processes.close()


def _who(settings: ProcessSettings) -> tuple[str, int, int]:
    """Returns the coordinator, how many processes there are, and the number of this one.

    Under SLURM and Open MPI this process takes the GPU of its number on the host, as those do that
    call ``jax.distributed.initialize``.
    """
    if settings.coordinator is not None:
        return settings.coordinator, settings.num_processes or 1, settings.process_id or 0
    import jax
    from jax._src import clusters  # what jax.distributed.initialize asks; no public equivalent

    ask = clusters.ClusterEnv.auto_detect_unset_distributed_params
    remedy = "give --coordinator HOST:PORT, --num-processes and --process-id"
    try:
        coordinator, count, index, local = ask(None, None, None, None, None, int(_PATIENCE))
    except (RuntimeError, ValueError, KeyError, ImportError) as error:
        raise ValueError(f"cannot find the other processes ({error}); {remedy}") from error
    if coordinator is None or count is None or index is None:
        raise ValueError(
            f"cannot find the other processes: none of SLURM, Open MPI and Kubernetes says who is "
            f"who; {remedy}"
        )
    if local:
        jax.config.update("jax_cuda_visible_devices", ",".join(map(str, local)))
    return coordinator, count, index


def _gather(coordinator: str, hello: dict[str, Any], interrupt: Interrupt) -> Processes:
    """Waits for all others, as process 0."""
    count = hello["count"]
    names = [hello["name"], *(f"process {i}" for i in range(1, count))]
    processes, until = Processes(0, names), time.monotonic() + _PATIENCE
    with listener(coordinator) as listening:
        while len(processes.links) < count - 1:
            listening.settimeout(max(until - time.monotonic(), 0.01))
            try:
                connection, _ = listening.accept()
            except TimeoutError:
                missing = sorted(set(range(1, count)) - processes.links.keys())
                raise ValueError(
                    f"process {', '.join(map(str, missing))} of {count} did not come to "
                    f"{coordinator} within {_PATIENCE:.0f} s; start the same command on every host"
                ) from None
            came = greeting(connection)
            if came is None:  # a stranger
                connection.close()
                continue
            _check_greeting(came, hello, processes)
            processes.names[came["index"]] = came["name"]
            processes.connect(came["index"], connection, interrupt)
    processes.tell(json.dumps(processes.names).encode())
    return processes


def _check_greeting(came: dict[str, Any], ours: dict[str, Any], processes: Processes) -> None:
    """Raises ValueError if a process does not belong to the others."""
    same = "start the same command on every host, with the same versions"
    if came["count"] != ours["count"]:
        raise ValueError(
            f"{came['name']} is one of {came['count']}, and this of {ours['count']}; {same}"
        )
    if came["index"] not in range(1, ours["count"]) or came["index"] in processes.links:
        raise ValueError(f"there are two processes {came['index']}: {came['name']}; {same}")
    theirs, here = came["common"], json.loads(json.dumps(ours["common"]))
    for name in here:
        if theirs.get(name) != here[name]:
            raise ValueError(
                f"{name} is {theirs.get(name)} in {came['name']}, and {here[name]} in process 0; "
                f"{same}"
            )


def _follow(coordinator: str, hello: dict[str, Any], interrupt: Interrupt) -> Processes:
    """Finds process 0, as one of the others."""
    place, until = address(coordinator), time.monotonic() + _PATIENCE
    while True:
        try:
            connection = socket.create_connection(place, timeout=GREETING)
            send(connection, DATA, json.dumps(hello).encode())
            break
        except OSError as error:
            if time.monotonic() > until:
                raise ValueError(
                    f"process 0 did not answer at {coordinator} within {_PATIENCE:.0f} s "
                    f"({error.strerror or error}); start the same command on every host"
                ) from error
            time.sleep(_PAUSE)
    names = [f"process {i}" for i in range(hello["count"])]
    names[0] += f" (at {coordinator})"
    processes = Processes(hello["index"], names)
    known = processes.connect(0, connection, interrupt).receive()
    if known is not None:
        processes.names = json.loads(known)
    return processes

"""What comes before a run is compiled: what is refused, its directory, and what it is made of."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import heartbeat
from mjx_reinforce.runs.directory import own_directory
from mjx_reinforce.runs.plan import check_memory, make_plan
from mjx_reinforce.runs.sinks import check_installed
from mjx_reinforce.settings.config import MAX_COUNT, Config, check
from mjx_reinforce.training import resume

if TYPE_CHECKING:
    from mjx_reinforce.store.ready import Ready
    from mjx_reinforce.training.checkpoint import Checkpoint


class Begun(NamedTuple):
    """A run before it is compiled.

    config: its settings
    directory: where its files go, if anywhere
    ready: what it is made of
    found: the checkpoint from which it goes on, if any
    plan: a paragraph for people
    """

    config: Config
    directory: Path | None
    ready: "Ready"
    found: "Checkpoint | None"
    plan: str


@contextlib.contextmanager
def begun(
    config: Config,
    default: Config,
    interrupt: Interrupt,
    say: Callable[[str], None],
    *,
    files: bool = True,
) -> Iterator[Begun]:
    """Begins a run, and keeps its directory from other processes while the block runs.

    Args:
      config: its settings.
      default: those that hold where the user gave none.
      interrupt: what listens to signals.
      say: shows a line to the user.
      files: whether it has a directory, whose name may be left to us.

    Raises:
      ValueError: a setting makes no sense here, or the run cannot go on.
    """
    check(config)
    check_memory(config)
    check_installed(config)
    with contextlib.ExitStack() as held:
        directory = None
        if files:
            directory = held.enter_context(own_directory(config, config.resume, interrupt))
        # A module of the user's is imported before JAX starts, which it may set up.
        env = None if envs.is_ours(config.env) else envs.make_set(config.env, config.env_set)
        configure_jax()
        with heartbeat(say, "writing the simulation out"):
            from mjx_reinforce.store.ready import get_ready

            ready = get_ready(config, default, env)
            found = None if config.resume is None else _find(config, config.resume, ready, say)
        if config.init_from is not None and found is None:
            from mjx_reinforce.training.state import last_actors

            last_actors(config, ready.policy)  # refused before anything is compiled
        yield Begun(config, directory, ready, found, make_plan(ready, config))


def _find(
    config: Config, directory: Path, ready: "Ready", say: Callable[[str], None]
) -> "Checkpoint | None":
    """Returns the checkpoint from which a run in its directory goes on, if there is one.

    Raises:
      ValueError: the run cannot go on here.
    """
    from mjx_reinforce.store.provenance import provenance
    from mjx_reinforce.training.state import shape_of_all

    resume.check_same_program(directory, resume.read_record(directory), provenance())
    like = shape_of_all(ready.programs.like, config.num_seeds)
    if config.minutes is not None:  # more than any checkpoint has used
        config = dataclasses.replace(config, env_steps=MAX_COUNT)
    found = resume.newest_checkpoint(like, config, say)
    if found is None and config.minutes is not None:
        raise ValueError(
            f"{directory} has no checkpoint to go on from for {config.minutes:g} min; leave "
            "--minutes out to train it again, or start another run"
        )
    return found

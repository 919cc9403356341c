"""A run or a sweep from its design to its files: what the commands and Python have in common."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import heartbeat
from mjx_reinforce.runs.design import Design, check_design
from mjx_reinforce.runs.directory import own_directory
from mjx_reinforce.training.resume import read_record

if TYPE_CHECKING:
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.training.driver import Observer, Training


class Outcome(NamedTuple):
    """What came of a run or a sweep.

    directory: of its files, None where none were asked for
    summary: what summary.json or sweep.json says
    driver: of the runs that were trained last; None where nothing was left to do
    policy: how to rebuild a run's policy, see ``policy_files.build_policy``
    display: its screen
    """

    directory: Path | None
    summary: dict[str, Any]
    driver: "Training | None"
    policy: dict[str, Any]
    display: "Display"


def perform(
    design: Design,
    interrupt: Interrupt,
    observers: "Sequence[Observer]" = (),
    *,
    files: bool = True,
    quiet: bool = False,
) -> Outcome:
    """Trains a run or a sweep, or goes on with it, to the budget, a signal, or past hope.

    Args:
      design: of it.
      interrupt: what listens to signals.
      observers: who sees it, besides its files and the screen.
      files: whether it has a directory, whose name may be left to us.
      quiet: show no progress.

    Raises:
      ValueError: the design makes no sense here, or it cannot go on.
      OSError: the first or the last files cannot be written.
    """
    check_design(design)
    with contextlib.ExitStack() as held:
        directory, resumed = design.directory if files else None, design.resume is not None
        if directory is not None:
            held.enter_context(own_directory(directory, interrupt, resumed=resumed))
        known = read_record(design.directory) if resumed else {}
        if known.get("status") == "finished":  # of a sweep
            return Outcome(directory, known, None, {}, _display(quiet=quiet))
        # A module of the user's is imported before JAX starts, which it may set up.
        first = design.configs[0]
        env = None if envs.is_ours(first.env) else envs.make_set(first.env, first.env_set)
        configure_jax()
        from mjx_reinforce.runs.conduct import Conductor
        from mjx_reinforce.runs.plan import describe, prepare
        from mjx_reinforce.runs.saving import RunFiles, SweepFiles

        display = _display(quiet=quiet)
        with heartbeat(display.say, "writing the simulation out"):
            prepared = prepare(design, known, env, display.say)
        display.say(describe(prepared))
        with display:
            interrupt.restore_screen(display.console.show_cursor)
            kind = SweepFiles if design.over else RunFiles
            written = None if directory is None else kind(directory, prepared, display.say)
            conductor = Conductor(prepared, written, display, observers)
            with display.compiling():
                conductor.compile_first()
            # Not before: a kill while it compiles leaves nothing that would refuse the next.
            interrupt.defer(display.say)
            driver, summary = conductor.conduct(interrupt.heard)
        return Outcome(directory, summary, driver, prepared.parts[0].ready.policy, display)


def _display(*, quiet: bool) -> "Display":
    """Returns a screen; what draws it is imported late."""
    from mjx_reinforce.runs.display import Display

    return Display(quiet=quiet)

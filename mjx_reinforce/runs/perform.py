"""A run or a sweep from its design to its files: what the commands and Python have in common."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import heartbeat
from mjx_reinforce.runs.design import Design, check_design, configure
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
    compiled: Callable[[], object] = lambda: None,
) -> Outcome:
    """Trains a run or a sweep, or goes on with it, to the budget, a signal, or past hope.

    Args:
      design: of it.
      interrupt: what listens to signals.
      observers: who sees it, besides its files and the screen.
      files: whether it has a directory, whose name may be left to us.
      quiet: show no progress.
      compiled: called once what comes first is compiled.

    Raises:
      ValueError: the design makes no sense here, or it cannot go on.
      OSError: the first or the last files cannot be written.
    """
    check_design(design)
    with contextlib.ExitStack() as held:
        directory, base = None, design.base
        if files:
            directory = held.enter_context(own_directory(base, design.resume, interrupt))
        # A module of the user's is imported before JAX starts, which it may set up.
        first = configure(base, design.configurations())[0]
        env = None if envs.is_ours(first.env) else envs.make_set(first.env, first.env_set)
        configure_jax()
        from mjx_reinforce.runs.conduct import Conductor
        from mjx_reinforce.runs.display import Display
        from mjx_reinforce.runs.plan import describe, prepare
        from mjx_reinforce.runs.run_files import RunFiles
        from mjx_reinforce.runs.sweep_files import SweepFiles

        display = Display(quiet=quiet)
        known = {} if design.resume is None else read_record(design.resume, design.first_file)
        if known.get("status") == "finished":  # of a sweep
            return Outcome(directory, known, None, {}, display)
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
            compiled()
            # Not before: a kill while it compiles leaves nothing that would refuse the next.
            interrupt.defer(display.say)
            driver, summary = conductor.conduct(interrupt.heard)
        return Outcome(directory, summary, driver, prepared.parts[0].ready.policy, display)

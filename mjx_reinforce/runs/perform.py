"""A run or a sweep from its design to its files: what the commands and Python have in common.

Its directory is made, tried and locked before anything heavy is imported.
"""

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

try:
    import fcntl
except ImportError as error:
    raise ImportError(
        "training and reports need Linux or macOS; on Windows, install mjx_reinforce in WSL 2 "
        "(wsl --install)"
    ) from error

from mjx_reinforce import envs
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.files import check_place
from mjx_reinforce.runs.design import Design, check_design
from mjx_reinforce.training.resume import read_record

if TYPE_CHECKING:
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.training.driver import Driver, Observer

#: What a kill leaves of the first file of a run or a sweep, which then was not begun.
_FIRST = (".config.json.", ".sweep.json.")
#: What the system says where no room is left, on the disk or of what this user may have of it.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: A disk with less room (bytes) is full: the files of a small run take about as much.
_ROOM = 2**20


def _make(directory: Path) -> None:
    """Makes the directory of a run, or raises OSError; ValueError if it is in that of another."""
    if (outer := _run_around(directory)) is not None:
        raise ValueError(
            f"the run directory {directory} would be inside the run {outer}; choose another "
            "--output"
        )
    if directory.is_symlink():
        directory.stat()  # says why it leads nowhere
    directory.mkdir(parents=True, exist_ok=True)


def _check_unbegun(directory: Path) -> None:
    """Raises ValueError if anything was begun in a directory."""
    # Where a run was killed as it wrote its first file, nothing was.
    if any(not path.name.startswith(_FIRST) for path in directory.iterdir()):
        raise ValueError(
            f"the run directory {directory} is not empty; choose another --output, or delete it"
        )


def _run_around(directory: Path) -> Path | None:
    """Returns the run or sweep that a directory is in, if any."""
    for parent in Path(os.path.realpath(directory)).parents:
        run = (parent / "config.json").exists() and (parent / "metrics.csv").exists()
        if run or (parent / "sweep.json").exists():
            return parent
    return None


def _try_to_write(directory: Path) -> None:
    """Writes a file that is gone at once, or raises OSError."""
    with tempfile.TemporaryFile(dir=directory) as file:
        file.write(bytes(_ROOM))


def remove_empty(folders: Sequence[Path]) -> None:
    """Removes those folders, the innermost first, that have nothing in them."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


@contextlib.contextmanager
def own_directory(
    directory: Path, interrupt: Interrupt, *, resumed: bool
) -> Iterator[os.stat_result]:
    """Makes the directory of a run or sweep, and keeps other processes out of it.

    Folders that were made and stay empty are removed at the end.

    Args:
      directory: of it.
      interrupt: also removes them.
      resumed: whether it goes on there.

    Yields:
      What tells the directory from another in its place, see ``files.check_place``.

    Raises:
      ValueError: it is not empty, is in that of another run, cannot be written, or is another
        process's.
    """
    made: list[Path] = []
    with contextlib.ExitStack() as held:
        try:
            made = [folder for folder in (directory, *directory.parents) if not folder.exists()]
            if not resumed:
                _make(directory)
            _try_to_write(directory)
            held.enter_context(locked(directory))  # a folder in which another trains stays
            if not resumed:
                _check_unbegun(directory)  # not before: another may have been quicker
            place = directory.stat()
        except OSError as error:
            remove_empty(made)
            full = error.errno in _FULL
            remedy = "make room there" if full else "make it a folder that you may write to"
            remedy += "" if resumed else ", or choose another --output"
            raise ValueError(
                f"cannot write to the run directory {directory} ({error.strerror}); {remedy}"
            ) from error
        interrupt.on_exit(lambda: remove_empty(made))
        try:
            yield place
        finally:
            remove_empty(made)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps other processes from training in a directory; also ends with the process.

    Raises:
      ValueError: another one does.
    """
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another process trains in {directory}; wait for its end, or choose another "
                "--output"
            ) from error
        yield
    finally:
        os.close(descriptor)


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
    driver: "Driver | None"
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
      ImportError: a library is broken, or finds no memory.
      OSError: the first or the last files cannot be written.
    """
    check_design(design)
    with contextlib.ExitStack() as held:
        directory, resumed = design.directory if files else None, design.base.resume is not None
        place = None
        if directory is not None:
            place = held.enter_context(own_directory(directory, interrupt, resumed=resumed))
        known = read_record(design.directory) if resumed else {}
        if known.get("status") == "finished":  # of a sweep
            return Outcome(directory, known, None, {}, _display(quiet=quiet))
        # A module of the user's is imported before JAX starts, which it may set up.
        first = design.configs[0]
        env = None if envs.is_ours(first.env) else envs.make_set(first.env, first.env_set)
        try:
            configure_jax()
            from mjx_reinforce.envs.instability import instability
            from mjx_reinforce.runs.conduct import conduct
            from mjx_reinforce.runs.plan import describe, make_plan
            from mjx_reinforce.runs.saving import RunFiles, SweepFiles
            from mjx_reinforce.setup.compile_times import describe_compiling
        except MemoryError as error:
            raise ImportError(f"no memory is left {error}".strip()) from error

        display = _display(quiet=quiet)
        interrupt.restore_screen(display.console.show_cursor)
        if (model := getattr(env, "mj_model", None)) is not None:
            display.warn_of_model(instability(model))
        with display.console.status("writing the simulation out"):
            plan = make_plan(design, known, env, display.say)
        display.say(describe(plan))
        display.say(describe_compiling(first, design.over))
        with display:
            kind = SweepFiles if design.over else RunFiles
            written = None
            if directory is not None and place is not None:
                check_place(directory, place)  # writing the simulation out took its time
                written = kind(directory, plan, display.say)
            driver, summary = conduct(plan, written, display, observers, interrupt)
        return Outcome(directory, summary, driver, plan.parts[0].ready.policy, display)


def _display(*, quiet: bool) -> "Display":
    """Returns a screen; what draws it is imported late."""
    from mjx_reinforce.runs.display import Display

    return Display(quiet=quiet)

"""A run or a sweep from its design to its files: what the commands and Python have in common.

Its directory is made, tried and locked before anything heavy is imported.
"""

import contextlib
import os
import shlex
import tempfile
from collections.abc import Iterator, Mapping, Sequence
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
from mjx_reinforce.console.commands import command
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.engine.cpu import emit
from mjx_reinforce.files import FULL_ERRORS, check_place
from mjx_reinforce.runs.design import Design, check_design
from mjx_reinforce.settings.config import code_flags
from mjx_reinforce.training.resume import read_record

if TYPE_CHECKING:
    from mjx_reinforce.report import WrittenReport
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.training.driver import Driver, Observer

#: What a kill leaves of the first file of a run or a sweep, which then was not begun.
_FIRST_PREFIXES = (".config.json.", ".sweep.json.")
#: A disk with less room (bytes) is full: the files of a small run take about as much.
_MIN_FREE_BYTES = 2**20


def _make(directory: Path) -> None:
    """Makes the directory of a run, or raises OSError; ValueError if it is in that of another."""
    # Removing the outer run would remove this one, too.
    if (outer_run := _run_around(directory)) is not None:
        raise ValueError(
            f"the run directory {directory} would be inside the run {outer_run}; choose another "
            "--output"
        )
    if directory.is_symlink():
        directory.stat()  # says why it leads nowhere
    directory.mkdir(parents=True, exist_ok=True)


def _check_unbegun(directory: Path) -> None:
    """Raises ValueError if anything was begun in a directory."""
    # Where a run was killed as it wrote its first file, nothing was.
    if any(not path.name.startswith(_FIRST_PREFIXES) for path in directory.iterdir()):
        raise ValueError(
            f"the run directory {directory} is not empty; choose another --output, or delete it"
        )


def _run_around(directory: Path) -> Path | None:
    """Returns the run or sweep that a directory is in, if any."""
    # The real path: a symbolic link may lead into a run.
    for parent in Path(os.path.realpath(directory)).parents:
        # Other programs have a config.json, too; a run of this one has both.
        is_run = (parent / "config.json").exists() and (parent / "metrics.csv").exists()
        if is_run or (parent / "sweep.json").exists():
            return parent
    return None


def _try_to_write(directory: Path) -> None:
    """Writes a file that is gone at once, or raises OSError."""
    with tempfile.TemporaryFile(dir=directory) as trial_file:
        trial_file.write(bytes(_MIN_FREE_BYTES))


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
    new_folders: list[Path] = []
    with contextlib.ExitStack() as stack:
        try:
            # The innermost comes first, as ``remove_empty`` needs it.
            locked_folders = (directory, *directory.parents)
            new_folders = [folder for folder in locked_folders if not folder.exists()]
            if not resumed:
                _make(directory)
            _try_to_write(directory)
            # Before anything is removed below: a folder in which another process trains stays.
            stack.enter_context(locked(directory))
            # Under the lock: another process may have begun here a moment ago.
            if not resumed:
                _check_unbegun(directory)
            directory_stat = directory.stat()
        except OSError as error:
            remove_empty(new_folders)
            remedy = "make it a folder that you may write to"
            if error.errno in FULL_ERRORS:
                remedy = "make room there"
            if not resumed:
                remedy += ", or choose another --output"
            raise ValueError(
                f"cannot write to the run directory {directory} ({error.strerror}); {remedy}"
            ) from error
        # A signal that ends the process runs no ``finally``.
        interrupt.on_exit(lambda: remove_empty(new_folders))
        interrupt.on_exit(lambda: emit.end_processes(seconds=1))
        try:
            yield directory_stat
        finally:
            remove_empty(new_folders)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps other processes from training in a directory; also ends with the process.

    Raises:
      ValueError: another one does.
    """
    # On the folder itself, so that no lock file is among those of the run.
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

    design: what was to be done
    directory: of its files, None where none were asked for
    summary: what summary.json or sweep.json says
    driver: of the runs that were trained last; None where nothing was left to do
    policy: how to rebuild a run's policy, see ``policy_files.build_policy``
    display: its screen
    """

    design: Design
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
    with contextlib.ExitStack() as stack:
        directory = None
        directory_stat = None
        resumed = design.base.resume is not None
        if files:
            directory = design.directory
            directory_stat = stack.enter_context(
                own_directory(directory, interrupt, resumed=resumed)
            )
        # Under the lock: the process that trains there would change it.
        saved_record = read_record(design.directory) if resumed else {}
        # Only sweep.json has a status: a finished run goes on with a larger budget.
        if saved_record.get("status") == "finished":
            return Outcome(design, directory, saved_record, None, {}, _display(quiet=quiet))
        # A module of the user's is imported before JAX starts, which it may set up.
        first_config = design.configs[0]
        env = None
        if not envs.is_ours(first_config.env):
            env = envs.make_set(first_config.env, first_config.env_set)
        # These imports load JAX and MJX, for seconds: bad input was refused before.
        try:
            configure_jax()
            from mjx_reinforce.envs.instability import instability
            from mjx_reinforce.runs.compile_times import describe_compiling
            from mjx_reinforce.runs.conduct import conduct
            from mjx_reinforce.runs.plan import describe, make_plan
            from mjx_reinforce.runs.saving import RunFiles
            from mjx_reinforce.runs.sweep_saving import SweepFiles
        except MemoryError as error:
            raise ImportError(f"no memory is left {error}".strip()) from error

        display = _display(quiet=quiet)
        interrupt.restore_screen(display.console.show_cursor)
        if (model := getattr(env, "mj_model", None)) is not None:
            display.warn_of_model(instability(model))
        with display.console.status("writing the simulation out"):
            plan = make_plan(design, saved_record, env, display.say)
        display.say(describe(plan))
        display.say(describe_compiling(first_config, design.over))
        with display:
            own_files = None
            if directory is not None and directory_stat is not None:
                # Writing the simulation out took its time, in which the folder may have been moved.
                check_place(directory, directory_stat)
                files_class = SweepFiles if design.is_sweep else RunFiles
                own_files = files_class(directory, plan, display.say)
            driver, summary = conduct(plan, own_files, display, observers, interrupt)
        policy = plan.group_plans[0].ready.policy
        return Outcome(design, directory, summary, driver, policy, display)


def _display(*, quiet: bool) -> "Display":
    """Returns a screen; what draws it is imported late."""
    from mjx_reinforce.runs.display import Display

    return Display(quiet=quiet)


def report_on(outcome: Outcome, *, report: bool = True) -> None:
    """Says what a run or a sweep found, whose report is written, if that is asked for."""
    display = outcome.display
    directory = outcome.directory
    summary = outcome.summary
    assert directory is not None
    if not outcome.design.is_sweep:
        settings = vars(outcome.driver.config) if outcome.driver else {}
        # Playing a policy runs the code of these two only; going on runs that of all settings.
        player_settings = {name: settings[name] for name in ("env", "policy") if name in settings}
        display.show_summary(summary, directory, code_flags(settings), code_flags(player_settings))
        return
    if summary["status"] == "interrupted":
        flags = code_flags(summary["settings"])
        display.say(f"interrupted; go on with --resume {shlex.quote(str(directory))}{flags}")
        return
    if outcome.driver is None and (directory / "report.html").exists():
        display.say(f"the sweep in {directory} is finished")
        return
    timing = (
        f"compiling took {summary['compile_seconds']:.1f} s, training and evaluating "
        f"{summary['run_seconds']:.1f} s"
    )
    if not report:
        display.say(f"{timing}. Files in {directory}")
        return
    display.say("writing the report")
    # The lock of training is gone by now, and --resume in another process would write here, too.
    with locked(directory):
        page = _report(directory)
    timing += f", statistics and report {page.seconds:.1f} s"
    for sentence in (*page.answer, f"{timing}. Files in {directory}, first report.html"):
        display.say(sentence)
    display.show_commands(_watch_command(directory, page.best, summary["settings"]))


def _report(directory: Path) -> "WrittenReport":
    """Writes the report of a sweep; removes what a crash left of writing it."""
    from mjx_reinforce import report

    for temporary_path in [*directory.glob(".report.html.*"), *(directory / "report").glob(".*")]:
        temporary_path.unlink()
    return report.write_report([directory], directory / "report.html")


def _watch_command(directory: Path, number: int, settings: Mapping[str, Any]) -> dict[str, str]:
    """Returns the command that plays the best policy of a configuration, after what it does."""
    policy_directory = shlex.quote(str(directory / "policies" / f"{number:03d}"))
    flags = code_flags({name: settings[name] for name in ("env", "policy")})
    return {"To see the best of it play": f"{command('watch')} {policy_directory}{flags}"}

"""A sweep from its design to its files."""

import contextlib
import dataclasses
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjx_reinforce.console.commands import command, typed
from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.console.streams import heartbeat, to_screen
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.files import read_arrays, read_json, write_json
from mjx_reinforce.runs.directory import locked, own_directory
from mjx_reinforce.settings.config import Config, code_flags
from mjx_reinforce.sweeps.design import Design, as_record, check_design, configure
from mjx_reinforce.training.resume import check_same_program

if TYPE_CHECKING:
    from mjx_reinforce.report import WrittenReport
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.sweeps.plan import Prepared
    from mjx_reinforce.sweeps.results import SweepFiles

#: Not every terminal has the page's quotation marks.
_PLAIN_QUOTES = dict.fromkeys(
    map(ord, "\N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}"), '"'
)


def perform(
    design: Design, interrupt: Interrupt, *, report: bool = True, quiet: bool = False
) -> tuple[Path, bool]:
    """Trains all runs of a sweep, or goes on with it, and writes its files.

    Args:
      design: of the sweep.
      interrupt: what listens to signals.
      report: whether its page is written at its end.
      quiet: show no progress.

    Returns:
      The directory of its files, and whether all runs ended: else it was interrupted.

    Raises:
      ValueError: the design makes no sense, or its directory is in use or has other files.
      OSError: a file cannot be written.
    """
    check_design(design)
    known = {} if design.resume is None else read_json(design.resume / "sweep.json")
    if design.resume is not None and known.get("status") == "finished":
        _finish_again(design.resume, known)
        return design.resume, True
    with own_directory(design.base, design.resume, interrupt) as directory:
        configure_jax()
        return directory, _perform(design, directory, known, interrupt, report, quiet)


def _finish_again(directory: Path, known: Mapping[str, Any]) -> None:
    """Writes the report of a sweep that was stopped before it, if it was."""
    with locked(directory):
        if known.get("statistics_seconds") is None:
            written = _report(directory)
            write_json(directory / "sweep.json", {**known, "statistics_seconds": written.seconds})
    print(f"the sweep in {directory} is finished")


def _perform(
    design: Design,
    directory: Path,
    known: Mapping[str, Any],
    interrupt: Interrupt,
    report: bool,
    quiet: bool,
) -> bool:
    """Does what ``perform`` says, in a directory that is ours; ``known`` is its sweep.json."""
    from mjx_reinforce.runs.display import Display
    from mjx_reinforce.sweeps.conduct import Conductor
    from mjx_reinforce.sweeps.plan import prepare_sweep
    from mjx_reinforce.sweeps.results import SweepFiles

    with heartbeat((lambda text: None) if quiet else to_screen, "writing the simulation out"):
        prepared = prepare_sweep(design, known.get("chunk_runs"))
    contents = _contents(design, prepared, known)
    if known:
        _check_same_sweep(directory, known, contents)
    configurations, threshold = prepared.configurations, contents["threshold"]
    files = SweepFiles(directory, configurations, threshold)
    with Display(quiet=quiet) as display:
        interrupt.restore_screen(display.console.show_cursor)
        display.say(prepared.plan)
        conductor = Conductor(prepared, files, display, interrupt)
        with display.compiling():
            conductor.compile_first()
        display.start(conductor.clock.compiling)
        interrupt.defer(display.say)  # not before there is a program, see ``train_run``
        files.open(contents)
        ended = conductor.conduct()
        contents["status"] = "finished" if ended else "interrupted"
        contents["compile_seconds"] += prepared.engine_seconds + conductor.clock.compiling
        contents["run_seconds"] += conductor.clock.running
        _finish(design, prepared, files, contents)
        _say_end(design, files, contents, display, report=ended and report)
    return ended


def _say_end(
    design: Design,
    files: "SweepFiles",
    contents: dict[str, Any],
    display: "Display",
    *,
    report: bool,
) -> None:
    """Writes the report, if that is asked for, and says what a sweep found and where it is."""
    if not report:
        display.say(_last_line(files.directory, contents))
        return
    display.say("writing the report")
    written = _report(files.directory)
    contents["statistics_seconds"] = written.seconds
    files.write(contents)
    for sentence in (*written.answer, _last_line(files.directory, contents)):
        display.say(sentence.translate(_PLAIN_QUOTES))
    display.show_commands(_watch(files.directory, written.best, vars(design.base)))


def _finish(
    design: Design, prepared: "Prepared", files: "SweepFiles", contents: dict[str, Any]
) -> None:
    """Writes the last files of a sweep, or those of one that was interrupted."""
    from mjx_reinforce.store.build import policy_settings

    def settings(number: int) -> tuple[dict[str, Any], dict[str, Any]]:
        [config] = configure(design.base, [prepared.configurations[number]])
        part = next(each for each in prepared.parts if number in each.group.members)
        run = {"env": config.env, "horizon": part.horizon}
        if config.env_set:
            run["env_set"] = list(config.env_set)
        return policy_settings(part.env, config), run

    files.finish()
    if contents["status"] == "finished":
        files.gather_policies(settings)
        files.remove_states()
    files.write(contents)


def _report(directory: Path) -> "WrittenReport":
    """Writes the report of a sweep; removes what a crash left of writing it."""
    from mjx_reinforce import report

    for part in [*directory.glob(".report.html.*"), *(directory / "report").glob(".*")]:
        part.unlink()
    return report.write_report([directory], directory / "report.html")


def _contents(design: Design, prepared: "Prepared", known: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what sweep.json says while the sweep goes on."""
    from mjx_reinforce.store.provenance import provenance

    return {
        "status": "running",
        "env": design.base.env,
        "threshold": getattr(prepared.parts[0].env, "reward_threshold", None),
        **as_record(design),
        "num_seeds": design.base.num_seeds,
        "configurations": [
            {"configuration": number, **values}
            for number, values in enumerate(prepared.configurations)
        ],
        "chunk_runs": [part.limit for part in prepared.parts],
        "local_devices": prepared.division.count,
        "engine": prepared.engine,
        "compile_seconds": known.get("compile_seconds", 0.0),
        "run_seconds": known.get("run_seconds", 0.0),
        "statistics_seconds": None,
        "command": known.get("command", typed("sweep")),
        **provenance(),
    }


def _check_same_sweep(
    directory: Path, known: Mapping[str, Any], present: Mapping[str, Any]
) -> None:
    """Raises ValueError if a sweep cannot go on here."""
    check_same_program(directory, known, present)
    old, new = known.get("local_devices"), present["local_devices"]
    if old != new:
        raise ValueError(
            f"{directory} was begun on {old} devices, and here are {new}; go on with as many"
        )


def _watch(directory: Path, number: int, settings: Mapping[str, Any]) -> dict[str, str]:
    """Returns the command that plays the best policy of a configuration, after what it does."""
    place = shlex.quote(str(directory / "policies" / f"{number:03d}"))
    named = code_flags({name: settings[name] for name in ("env", "policy")})
    return {"To see the best of it play": f"{command('watch')} {place}{named}"}


def _last_line(directory: Path, contents: Mapping[str, Any]) -> str:
    """Returns the line that ends a sweep."""
    if contents["status"] == "interrupted":
        return f"interrupted; go on with --resume {directory}{code_flags(contents['settings'])}"
    took = (
        f"compiling took {contents['compile_seconds']:.1f} s, training and evaluating "
        f"{contents['run_seconds']:.1f} s"
    )
    if (seconds := contents["statistics_seconds"]) is None:
        return f"{took}. Files in {directory}"
    return f"{took}, statistics and report {seconds:.1f} s. Files in {directory}, first report.html"


class SweepResults(NamedTuple):
    """What a sweep measured, of R runs in E evaluations.

    Attributes:
      directory: of its files, None where none were asked for
      configurations: the values of what was swept, in each
      configuration: [R] the number of each run's
      seed: [R]
      eval_return: [E, R] mean return of the policy's mode; NaN where it was not finite
      env_steps: [E, R] trained until then

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """

    directory: Path | None
    configurations: list[dict[str, Any]]
    configuration: np.ndarray
    seed: np.ndarray
    eval_return: np.ndarray
    env_steps: np.ndarray


def sweep(
    base: Config,
    over: Mapping[str, Sequence[Any]],
    *,
    output: Path | str | None = None,
    exact: bool = False,
    chunk_runs: int | None = None,
    report: bool = True,
    quiet: bool = False,
) -> SweepResults:
    """Trains many configurations, ``base.num_seeds`` of each, as the command line does.

    Args:
      base: the settings that are not swept, such as ``mjx_reinforce.of_task("Hopper-v5")``.
      over: names of settings and the values of each; all combinations are trained.
      output: the directory of the sweep's files. None, with ``base.output`` None too, leaves none.
      exact: move every run by itself, so that no result depends in any bit on the others.
      chunk_runs: runs that are under way at once at most; as many as memory holds by default.
      report: write report.html among the files.
      quiet: show no progress.

    Returns:
      What was measured; the same is in the files of the directory.

    Raises:
      ValueError: a setting makes no sense, or the directory is not empty.
      OSError: a file cannot be written.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = dataclasses.replace(
      ...     mr.of_task("CartPole-v1", env_steps=200), num_seeds=2, eval_episodes=2
      ... )
      >>> swept = mr.sweep(config, over={"discount": [0.98, 0.99]}, quiet=True)
      >>> swept.configurations, swept.configuration.tolist()
      ([{'discount': 0.98}, {'discount': 0.99}], [0, 0, 1, 1])
    """
    check_kind("base", base, Config, 'mjx_reinforce.of_task("Hopper-v5")')
    with contextlib.ExitStack() as held:
        asked = base.output if output is None else Path(output)
        place = asked
        if place is None:
            place = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="sweep-")))
        base = dataclasses.replace(base, output=place)
        design = Design(base=base, over=over, exact=exact, chunk_runs=chunk_runs)
        perform(design, Interrupt(), report=report and asked is not None, quiet=quiet)
        return read_results(place)._replace(directory=asked)


def read_results(directory: Path) -> SweepResults:
    """Returns what a finished sweep measured, or raises ValueError."""
    record = read_json(directory / "sweep.json")
    if not (directory / "curves.npz").exists():
        raise ValueError(
            f"{directory} has no results yet: the sweep is {record.get('status', 'unfinished')}; "
            f"go on with it by --resume {directory}"
        )
    listed = record["configurations"]
    values = [{k: x for k, x in one.items() if k != "configuration"} for one in listed]
    return SweepResults(directory, values, **read_arrays(directory / "curves.npz"))

"""The command ``python -m mjx_reinforce.sweep``, and what is said at a sweep's end."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_reinforce.console.commands import command
from mjx_reinforce.runs.command_line import parse_sweep, train_to_the_end
from mjx_reinforce.runs.directory import locked
from mjx_reinforce.settings.config import code_flags

if TYPE_CHECKING:
    from mjx_reinforce.report import WrittenReport
    from mjx_reinforce.runs.perform import Outcome

#: Not every terminal has the page's quotation marks.
_PLAIN_QUOTES = dict.fromkeys(
    map(ord, "\N{LEFT DOUBLE QUOTATION MARK}\N{RIGHT DOUBLE QUOTATION MARK}"), '"'
)


def main() -> None:
    """Reads the command line, sweeps, and exits as ``train_to_the_end`` says."""
    train_to_the_end(parse_sweep, report_on)


def report_on(outcome: "Outcome", *, report: bool = True) -> None:
    """Writes the report of a sweep that ended, if that is asked for; says what was found."""
    display, directory, summary = outcome.display, outcome.directory, outcome.summary
    assert directory is not None
    if summary["status"] == "interrupted":
        flags = code_flags(summary["settings"])
        display.say(f"interrupted; go on with --resume {directory}{flags}")
        return
    if outcome.driver is None and (directory / "report.html").exists():
        display.say(f"the sweep in {directory} is finished")
        return
    took = (
        f"compiling took {summary['compile_seconds']:.1f} s, training and evaluating "
        f"{summary['run_seconds']:.1f} s"
    )
    if not report:
        display.say(f"{took}. Files in {directory}")
        return
    display.say("writing the report")
    with locked(directory):
        written = _report(directory)
    took += f", statistics and report {written.seconds:.1f} s"
    for sentence in (*written.answer, f"{took}. Files in {directory}, first report.html"):
        display.say(sentence.translate(_PLAIN_QUOTES))
    display.show_commands(_watch(directory, written.best, summary["settings"]))


def _report(directory: Path) -> "WrittenReport":
    """Writes the report of a sweep; removes what a crash left of writing it."""
    from mjx_reinforce import report

    for part in [*directory.glob(".report.html.*"), *(directory / "report").glob(".*")]:
        part.unlink()
    return report.write_report([directory], directory / "report.html")


def _watch(directory: Path, number: int, settings: Mapping[str, Any]) -> dict[str, str]:
    """Returns the command that plays the best policy of a configuration, after what it does."""
    place = shlex.quote(str(directory / "policies" / f"{number:03d}"))
    named = code_flags({name: settings[name] for name in ("env", "policy")})
    return {"To see the best of it play": f"{command('watch')} {place}{named}"}

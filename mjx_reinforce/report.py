"""``python -m mjx_reinforce.report RUN_OR_SWEEP`` makes a page of what runs and sweeps found."""

import dataclasses
import re
import shlex
import sys
import time
import urllib.parse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from mjx_reinforce.console.streams import say_error
from mjx_reinforce.export.run_files import seeds_in
from mjx_reinforce.files import FULL_ERRORS, check_output, csv_text, write_bytes
from mjx_reinforce.reports import document, sources, words
from mjx_reinforce.reports.charts import Table, render_chart, rows, short
from mjx_reinforce.reports.document import encoded
from mjx_reinforce.reports.experiment import Experiment, say
from mjx_reinforce.reports.findings import Findings, compute_findings, swept, worst_seeds
from mjx_reinforce.reports.tasks import compare_tasks, draw_profile, score_rows
from mjx_reinforce.settings.config import code_flags
from mjx_reinforce.settings.flags import run_command
from mjx_reinforce.setup.provenance import version
from mjx_reinforce.training.resume import FIRST_FILES

#: How the names of pages end.
_PAGES = (".html", ".htm")


@dataclasses.dataclass(frozen=True)
class ReportSettings:
    """Report on trained runs and sweeps: one HTML page that works offline.

    Its pictures (PNG, SVG) and tables (CSV) go into a folder beside it.
    """

    sources: tyro.conf.Positional[tuple[Path, ...]]
    """Directories of runs or sweeps. Those of several tasks make a page that compares scores over
    all tasks, with a page of each task behind it."""
    output: Path | None = None
    """The page. By default report.html in the directory of the run or sweep; if there are several,
    in the current folder. Pictures and tables go into a folder of that name, without .html; where
    that folder has runs, into NAME-report."""
    overwrite: bool = False
    """Replace a page that exists, with its pictures and tables."""


def main() -> None:
    """Reads the command line, writes the report, and exits.

    The status is 0 when done, 1 if files cannot be written, 2 for bad input, 130 after Ctrl-C.
    """
    run_command(ReportSettings, "report", _report)


def _report(settings: ReportSettings) -> None:
    """Writes a report, and says where it is."""
    if settings.output is not None:
        check_page(settings.output, settings.overwrite)
    # A folder of runs, as in hopper/*, may have pages about them, too.
    # If all of them are pages they stay, for the message that none is a run.
    chosen = [path for path in settings.sources if not _is_report(path)] or settings.sources
    pages = [str(path) for path in settings.sources if path not in chosen]
    if pages:
        print(f"left out, for they are reports: {', '.join(pages)}")
    start = time.perf_counter()
    experiments = sources.read_tasks(chosen)
    # Where the page goes by default is known only now; a place that the user names was checked
    # above, before the sources were read.
    output = settings.output or _default_output(chosen)
    check_page(output, settings.overwrite)
    try:
        if len(experiments) == 1:
            _write(experiments[0], output)
        else:
            _write_tasks(experiments, output)
    except OSError as error:
        reason = str(error)
        if not output.parent.is_dir():
            reason = f"{output.parent} was moved or removed"
        elif error.errno in FULL_ERRORS:
            reason += "; make room there"
        say_error(f"cannot write {output}: {reason}")
        sys.exit(1)
    size = f"{output.stat().st_size / 1e6:.1f} MB, {time.perf_counter() - start:.1f} s"
    print(f"{output} ({size}), pictures and tables in {_beside(output)}")


def _default_output(chosen: Sequence[Path]) -> Path:
    """Returns where a page goes: into what it is of, or, if that is several, the current folder."""
    if len(chosen) == 1:
        return chosen[0] / "report.html"
    return Path("report.html")


def check_page(output: Path, overwrite: bool) -> None:
    """Raises ValueError if the report cannot be written there, or would replace files unasked."""
    check_output(output, overwrite, *_PAGES)
    folder = _beside(output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is in the way of the pictures; choose another --output")
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise ValueError(f"{folder} exists; pass --overwrite or another --output")


class WrittenReport(NamedTuple):
    """A page that was written.

    seconds: how long that took
    answer: what the page says first, in sentences
    best: the place of the best configuration among those of the sources
    """

    seconds: float
    answer: list[str]
    best: int


def write_report(chosen: Sequence[Path], output: Path) -> WrittenReport:
    """Writes the page, and its pictures and tables beside it.

    Replaces what is there; ``check_page`` refuses that.

    Args:
      chosen: run and sweep directories, see ``sources.read_experiment``.
      output: the page.

    Raises:
      ValueError: a source is damaged, or they are of several tasks.
      OSError: a file cannot be read or written.
    """
    return _write(sources.read_experiment(chosen), output)


def _write_tasks(experiments: Sequence[Experiment], output: Path) -> None:
    """Writes the page of several tasks, and that of each into the folder beside it."""
    tasks = [compute_findings(experiment) for experiment in experiments]
    findings = compare_tasks(tasks)
    folder = _beside(output)
    folder.mkdir(exist_ok=True)
    pages = []
    for number, task in enumerate(tasks, start=1):
        # Names of tasks may have letters that file systems refuse.
        name = re.sub(r"[^\w.-]", "-", task.experiment.env)
        page = folder / f"{number}-{name}.html"
        _write_findings(task, page, time.perf_counter())
        pages.append(urllib.parse.quote(str(page.relative_to(output.parent))))
    profile = draw_profile(findings)
    labels = [standing.label for standing in findings.standings]
    pictures = render_chart(profile, labels, f"{len(tasks)} tasks")
    for ending, picture in pictures.items():
        write_bytes(folder / f"{profile.name}.{ending}", picture)
    for name, table in profile.data.items():
        write_bytes(folder / f"{name}.csv", encoded(table_csv(table, labels)))
    write_bytes(folder / "results.csv", encoded(csv_text(score_rows(findings))))
    package_version = version("mjx-reinforce") or "not installed"
    text = document.render_tasks(findings, pictures["svg"], pages, package_version)
    write_bytes(output, encoded(text))


def _write(experiment: Experiment, output: Path) -> WrittenReport:
    """Writes the page of an experiment; see ``write_report``."""
    start = time.perf_counter()
    return _write_findings(compute_findings(experiment), output, start)


def _write_findings(findings: Findings, output: Path, start: float) -> WrittenReport:
    """Writes the page of findings that were begun at a time; see ``write_report``."""
    experiment = findings.experiment
    charts = document.draw_charts(findings)
    labels = findings.labels
    folder = _beside(output)
    folder.mkdir(exist_ok=True)
    results = results_csv(findings)
    write_bytes(folder / "results.csv", encoded(results))
    for chart in charts:
        for name, table in chart.data.items():
            write_bytes(folder / f"{name}.csv", encoded(table_csv(table, labels)))
        for ending, picture in render_chart(chart, labels, experiment.title).items():
            write_bytes(folder / f"{chart.name}.{ending}", picture)
    # The page is last, so that all that it links to is there; its own time it cannot say.
    seconds = time.perf_counter() - start
    watch = how_to_watch(experiment, findings)
    package_version = version("mjx-reinforce") or "not installed"
    text = document.render(findings, charts, results, watch, package_version, seconds)
    write_bytes(output, encoded(text))
    return WrittenReport(time.perf_counter() - start, words.headline(findings), findings.order[0])


def _beside(output: Path) -> Path:
    """Returns the folder for a page's pictures and tables, which is none that has runs."""
    folder = output.with_suffix("")
    while any(path for name in FIRST_FILES for path in folder.rglob(name)):
        folder = folder.with_name(f"{folder.name}-report")
    return folder


def _is_report(path: Path) -> bool:
    """Returns whether a path is a page, or the folder of its pictures and tables."""
    page = path.suffix.lower() in _PAGES and path.is_file()
    return page or (
        (path / "results.csv").is_file() and not any((path / x).exists() for x in FIRST_FILES)
    )


def results_csv(findings: Findings) -> str:
    """Returns a row for each configuration and seed."""
    names = swept(findings)
    header = ("configuration", *names, "seed", "final_return", "best_return")
    lines: list[Sequence[Any]] = [(*header, "env_steps_to_solve", "env_steps", "nonfinite")]
    # Configurations are numbered from 1, the best one first, as on the page.
    for number, result in enumerate(findings.results, start=1):
        configuration = result.configuration
        solving = result.solving
        settings = [say(configuration.settings.get(name)) for name in names]
        # A seed's evaluations that were not finite are passed over.
        best = short(np.fmax.reduce(configuration.eval_return, axis=0), 7)
        final_returns = short(result.final, 7)
        env_steps = configuration.env_steps[-1].tolist()
        for s, seed in enumerate(configuration.seed.tolist()):
            # Empty for a seed that never solved the task, and where nothing counts as solved.
            solved = int(solving.steps[s]) if solving and solving.solved[s] else ""
            nonfinite = int(configuration.nonfinite[s])
            cells = (seed, final_returns[s], best[s], solved, env_steps[s], nonfinite)
            lines.append((number, *settings, *cells))
    return csv_text(lines)


def table_csv(table: Table, labels: Sequence[str]) -> str:
    """Returns a table as a CSV file."""
    return csv_text([table, *(row.values() for row in rows(table, labels))])


def how_to_watch(experiment: Experiment, findings: Findings) -> str:
    """Returns the command that shows the best configuration's worst seed, "" if none was kept."""
    best = findings.results[0]
    worst_seed = worst_seeds(best)[0]
    seed = int(best.configuration.seed[worst_seed])
    policy_folder = best.configuration.directories[worst_seed]
    # The directory of a sweep has no config.json, and a folder of policies for each configuration,
    # counted within the sweep: it may be one of several sources.
    if not (policy_folder / "config.json").is_file():
        sweep = experiment.directories[findings.order[0]]
        number = findings.order[0] - experiment.directories.index(sweep)
        policy_folder = policy_folder / "policies" / f"{number:03d}"
        # A sweep keeps the policies of each configuration's worst and best seed alone.
        if seed not in seeds_in(policy_folder):
            return ""
    flags = code_flags({"env": experiment.env})
    return f"python -m mjx_reinforce.watch {shlex.quote(str(policy_folder))} --seed {seed}{flags}"


if __name__ == "__main__":
    main()

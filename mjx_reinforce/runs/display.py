"""What a user sees while a run goes on and when it ends."""

import datetime
import math
import shlex
from collections.abc import Iterable, Mapping
from contextlib import suppress
from decimal import ROUND_DOWN, Decimal
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from mjx_reinforce.console.commands import command
from mjx_reinforce.files import Arrays
from mjx_reinforce.reports.experiment import counted, say, setting_in_words
from mjx_reinforce.runs.plan import Part, Plan
from mjx_reinforce.statistics import enough, iqm
from mjx_reinforce.training import record
from mjx_reinforce.training.driver import Driver, Evaluation, Observer, RunDriver


class _Bar(Progress):
    """A bar with its times, and a line below it: side by side they do not fit in 80 columns."""

    line = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Returns what is drawn, from top to bottom."""
        yield from super().get_renderables()
        if self.line:
            yield Text(self.line)


class _Screen(Console):
    """Prints as the console of rich does, which would end the program where nobody reads."""

    def on_broken_pipe(self) -> None:
        """Says no more."""
        self.quiet = True


class Display(Observer[RunDriver]):
    """A progress bar on a terminal, one line an evaluation elsewhere."""

    def __init__(self, *, quiet: bool = False):
        """Takes the terminal, on which it shows nothing if it is to be quiet."""
        # What users name is printed as it is: "[bold]" and ":smile:" are no commands.
        self.console = _Screen(markup=False, emoji=False, quiet=quiet)
        self._bar = _Bar(
            SpinnerColumn("line" if self.console.options.ascii_only else "dots"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[done]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("compiling", total=None, done="", left="")
        #: What is wrong with the user's model, and whether numbers that are not finite were told.
        self._of_model, self._told = "", False

    def __enter__(self) -> "Display":
        """Starts drawing."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the last state on the screen."""
        self._bar.stop()

    def say(self, text: str | Table, style: str | None = None, *, whole: bool = False) -> None:
        """Prints a sentence or a table above the bar.

        A line that the screen does not take is lost: it may be a file on a full disk, or a pipe
        that nobody reads, which is no reason to end a run.

        Args:
          text: is wrapped on a terminal, and a line elsewhere.
          style: one of rich's.
          whole: wrap it nowhere: it is to be copied.
        """
        with suppress(OSError):
            whole |= not self.console.is_terminal
            self.console.print(text, style=style, highlight=False, soft_wrap=whole)

    def warn_of_model(self, instability: str | None) -> None:
        """Says that a model explodes in C MuJoCo, now and where its run is stopped."""
        if instability is not None:
            self._of_model = instability
            self.say(instability, "yellow")

    def show_commands(self, commands: Mapping[str, str]) -> None:
        """Prints command lines after what they do; each is one line, to be copied."""
        for purpose, line in commands.items():
            self.say(f"{purpose}:  {line}", whole=True)

    def show_summary(
        self, summary: dict[str, Any], directory: Path, again: str = "", own: str = ""
    ) -> None:
        """Says what a run learned, where its files are, and what can be done with them.

        Args:
          summary: of summary.json.
          directory: of the run.
          again: the flags that name the user's code where the run goes on.
          own: those of them that its policies need.
        """
        self.say(summary_table(summary))
        where = shlex.quote(str(directory))
        if summary["status"] == "interrupted":
            self.say(f"Interrupted: go on with --resume {where}{again}", whole=True)
            return
        self.say(f"Files in {directory}; the picture is learning_curve.png.")
        self.show_commands(
            {
                "To see the best seed play": f"{command('watch')} {where}{own}",
                "For a page of all figures": f"{command('report')} {where}",
            }
        )
        if summary["status"] == "stopped":
            self.say(
                "; ".join(filter(None, (f"stopped: {summary['reason']}", self._of_model))), "red"
            )

    def start(self, compile_seconds: float) -> None:
        """Marks the end of compilation, from where the time left is counted."""
        self.say(f"compiled in {compile_seconds:.1f} s")
        self._bar.reset(self._task, total=1.0, description="training", done="", left="")

    def show_progress(self, now: record.Progress) -> None:
        """Shows how far the run is and how well it does."""
        self._bar.line, left = _returns_and_speed(now), _time_left(now)
        done = percent_done(min(now.fraction, 1.0))
        self._bar.update(self._task, completed=now.fraction, done=done, left=left)
        if not self.console.is_terminal:
            self.say(
                f"update {now.updates:5d}  {now.env_steps:12,.0f} env steps per seed  "
                f"{_returns_and_speed(now)}  {done}  {left}".rstrip()
            )

    def updated(self, driver: RunDriver, met: np.ndarray) -> None:
        """Says once which seeds met numbers that are not finite; the last table counts them."""
        if met.any() and not self._told:
            self._told = True
            said = record.describe_nonfinite(met, driver.config.first_seed, driver.updates())
            self.say(said, "yellow")

    def evaluated(self, driver: RunDriver, evaluation: Evaluation, rows: Arrays) -> None:
        """Shows how far the run is and how well it does."""
        self.show_progress(driver.record.progress())


class SweepScreen(Observer[Driver]):
    """Shows how far a sweep is, and which of its runs are trained."""

    def __init__(self, display: Display, plan: Plan, parts: Iterable[Part]):
        """Takes the display, the sweep, and what of it is to be trained."""
        self._display, self._plan = display, plan
        #: Runs that have ended here, what checkpoints brought of them, and of how many.
        self._done, self._brought = 0, 0.0
        self._total = sum(len(runs.seed) for part in parts for runs in part.chunks)

    def began(self, driver: Driver) -> None:
        """Says which configurations the lines that follow are of."""
        self._brought += driver.record.used_up()
        runs, every = driver.runs, self._plan.design.configurations
        here = [every[number] for number in np.unique(runs.configuration)]
        values = {name: [*dict.fromkeys(say(values[name]) for values in here)] for name in here[0]}
        count = f"{counted(len(here), 'configuration')} of {len(every):,}"
        few = {name: x if len(x) < 5 else (x[0], "...", x[-1]) for name, x in values.items()}
        said = (f"{setting_in_words(name)} {', '.join(x)}" for name, x in few.items())
        self._display.say(f"{'; '.join(said)} ({count}, {counted(len(runs.seed), 'run')})")

    def updated(self, driver: Driver, met: np.ndarray) -> None:
        """Shows how far it is."""
        done = self._done + driver.record.used_up()
        fraction, gained = float(done / self._total), float(done - self._brought) / self._total
        running = self._plan.clock.running()
        now = driver.record.progress_at(fraction, driver.seconds(), gained, running)
        self._display.show_progress(now)

    def ended(self, driver: Driver) -> None:
        """Counts the runs."""
        self._done += len(driver.runs.seed)


def _returns_and_speed(now: record.Progress) -> str:
    """Returns the returns and, after a block of updates, the mean speed."""
    text = f"return {now.iqm:7.1f}  worst {now.worst:7.1f}"
    if now.failed:
        text = f"return {now.iqm:7.1f}  worst nan ({now.failed:,} of {now.num_seeds:,} seeds)"
    if not math.isnan(now.env_steps_per_second):
        text += f"  {now.env_steps_per_second:,.0f} steps/s"
    return text


def _time_left(now: record.Progress) -> str:
    """Returns how long the run still takes, empty where nobody knows."""
    if math.isnan(now.seconds_left):
        return ""
    return f"left {datetime.timedelta(seconds=math.ceil(now.seconds_left))}"


def percent_done(fraction: float) -> str:
    """Returns a fraction as a percentage with one decimal, rounded down: 100% is all."""
    shown = Decimal(repr(fraction)).quantize(Decimal("0.001"), ROUND_DOWN)
    return f"{100 * shown:.1f}%"


def summary_table(summary: dict[str, Any]) -> Table:
    """Returns the table that ends a run."""
    num_seeds = f"{summary['num_seeds']:,}"
    table = Table(title=f"{summary['env']}, {num_seeds} seeds", show_header=False)
    low, high = summary["iqm_ci"]
    known = math.isfinite(low) and math.isfinite(high)
    interval = f"95% interval {low:.1f} to {high:.1f}" if known else "no interval"
    interval += "" if enough(summary["num_seeds"]) else " below six seeds"
    table.add_row("return, interquartile mean over seeds", f"{summary['iqm']:.1f}  ({interval})")
    returns = np.array(summary["final_returns"])
    table.add_row("worst and best seed", f"{returns.min():.1f}, {np.fmax.reduce(returns):.1f}")
    if failed := summary["seeds_nonfinite_at_end"]:
        row = f"{failed:,} of {num_seeds}, worse than every other"
        table.add_row("seeds whose return is not finite", row)
    if broken := sum(summary["nonfinite"]):
        row = f"{broken:,}, of all seeds together"
        table.add_row("updates with values not finite", row)
    if (at_end := summary["seeds_solved_at_end"]) is not None:
        row = f"{at_end:,} of {num_seeds} at the end, {summary['seeds_ever_solved']:,} ever"
        table.add_row(f"seeds at {summary['threshold']:,g}, the task's threshold", row)
        solved = [count for count in summary["env_steps_to_solve"] if count is not None]
        if solved:
            table.add_row("env steps to solve", f"{min(solved):,} to {max(solved):,}")
    if "final_test_returns" in summary:
        last, best = (iqm(np.array(summary[f"{kind}_test_returns"])) for kind in ("final", "best"))
        table.add_row("last policies on fresh starts", f"{last:.1f}")
        lucky = " (their evaluation was luck)" * bool(best < last)
        table.add_row("best policies on fresh starts", f"{best:.1f}{lucky}")
    table.add_row("env steps per second", f"{summary['env_steps_per_second']:,.0f}")
    useful = percent_done(summary["useful_step_fraction"])
    table.add_row("steps of episodes, of all simulated", useful)
    table.add_row("compiling", f"{summary['compile_seconds']:.1f} s")
    table.add_row("training and evaluating", f"{summary['run_seconds']:.1f} s")
    return table

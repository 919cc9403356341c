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
from mjx_reinforce.runs.plan import GroupPlan, Plan
from mjx_reinforce.statistics import enough, iqm
from mjx_reinforce.training import failures, record
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
        spinner = "line" if self.console.options.ascii_only else "dots"
        self._bar = _Bar(
            SpinnerColumn(spinner),
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[percent]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[time_left]}"),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        # No total: nobody knows how long compiling takes, and rich then draws a moving bar.
        self._task = self._bar.add_task("compiling", total=None, percent="", time_left="")
        #: What is wrong with the user's model, "" for nothing.
        self._model_warning = ""
        #: Whether a line about numbers that are not finite was shown.
        self._nonfinite_shown = False

    def __enter__(self) -> "Display":
        """Starts drawing."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the last state on the screen."""
        self._bar.stop()

    def say(self, text: str | Table, style: str | None = None, *, is_whole: bool = False) -> None:
        """Prints a sentence or a table above the bar.

        A line that the screen does not take is lost: it may be a file on a full disk, or a pipe
        that nobody reads, which is no reason to end a run.

        Args:
          text: is wrapped on a terminal, and a line elsewhere.
          style: one of rich's.
          is_whole: wrap it nowhere: it is to be copied.
        """
        with suppress(OSError):
            is_whole |= not self.console.is_terminal
            self.console.print(text, style=style, highlight=False, soft_wrap=is_whole)

    def warn_of_model(self, instability: str | None) -> None:
        """Says that a model explodes in C MuJoCo, now and where its run is stopped."""
        if instability is not None:
            self._model_warning = instability
            self.say(instability, "yellow")

    def show_commands(self, commands: Mapping[str, str]) -> None:
        """Prints command lines after what they do; each is one line, to be copied."""
        for purpose, command_line in commands.items():
            self.say(f"{purpose}:  {command_line}", is_whole=True)

    def show_summary(
        self, summary: dict[str, Any], directory: Path, resume_flags: str = "", play_flags: str = ""
    ) -> None:
        """Says what a run learned, where its files are, and what can be done with them.

        Args:
          summary: of summary.json.
          directory: of the run.
          resume_flags: those that name the user's code where the run goes on.
          play_flags: those of them that its policies need.
        """
        self.say(summary_table(summary))
        # In commands that are to be copied the path is quoted for the shell, elsewhere as it is.
        quoted = shlex.quote(str(directory))
        if summary["status"] == "interrupted":
            self.say(f"Interrupted: go on with --resume {quoted}{resume_flags}", is_whole=True)
            return
        self.say(f"Files in {directory}; the picture is learning_curve.png.")
        self.show_commands(
            {
                "To see the best seed play": f"{command('watch')} {quoted}{play_flags}",
                "For a page of all figures": f"{command('report')} {quoted}",
            }
        )
        if summary["status"] == "stopped":
            message = f"stopped: {summary['reason']}"
            # A model that explodes in C MuJoCo is the likely cause, and its line is far above.
            if self._model_warning:
                message += f"; {self._model_warning}"
            self.say(message, "red")

    def start(self, compile_seconds: float) -> None:
        """Marks the end of compilation, from where the time left is counted."""
        self.say(f"compiled in {compile_seconds:.1f} s")
        self._bar.reset(self._task, total=1.0, description="training", percent="", time_left="")

    def show_progress(self, progress: record.Progress) -> None:
        """Shows how far the run is and how well it does."""
        returns_and_speed = _returns_and_speed(progress)
        time_left = _time_left(progress)
        # The last update may go beyond the budget.
        percent = percent_done(min(progress.fraction, 1.0))
        self._bar.line = returns_and_speed
        self._bar.update(
            self._task, completed=progress.fraction, percent=percent, time_left=time_left
        )
        # In a file or a pipe, where rich draws no bar.
        if not self.console.is_terminal:
            self.say(
                f"update {progress.updates:5d}  {progress.env_steps:12,.0f} env steps per seed  "
                f"{returns_and_speed}  {percent}  {time_left}".rstrip()
            )

    def updated(self, driver: RunDriver, num_nonfinite: np.ndarray) -> None:
        """Says once which seeds met numbers that are not finite; the last table counts them."""
        if num_nonfinite.any() and not self._nonfinite_shown:
            self._nonfinite_shown = True
            text = failures.describe_nonfinite(
                num_nonfinite, driver.config.first_seed, driver.updates()
            )
            self.say(text, "yellow")

    def evaluated(self, driver: RunDriver, evaluation: Evaluation, rows: Arrays) -> None:
        """Shows how far the run is and how well it does."""
        self.show_progress(driver.record.progress())


class SweepScreen(Observer[Driver]):
    """Shows how far a sweep is, and which of its runs are trained."""

    def __init__(self, display: Display, plan: Plan, group_plans: Iterable[GroupPlan]):
        """Takes the display, the sweep, and what of it is to be trained."""
        self._display = display
        self._plan = plan
        #: How many runs have ended in this process.
        self._num_ended = 0
        #: Whole budgets of runs that checkpoints had used before this process.
        self._budgets_before = 0.0
        self._num_runs = sum(
            len(runs.seed) for group_plan in group_plans for runs in group_plan.chunks
        )

    def began(self, driver: Driver) -> None:
        """Says which configurations the lines that follow are of."""
        # The files came first, and restored a checkpoint if there was one: until now nothing of
        # this chunk was trained by this process.
        self._budgets_before += driver.record.used_up()
        runs = driver.runs
        configurations = self._plan.design.configurations
        members = [configurations[number] for number in np.unique(runs.configuration)]
        settings = []
        for name in members[0]:
            # Each value once, in the order of the sweep; of many the ends are enough for a line.
            values = [*dict.fromkeys(say(configuration[name]) for configuration in members)]
            if len(values) >= 5:
                values = [values[0], "...", values[-1]]
            settings.append(f"{setting_in_words(name)} {', '.join(values)}")
        share = f"{counted(len(members), 'configuration')} of {len(configurations):,}"
        self._display.say(f"{'; '.join(settings)} ({share}, {counted(len(runs.seed), 'run')})")

    def updated(self, driver: Driver, num_nonfinite: np.ndarray) -> None:
        """Shows how far it is."""
        num_budgets_used = self._num_ended + driver.record.used_up()
        fraction = float(num_budgets_used / self._num_runs)
        # The time left is estimated from what this process trained: the time that earlier ones
        # took is in no clock of it.
        gain = float(num_budgets_used - self._budgets_before) / self._num_runs
        seconds = self._plan.clock.running()
        progress = driver.record.progress_at(fraction, driver.seconds(), gain, seconds)
        self._display.show_progress(progress)

    def ended(self, driver: Driver) -> None:
        """Counts the runs."""
        self._num_ended += len(driver.runs.seed)


def _returns_and_speed(progress: record.Progress) -> str:
    """Returns the returns and, after a block of updates, the mean speed."""
    progress_line = f"return {progress.iqm:7.1f}  worst {progress.worst:7.1f}"
    if progress.failed:
        seeds = f"{progress.failed:,} of {progress.num_seeds:,} seeds"
        progress_line = f"return {progress.iqm:7.1f}  worst nan ({seeds})"
    # NaN before the first block of updates.
    if not math.isnan(progress.env_steps_per_second):
        progress_line += f"  {progress.env_steps_per_second:,.0f} steps/s"
    return progress_line


def _time_left(progress: record.Progress) -> str:
    """Returns how long the run still takes, empty where nobody knows."""
    if math.isnan(progress.seconds_left):
        return ""
    return f"left {datetime.timedelta(seconds=math.ceil(progress.seconds_left))}"


def percent_done(fraction: float) -> str:
    """Returns a fraction as a percentage with one decimal, rounded down: 100% is all."""
    # As a decimal number: a float such as 0.29 is a little less, and would be rounded to 28.9%.
    shown_fraction = Decimal(repr(fraction)).quantize(Decimal("0.001"), ROUND_DOWN)
    return f"{100 * shown_fraction:.1f}%"


def summary_table(summary: dict[str, Any]) -> Table:
    """Returns the table that ends a run."""
    num_seeds = f"{summary['num_seeds']:,}"
    seeds = counted(summary["num_seeds"], "seed")
    table = Table(title=f"{summary['env']}, {seeds}", show_header=False)
    if summary["race"] > 1:
        table.caption = (
            f"Each seed is the best of a race of {summary['race']} policies, by training returns; "
            f"all policies together played {sum(summary['env_steps']):,} env steps in "
            f"{summary['run_seconds']:,.1f} s."
        )
    low, high = summary["iqm_ci"]
    if math.isfinite(low) and math.isfinite(high):
        interval = f"95% interval {low:.1f} to {high:.1f}"
    else:
        interval = "no interval"
    if not enough(summary["num_seeds"]):
        interval += " below six seeds"
    table.add_row("return, interquartile mean over seeds", f"{summary['iqm']:.1f}  ({interval})")
    returns = np.array(summary["final_returns"])
    # ``min`` is NaN if a seed failed, which then is the worst; ``fmax`` passes over it.
    table.add_row("worst and best seed", f"{returns.min():.1f}, {np.fmax.reduce(returns):.1f}")
    if num_failed := summary["seeds_nonfinite_at_end"]:
        row = f"{num_failed:,} of {num_seeds}, worse than every other"
        table.add_row("seeds whose return is not finite", row)
    if num_nonfinite := sum(summary["nonfinite"]):
        row = f"{num_nonfinite:,}, of all seeds together"
        table.add_row("updates with values not finite", row)
    if (num_solved := summary["seeds_solved_at_end"]) is not None:
        row = f"{num_solved:,} of {num_seeds} at the end, {summary['seeds_ever_solved']:,} ever"
        table.add_row(f"seeds at {summary['threshold']:,g}, the task's threshold", row)
        solved = [steps for steps in summary["env_steps_to_solve"] if steps is not None]
        if solved:
            table.add_row("env steps to solve", f"{min(solved):,} to {max(solved):,}")
    if "final_test_returns" in summary:
        last_iqm = iqm(np.array(summary["final_test_returns"]))
        best_iqm = iqm(np.array(summary["best_test_returns"]))
        table.add_row("last policies on fresh starts", f"{last_iqm:.1f}")
        # The best policies were chosen by their evaluations, so those flatter them.
        luck_note = " (their evaluation was luck)" if best_iqm < last_iqm else ""
        table.add_row("best policies on fresh starts", f"{best_iqm:.1f}{luck_note}")
    table.add_row("env steps per second", f"{summary['env_steps_per_second']:,.0f}")
    useful_percent = percent_done(summary["useful_step_fraction"])
    table.add_row("steps of episodes, of all simulated", useful_percent)
    table.add_row("compiling", f"{summary['compile_seconds']:.1f} s")
    table.add_row("training and evaluating", f"{summary['run_seconds']:.1f} s")
    return table

"""What a user sees while a run goes on and when it ends."""

import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from mjx_reinforce.runs import record
from mjx_reinforce.runs.heartbeat import heartbeat
from mjx_reinforce.runs.plan import duration


class Display:
    """A progress bar on a terminal, one line an evaluation elsewhere."""

    def __init__(self):
        self.console = Console()
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("compiling", total=None)

    def __enter__(self) -> "Display":
        """Starts drawing."""
        self._bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        """Leaves the last state on the screen."""
        self._bar.stop()

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, highlight=False, soft_wrap=True)

    def compiling(self, expected: float | None) -> AbstractContextManager[None]:
        """Returns a ``with`` block that shows that its contents go on.

        Args:
          expected: how long they take (s), or None if that is not known.
        """
        if not self.console.is_terminal:
            return heartbeat(self.say, expected)
        if expected is not None:
            self._bar.update(self._task, description=f"compiling, about {duration(expected)}")
        return nullcontext()

    def start(self, compile_seconds: float) -> None:
        """Marks the end of compilation, from where the time left is counted."""
        self._began = time.perf_counter()
        self.say(f"compiled in {compile_seconds:.1f} s")
        self._bar.reset(self._task, total=1.0, description="training")

    def show_progress(self, progress: record.Progress) -> None:
        """Shows how far the run is and how well it does."""
        text = (
            f"return {progress.iqm:7.1f}  worst {progress.worst:7.1f}  "
            f"{progress.env_steps_per_second:,.0f} steps/s"
        )
        self._bar.update(self._task, completed=progress.fraction, description=text)
        if not self.console.is_terminal:
            steps = f"{progress.env_steps:12,.0f} env steps a seed"
            self.say(f"update {progress.updates:5d}  {steps}  {text}{self._left(progress)}")

    def _left(self, progress: record.Progress) -> str:
        """Returns how long the run still takes, if it goes on as until now."""
        if not 0 < progress.fraction < 1:
            return ""
        elapsed = time.perf_counter() - self._began
        return f"  about {duration(elapsed / progress.fraction - elapsed)} left"

    def show_nonfinite(self, event: Mapping[str, Any]) -> None:
        """Names an update with numbers that are not finite, from ``Record.add_updates``."""
        what = f"{event['episodes']} non-finite episodes"
        what += ", update skipped" if event["skipped"] else ""
        self.say(f"[yellow]seed {event['seed']}, update {event['update']}: {what}[/yellow]")


def print_summary(console: Console, summary: dict[str, Any], directory: Path) -> None:
    """Prints the table that ends a run, and where its files are."""
    low, high = summary["iqm_ci"]
    table = Table(title=f"{summary['env']}, {summary['num_seeds']} seeds", show_header=False)
    interval = "" if low != low else f"  (95 % interval {low:.1f} to {high:.1f})"
    table.add_row("return, interquartile mean over seeds", f"{summary['iqm']:.1f}{interval}")
    returns = summary["final_returns"]
    table.add_row("worst and best seed", f"{min(returns):.1f}, {max(returns):.1f}")
    if summary["solve_rate"] is not None:
        solved = [steps for steps in summary["env_steps_to_solve"] if steps is not None]
        table.add_row("seeds solved at the end", f"{summary['solve_rate']:.0%}")
        if solved:
            episodes = [number for number in summary["episodes_to_solve"] if number is not None]
            table.add_row("env steps to solve", f"{min(solved):,} to {max(solved):,}")
            table.add_row("episodes to solve", f"{min(episodes):,} to {max(episodes):,}")
    table.add_row("env steps a second", f"{summary['env_steps_per_second']:,.0f}")
    table.add_row("useful steps of those simulated", f"{summary['useful_step_fraction']:.0%}")
    table.add_row("compiling", f"{summary['compile_seconds']:.1f} s")
    table.add_row("training and evaluating", f"{summary['run_seconds']:.1f} s")
    console.print(table)
    console.print(f"Files in {directory}", highlight=False, soft_wrap=True)

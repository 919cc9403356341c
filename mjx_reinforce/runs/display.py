"""What a person sees while a run goes on and when it ends."""

import signal
import threading
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


class Display:
    """A progress bar on a terminal, one line an evaluation elsewhere."""

    def __init__(self):
        self.console = Console()
        self._progress = Progress(
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
        self._task = self._progress.add_task("compiling", total=None)

    def __enter__(self) -> "Display":
        """Starts drawing."""
        self._progress.start()
        return self

    def __exit__(self, *_: Any) -> None:
        """Leaves the last state on the screen."""
        self._progress.stop()

    def say(self, text: str) -> None:
        """Prints a line above the bar."""
        self.console.print(text, highlight=False, soft_wrap=True)

    def start(self) -> None:
        """Marks the end of compilation, from where the time left is counted."""
        self._progress.reset(self._task, total=1.0, description="training")

    def evaluated(
        self, done: float, update: int, steps: float, value: float, low: float, rate: float
    ) -> None:
        """Shows an evaluation.

        Args:
          done: the fraction of the budget that is used.
          update: how many updates were made.
          steps: env steps of the mean seed.
          value: interquartile mean of the return over seeds.
          low: the return of the worst seed.
          rate: env steps a second, all seeds together.
        """
        text = f"return {value:7.1f}  worst {low:7.1f}  {rate:,.0f} steps/s"
        self._progress.update(self._task, completed=done, description=text)
        if not self.console.is_terminal:
            self.say(f"update {update:5d}  {steps:12,.0f} env steps a seed  {text}")


class Interrupt(threading.Event):
    """Ctrl-C asks the run to stop after the present block; a second one stops at once."""

    def __init__(self, display: Display):
        super().__init__()
        self._display = display

    def __enter__(self) -> "Interrupt":
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: Any) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: Any) -> None:
        del number, frame
        self.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._display.say("stopping after this block of updates; Ctrl-C again stops at once")


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

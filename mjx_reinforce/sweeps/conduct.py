"""Training the runs of a sweep, chunk by chunk, while the programs of the next group compile."""

import functools
import time

import numpy as np

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.reports.experiment import counted, say, setting_in_words
from mjx_reinforce.runs.display import Display
from mjx_reinforce.sweeps import chunks
from mjx_reinforce.sweeps.chunks import Chunk, History, Runs
from mjx_reinforce.sweeps.plan import Part, Prepared, learner_builder
from mjx_reinforce.sweeps.programs import SlotPrograms, Stopwatch, compile_programs, one_ahead
from mjx_reinforce.sweeps.results import SweepFiles
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.driver import drive
from mjx_reinforce.training.progress import Progress

#: So many values of a setting are named in a line.
_NAMED = 6


class Conductor:
    """Trains the chunks that have not ended yet; a file that cannot be written is an OSError.

    clock: where the time goes
    """

    def __init__(
        self, prepared: Prepared, files: SweepFiles, display: Display, interrupt: Interrupt
    ):
        """Takes what the sweep is made of.

        Args:
          prepared: its parts.
          files: of the sweep.
          display: its screen.
          interrupt: what listens to signals.
        """
        self._prepared, self._files = prepared, files
        self._display, self._interrupt = display, interrupt
        self.clock = Stopwatch()
        #: The groups that have runs to be trained, and these in chunks.
        self._stages: list[tuple[Part, list[Runs]]] = []
        for number, part in enumerate(prepared.parts):
            every = chunks.split_runs(part.group, f"{number:03d}", part.num_chunks)
            if left := [runs for runs in every if not files.has(runs.name)]:
                self._stages.append((part, left))
        self._done, self._total = 0.0, 0.0
        for part, left in self._stages:
            self._total += _cost(part) * sum(len(runs.seed) for runs in left)
        tasks = [functools.partial(self._compile, part) for part, _ in self._stages]
        self._programs = one_ahead(tasks, self.clock)
        self._first: SlotPrograms | None = None

    def compile_first(self) -> None:
        """Waits for the programs of the first group, if any runs are left."""
        self._first = next(self._programs, None)

    def conduct(self) -> bool:
        """Trains all groups; returns whether they ended, or were interrupted."""
        for part, left in self._stages:
            programs, self._first = self._first or next(self._programs), None
            for runs in left:
                began, waited = time.perf_counter(), self.clock.compiling
                ended = self._train(part, programs, runs)
                waited = self.clock.compiling - waited
                self.clock.running += time.perf_counter() - began - waited
                if not ended:
                    return False
                self._done += _cost(part) * len(runs.seed)
        return True

    def _compile(self, part: Part) -> SlotPrograms:
        """Returns the programs of a group."""
        group = part.group
        return compile_programs(
            part.env,
            learner_builder(part.env, group.config),
            part.horizon,
            group.config,
            tuple(group.settings),
            part.widths,
            self._prepared.devices,
            self.clock,
        )

    def _train(self, part: Part, programs: SlotPrograms, runs: Runs) -> bool:
        """Trains a chunk, from its last checkpoint if there is one; returns whether it ended."""

        def show(history: History) -> None:
            self._display.show_progress(self._progress(history, _cost(part)))

        folder, say = self._files.checkpoints(runs.name), self._display.say
        chunk = Chunk(programs, part.group, runs, folder, say, show)
        say(self._heading(runs))
        if not drive(chunk, self._interrupt.heard):
            chunk.save()
            return False
        self._files.add(runs, chunk.history, chunk.actors())
        checkpoint.remove_checkpoints(folder)
        return True

    def _heading(self, runs: Runs) -> str:
        """Returns which configurations the lines that follow are of."""
        every = self._prepared.configurations
        here = [every[number] for number in np.unique(runs.configuration)]
        said = []
        for name in here[0]:
            values = [*dict.fromkeys(say(values[name]) for values in here)]
            if len(values) > _NAMED:
                values[_NAMED - 1 : -1] = ["..."]
            said.append(f"{setting_in_words(name)} {', '.join(values)}")
        count = f"{counted(len(here), 'configuration')} of {len(every):,}"
        return f"{'; '.join(said)} ({count}, {counted(len(runs.seed), 'run')})"

    def _progress(self, history: History, cost: int) -> Progress:
        """Returns how far the chunk is, but with the fraction and the time left of the sweep.

        Args:
          history: of the chunk's runs.
          cost: what a run of the chunk counts for.
        """
        now = history.progress()
        done = (self._done + cost * now.num_seeds * now.fraction) / self._total
        passed = self.clock.running + history.seconds
        left = passed * (1 - done) / done if done > 0 else float("nan")
        return now._replace(fraction=done, seconds_left=left)


def _cost(part: Part) -> int:
    """Returns what a run of a group counts for in the progress of the sweep: its budget."""
    return part.group.config.env_steps or 1

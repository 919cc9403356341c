"""Training the runs of a sweep, chunk by chunk, while the programs of the next group compile."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.reports.experiment import counted, say, setting_in_words
from mjx_reinforce.runs.display import Display
from mjx_reinforce.sweeps import chunks
from mjx_reinforce.sweeps.chunks import Chunk, ChunkRecord, Runs
from mjx_reinforce.sweeps.plan import Part, Prepared, learner_builder
from mjx_reinforce.sweeps.results import SweepFiles
from mjx_reinforce.training import checkpoint
from mjx_reinforce.training.programs import programs_of
from mjx_reinforce.training.progress import Progress
from mjx_reinforce.training.slots import Compiled, Stopwatch, compile_slots, started

#: So many values of a setting are named in a line.
_NAMED = 6


def one_ahead(tasks: Sequence[Callable[[], Any]], clock: Stopwatch) -> Iterator[Any]:
    """Yields the results of tasks in order; each begins when the one before is handed out."""
    if not tasks:
        return
    ahead = started(tasks[0])
    for task in tasks[1:]:
        result = clock.wait(ahead)
        ahead = started(task)
        yield result
    yield clock.wait(ahead)


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
        self._compiled = one_ahead(tasks, self.clock)
        self._first: Compiled | None = None

    def compile_first(self) -> None:
        """Waits for the programs of the first group, if any runs are left."""
        self._first = next(self._compiled, None)

    def conduct(self) -> bool:
        """Trains all groups; returns whether they ended, or were interrupted."""
        for part, left in self._stages:
            compiled, self._first = self._first or next(self._compiled), None
            for runs in left:
                began, waited = time.perf_counter(), self.clock.compiling
                ended = self._train(part, compiled, runs)
                waited = self.clock.compiling - waited
                self.clock.running += time.perf_counter() - began - waited
                if not ended:
                    return False
                self._done += _cost(part) * len(runs.seed)
        return True

    def _compile(self, part: Part) -> Compiled:
        """Returns the programs of a group."""
        config = part.group.config
        programs = programs_of(
            *(part.env, learner_builder(part.env, config), part.horizon, config, 1),
            tuple(part.group.settings),
            whole=False,
            division=self._prepared.division,
        )
        return compile_slots(programs, config, part.widths, self.clock)

    def _train(self, part: Part, compiled: Compiled, runs: Runs) -> bool:
        """Trains a chunk, from its last checkpoint if there is one; returns whether it ended."""

        def show(record: ChunkRecord) -> None:
            self._display.show_progress(self._progress(record, _cost(part)))

        folder, say = self._files.checkpoints(runs.name), self._display.say
        chunk = Chunk(compiled, part.group, runs, folder, say)
        say(self._heading(runs))
        if not chunk.drive(self._interrupt.heard, show):
            return False
        self._files.add(runs, chunk.record, chunk.slots.states().train_states.actor)
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

    def _progress(self, record: ChunkRecord, cost: int) -> Progress:
        """Returns how far the chunk is, but with the fraction and the time left of the sweep.

        Args:
          record: of the chunk's runs.
          cost: what a run of the chunk counts for.
        """
        now = record.progress()
        done = (self._done + cost * now.num_seeds * now.fraction) / self._total
        passed = self.clock.running + record.seconds
        left = passed * (1 - done) / done if done > 0 else float("nan")
        return now._replace(fraction=done, seconds_left=left)


def _cost(part: Part) -> int:
    """Returns what a run of a group counts for in the progress of the sweep: its budget."""
    return part.group.config.env_steps or 1

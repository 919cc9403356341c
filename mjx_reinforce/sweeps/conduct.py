"""Training the runs of a sweep, chunk by chunk, while the programs of the next group compile."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.reports.experiment import counted, say, setting_in_words
from mjx_reinforce.runs.display import Display
from mjx_reinforce.settings.config import MAX_COUNT
from mjx_reinforce.sweeps import chunks
from mjx_reinforce.sweeps.chunks import Runs, Saver
from mjx_reinforce.sweeps.design import Design
from mjx_reinforce.sweeps.history import History
from mjx_reinforce.sweeps.plan import GroupPlan, Part, Prepared, divide, learner_builder
from mjx_reinforce.sweeps.programs import SlotPrograms, Stopwatch, compile_programs, one_ahead
from mjx_reinforce.sweeps.results import SweepFiles
from mjx_reinforce.training.driver import drive
from mjx_reinforce.training.progress import Progress

#: So many values of a setting are named in a line.
_NAMED = 6


class Stage(NamedTuple):
    """The runs of one group that are still to be trained.

    part: the group
    plan: how all its runs are divided
    chunks: its runs
    """

    part: Part
    plan: GroupPlan
    chunks: list[Runs]

    @property
    def num_runs(self) -> int:
        """How many runs there are in its chunks."""
        return sum(len(runs.seed) for runs in self.chunks)

    @property
    def cost(self) -> int:
        """What a run of it counts for in the progress of the sweep: its budget."""
        return self.part.group.config.env_steps or 1


class Conductor:
    """Trains the chunks that have not ended yet; a file that cannot be written is an OSError."""

    def __init__(
        self,
        prepared: Prepared,
        design: Design,
        files: SweepFiles,
        display: Display,
        interrupt: Interrupt,
        ready: Callable[[float], None],
    ):
        """Takes what the sweep is made of.

        Args:
          prepared: its parts.
          design: what it is to do.
          files: of the sweep.
          display: its screen.
          interrupt: what listens to signals.
          ready: is called once, when the first program has been compiled, with how long that
            took (s), or when there is nothing to compile.
        """
        self._prepared, self._design = prepared, design
        self._files, self._display = files, display
        self._interrupt = interrupt
        self._ready: Callable[[float], None] | None = ready
        self._total, self._done = 0.0, 0.0
        self.clock = Stopwatch()

    def conduct(self) -> bool:
        """Trains all groups; returns whether they ended, or were interrupted."""
        stages = self._stages()
        self._total = sum(stage.cost * stage.num_runs for stage in stages)
        programs = one_ahead([functools.partial(self._compile, stage) for stage in stages])
        for stage in stages:
            began = time.perf_counter()
            compiled = next(programs)
            seconds = time.perf_counter() - began
            self.clock.compiling += seconds
            self._begin_files(seconds)
            for runs in stage.chunks:
                began, waited = time.perf_counter(), self.clock.compiling
                ended = self._train(stage, compiled, runs)
                waited = self.clock.compiling - waited
                self.clock.running += time.perf_counter() - began - waited
                if not ended:
                    return False
                self._done += stage.cost * len(runs.seed)
        self._begin_files(0.0)  # where nothing was left to do
        return True

    def _begin_files(self, seconds: float) -> None:
        """Calls ``ready``, once."""
        ready, self._ready = self._ready, None
        if ready is not None:
            ready(seconds)

    def _stages(self) -> list[Stage]:
        """Returns the runs that are still to be trained."""
        made, devices = [], self._prepared.devices.count
        for number, part in enumerate(self._prepared.parts):
            plan = divide(part.group, part.limit, devices, exact=self._design.exact)
            every = chunks.split_runs(part.group, f"{number:03d}", plan.num_chunks)
            left = [runs for runs in every if not self._files.has(runs.name)]
            made.append(Stage(part, plan, left))
        return [stage for stage in made if stage.chunks]

    def _compile(self, stage: Stage) -> SlotPrograms:
        """Returns the programs of a group."""
        group, env, horizon, _ = stage.part
        return compile_programs(
            env,
            learner_builder(env, group.config),
            horizon,
            group.config,
            tuple(group.settings),
            stage.plan.widths,
            self._prepared.devices,
            self.clock,
        )

    def _train(self, stage: Stage, programs: SlotPrograms, runs: Runs) -> bool:
        """Trains a chunk, from its last checkpoint if there is one; returns whether it ended."""
        config = dataclasses.replace(stage.part.group.config, num_seeds=len(runs.seed))
        history, layout = History(config), programs.layout
        saver = Saver(self._files.checkpoints(runs.name), config, layout, self._display.say)
        states = saver.find(layout.shapes(len(runs.seed)), history)
        if states is None:
            states = chunks.initial_states(programs, stage.part.group, runs)
        self._display.say(self._heading(runs))

        def show() -> None:
            self._display.show_progress(self._progress(history, stage.cost))

        observers = [show, lambda: saver.save_if_due(states, history)]
        most = (config.checkpoint_every or MAX_COUNT) // config.eval_every
        chunk = chunks.Chunk(programs, states, history, observers, most)
        if not drive(chunk, self._interrupt.heard):
            saver.save(states, history)
            return False
        self._files.keep_policies(runs, history, layout.states(states).train_states.actor)
        self._files.add(runs, history)
        saver.remove()
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

    def _part_done(self, more: float = 0.0) -> float:
        """Returns the part of the whole sweep that is done.

        It counts the budgets of all runs: those that lie aside cost nothing.

        Args:
          more: what of the present chunk is done.
        """
        return (self._done + more) / self._total if self._total else 0.0

    def _progress(self, history: History, cost: int) -> Progress:
        """Returns how far the chunk is, or the whole sweep where that differs."""
        now = history.progress()
        done = self._part_done(cost * now.num_seeds * now.fraction)
        passed = self.clock.running + history.seconds
        left = passed * (1 - done) / done if done > 0 else float("nan")
        return now._replace(fraction=done, seconds_left=left)

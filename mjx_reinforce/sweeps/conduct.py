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
from mjx_reinforce.runs.plan import duration, is_wrong
from mjx_reinforce.settings.config import MAX_COUNT
from mjx_reinforce.sweeps import chunks
from mjx_reinforce.sweeps.ahead import Stopwatch, one_ahead
from mjx_reinforce.sweeps.chunks import Runs, Saver
from mjx_reinforce.sweeps.designs.design import Design
from mjx_reinforce.sweeps.designs.groups import Group, learner_builder
from mjx_reinforce.sweeps.designs.plan import GroupPlan, Prepared, divide, group_seconds
from mjx_reinforce.sweeps.history import History
from mjx_reinforce.sweeps.programs import SlotPrograms, compile_programs
from mjx_reinforce.sweeps.results import SweepFiles
from mjx_reinforce.training.driver import drive
from mjx_reinforce.training.progress import Progress

#: More than this share of a sweep is all of it, up to rounding.
_ALL = 1 - 1e-6
#: So many values of a setting are named in a line.
_NAMED = 6


class Stage(NamedTuple):
    """The runs of one group.

    number: of the group in the sweep
    group: its configurations
    chunks: its runs
    """

    number: int
    group: Group
    chunks: list[Runs]

    @property
    def num_runs(self) -> int:
        """How many runs there are in its chunks."""
        return sum(len(runs.seed) for runs in self.chunks)


class Conductor:
    """Trains the chunks that have not ended yet; a file that cannot be written is an OSError."""

    def __init__(
        self,
        prepared: Prepared,
        design: Design,
        files: SweepFiles,
        display: Display,
        interrupt: Interrupt | None,
        ready: Callable[[float], None],
    ):
        """Takes what the sweep is made of.

        Args:
          prepared: its parts.
          design: what it is to do.
          files: of the sweep.
          display: its screen.
          interrupt: what listens to signals, if anything does.
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
        said = {stage.number: self._seconds(stage) for stage in stages}
        each = {number: 1.0 if seconds is None else seconds for number, seconds in said.items()}
        self._total = sum(each[stage.number] * stage.num_runs for stage in stages)
        programs = one_ahead([functools.partial(self._compile, stage) for stage in stages])
        for stage in stages:
            began = time.perf_counter()
            compiled = next(programs)
            seconds = time.perf_counter() - began
            self.clock.compiling += seconds
            self._begin_files(seconds)
            before = self.clock.running
            for runs in stage.chunks:
                began, waited = time.perf_counter(), self.clock.compiling
                ended = self._train(stage, compiled, runs, each[stage.number])
                waited = self.clock.compiling - waited
                self.clock.running += time.perf_counter() - began - waited
                if not ended:
                    return False
                self._done += each[stage.number] * len(runs.seed)
            self._correct(said[stage.number], stage.num_runs, self.clock.running - before)
        self._begin_files(0.0)  # where nothing was left to do
        return True

    def _begin_files(self, seconds: float) -> None:
        """Calls ``ready``, once."""
        ready, self._ready = self._ready, None
        if ready is not None:
            ready(seconds)

    def _seconds(self, stage: Stage) -> float | None:
        """Returns about how long a run of a stage takes (s), None where that is not known."""
        prepared, group = self._prepared, stage.group
        env = prepared.envs[stage.number]
        seconds = group_seconds(
            env, prepared.horizons[stage.number], prepared.engine, group, prepared.devices.count
        )
        runs = len(group.members) * group.config.num_seeds
        return None if seconds is None else seconds / runs

    def _correct(self, said: float | None, num_runs: int, took: float) -> None:
        """Says what the rest takes, if the runs that ended took quite another time than was said.

        A sweep that goes on may have trained a part of them before.
        """
        done, resumed = self._part_done(), self._design.resume is not None
        if said is None or resumed or done > _ALL or not is_wrong(said * num_runs, took):
            return
        left = duration(self.clock.running * (1 - done) / done)
        self._display.say(
            f"{num_runs:,} runs took {duration(took)}, not about {duration(said * num_runs)} as "
            f"was said: the rest takes about {left}",
            "yellow",
        )

    def _stages(self) -> list[Stage]:
        """Returns the runs that are still to be trained."""
        made = []
        for number, group in enumerate(self._prepared.groups):
            parts = chunks.split_runs(group, f"{number:03d}", self._divide(number).num_chunks)
            left = [runs for runs in parts if not self._files.has(runs.name)]
            made.append(Stage(number, group, left))
        return [stage for stage in made if stage.chunks]

    def _divide(self, number: int) -> GroupPlan:
        """Returns how the runs of a group are divided."""
        prepared = self._prepared
        group, limit, devices = prepared.groups[number], prepared.limits[number], prepared.devices
        return divide(group, limit, devices.count, exact=self._design.exact)

    def _compile(self, stage: Stage) -> SlotPrograms:
        """Returns the programs of a group."""
        env, config = self._prepared.envs[stage.number], stage.group.config
        return compile_programs(
            env,
            learner_builder(env, config),
            self._prepared.horizons[stage.number],
            config,
            tuple(stage.group.settings),
            self._divide(stage.number).widths,
            self._prepared.devices,
            self.clock,
        )

    def _train(self, stage: Stage, programs: SlotPrograms, runs: Runs, each: float) -> bool:
        """Trains a chunk, from its last checkpoint if there is one; returns whether it ended.

        ``each`` is what a run of it takes, as ``_part_done`` counts.
        """
        config = dataclasses.replace(stage.group.config, num_seeds=len(runs.seed))
        history, layout = History(config), programs.layout
        saver = Saver(self._files.checkpoints(runs.name), config, layout, self._display.say)
        states = saver.find(layout.shapes(len(runs.seed)), history)
        if states is None:
            states = chunks.initial_states(programs, stage.group, runs)
        self._display.say(self._heading(runs))

        def show() -> None:
            self._display.show_progress(self._progress(history, each))

        observers = [show, lambda: saver.save_if_due(states, history)]
        most = (config.checkpoint_every or MAX_COUNT) // config.eval_every
        chunk = chunks.Chunk(programs, states, history, observers, most)
        if not drive(chunk, self._interrupted):
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

    def _interrupted(self) -> bool:
        return self._interrupt is not None and self._interrupt.number is not None

    def _part_done(self, more: float = 0.0) -> float:
        """Returns the part of the whole sweep that is done.

        It counts the budgets of all runs by the time that they were said to take, or alike where
        that is not known: those that lie aside cost nothing.

        Args:
          more: what of the present chunk is done.
        """
        return (self._done + more) / self._total if self._total else 0.0

    def _progress(self, history: History, each: float) -> Progress:
        """Returns how far the chunk is, or the whole sweep where that differs."""
        now = history.progress()
        done = self._part_done(each * now.num_seeds * now.fraction)
        passed = self.clock.running + history.seconds
        left = passed * (1 - done) / done if done > 0 else float("nan")
        return now._replace(fraction=done, seconds_left=left)

"""Training runs, chunk by chunk, while the programs of the next group compile."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np

from mjx_reinforce.learning import counts
from mjx_reinforce.reports.experiment import counted, say, setting_in_words
from mjx_reinforce.runs.display import Display
from mjx_reinforce.runs.plan import Part, Prepared
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.store.ready import Ready
from mjx_reinforce.training.checkpoint import Checkpoint
from mjx_reinforce.training.driver import Driver, Observer, Training, check_layout
from mjx_reinforce.training.progress import HOPELESS, Progress
from mjx_reinforce.training.record import ChunkRecord, RunRecord, Runs
from mjx_reinforce.training.slots import Compiled, Slots, Stopwatch, compile_slots, started
from mjx_reinforce.training.state import Budget, begin_with, budget_of, last_actors


class Conductor(Observer[Training]):
    """Trains the chunks that have not ended yet, and lets observers see them."""

    def __init__(
        self,
        prepared: Prepared,
        files: Files[Any] | None,
        display: Display,
        observers: Sequence[Observer[Any]],
    ):
        """Takes what is trained.

        Args:
          prepared: what a run or a sweep is made of.
          files: of it, if it has any.
          display: its screen.
          observers: who sees it, besides these.
        """
        self._prepared, self._files, self._display = prepared, files, display
        written = [] if files is None else [files]
        self._observers = [*written, display if prepared.alone else self, *observers]
        self._clock = Stopwatch()
        #: The groups that have runs to be trained, and these in chunks.
        self._stages: list[tuple[Part, list[Runs]]] = []
        for part in prepared.parts:
            if left := [x for x in part.chunks if not (files is not None and files.has(x.name))]:
                self._stages.append((part, left))
        self._done, self._total = 0.0, 0.0
        for part, left in self._stages:
            self._total += _cost(part) * sum(len(runs.seed) for runs in left)
        #: The programs of the group that is next.
        self._next: Future[Compiled] = Future()

    def compile_first(self) -> None:
        """Compiles the programs of the first group, if any runs are left, as the caller would."""
        if self._stages:
            began = time.perf_counter()
            self._next.set_result(self._compile(self._stages[0][0]))
            self._clock.compiling += time.perf_counter() - began

    def conduct(self, interrupted: Callable[[], bool]) -> tuple[Training | None, dict[str, Any]]:
        """Trains all groups, to their end or until they are interrupted.

        Returns:
          The runs that were trained last, if any were, and the contents of the last file.

        Raises:
          OSError: the first or the last files cannot be written.
        """
        if self._files is not None:
            self._files.open()
        self._display.start(self._seconds())
        driver, ended = None, True
        for part, runs, compiled in self._chunks():
            began, waited = time.perf_counter(), self._clock.compiling
            driver = self._begin(part, runs, compiled, interrupted)
            driver.drive(interrupted)
            for observer in self._observers:
                observer.ended(driver)
            waited = self._clock.compiling - waited
            self._clock.running += time.perf_counter() - began - waited
            ended = driver.record.done()
            if not ended:
                break
            self._done += _cost(part) * len(runs.seed)
        if isinstance(driver, Driver):
            # A signal after that changes nothing: what is left takes a second or two.
            test, engine = driver.test(interrupted), self._prepared.parts[0].ready.engine
            summary = summary_of(driver, engine, self._seconds(), test)
        else:
            assert self._files is not None
            summary = dict(self._files.contents, status="finished" if ended else "interrupted")
            summary["compile_seconds"] += self._seconds()
            summary["run_seconds"] += self._clock.running
        for observer in self._observers:
            observer.finished(driver, summary)
        return driver, summary

    def updated(self, driver: Training, met: np.ndarray) -> None:
        """Shows how far a sweep is."""
        self._display.show_progress(self._progress(driver))

    def _seconds(self) -> float:
        """Returns the wall time that compiling took so far."""
        return self._prepared.engine_seconds + self._clock.compiling

    def _compile(self, part: Part) -> Compiled:
        """Returns the programs of a group."""
        programs, config = part.ready.programs(), part.group.config
        return compile_slots(programs, config, part.widths, self._clock)

    def _chunks(self) -> Iterator[tuple[Part, Runs, Compiled]]:
        """Yields the chunks that are left, with the programs of their group."""
        for number, (part, left) in enumerate(self._stages, start=1):
            compiled = self._clock.wait(self._next)
            for following, _ in self._stages[number : number + 1]:
                self._next = started(functools.partial(self._compile, following))
            for runs in left:
                yield part, runs, compiled

    def _begin(
        self, part: Part, runs: Runs, compiled: Compiled, interrupted: Callable[[], bool]
    ) -> Training:
        """Returns the runs of a chunk where they go on; says which they are."""
        config = dataclasses.replace(part.group.config, num_seeds=len(runs.seed))
        settings = {name: values[runs.place] for name, values in part.group.settings.items()}
        slots = Slots(compiled, runs.seed, settings)
        if self._prepared.alone:
            found, say = self._prepared.found, self._display.say
            driver = begin_run(config, part.ready, slots, found, say, self._observers, interrupted)
        else:
            driver = Training(config, slots, ChunkRecord(config, runs), self._observers)
        for observer in self._observers:
            observer.began(driver)
        if not self._prepared.alone:
            self._display.say(self._heading(runs))
        return driver

    def _heading(self, runs: Runs) -> str:
        """Returns which configurations the lines that follow are of."""
        every = self._prepared.design.configurations()
        here = [every[number] for number in np.unique(runs.configuration)]
        values = {name: [*dict.fromkeys(say(values[name]) for values in here)] for name in here[0]}
        count = f"{counted(len(here), 'configuration')} of {len(every):,}"
        few = {name: x if len(x) < 5 else (x[0], "...", x[-1]) for name, x in values.items()}
        said = (f"{setting_in_words(name)} {', '.join(x)}" for name, x in few.items())
        return f"{'; '.join(said)} ({count}, {counted(len(runs.seed), 'run')})"

    def _progress(self, driver: Training) -> Progress:
        """Returns how far a chunk is, but with the fraction and the time left of the sweep."""
        now, cost = driver.record.progress(), driver.config.env_steps or 1
        done = (self._done + cost * now.num_seeds * now.fraction) / self._total
        passed = self._clock.running + driver.record.seconds
        left = passed * (1 - done) / done if done > 0 else float("nan")
        return now._replace(fraction=done, seconds_left=left)


def _cost(part: Part) -> int:
    """Returns what a run of a group counts for in the progress of the sweep: its budget."""
    return part.group.config.env_steps or 1


def begin_run(
    config: Config,
    ready: Ready,
    slots: Slots,
    found: Checkpoint | None = None,
    say: Callable[[str], None] = lambda text: None,
    observers: Sequence[Observer[Any]] = (),
    interrupted: Callable[[], bool] = lambda: False,
) -> Driver:
    """Returns a run before its first update.

    Args:
      config: its settings.
      ready: what it is made of.
      slots: its seeds.
      found: the checkpoint from which it goes on, if any; an observer takes it back there.
      say: shows a line to the user.
      observers: who sees it.
      interrupted: whether it is to end soon.
    """
    if found is not None:
        check_layout(found, slots)  # before a file is touched
    if config.init_from is not None and found is None:
        slots.restore(begin_with(slots.states(), last_actors(config, ready.policy)))
    if config.minutes is not None:
        first = slots.rows()
        if found is not None:
            slots.restore(found.states)
        env_steps = env_steps_in(60 * config.minutes, slots, config, interrupted)
        slots.restore(first)
        say(f"{config.minutes:g} min are about {env_steps:,} env steps per seed here")
        config = dataclasses.replace(config, env_steps=env_steps, minutes=None)
    slots.budget = budget_of(config)
    config = dataclasses.replace(config, horizon=ready.horizon)
    return Driver(config, slots, RunRecord(config, ready.threshold), observers)


#: The part of the time in which its speed is measured; what is trained in it is trained again.
_PART = 0.03


def env_steps_in(
    seconds: float, slots: Slots, config: Config, interrupted: Callable[[], bool] = lambda: False
) -> int:
    """Returns the env steps that a mean seed will have played in all after a time.

    The seeds are trained, and evaluated, for a small part of that time. The speed of the second
    half of that part counts: the first updates also have what a device does once, and the shortest
    episodes.

    Args:
      seconds: the time.
      slots: the seeds, where the run goes on.
      config: the settings.
      interrupted: whether the first update of the trial is to be the last.
    """
    most = MAX_COUNT if config.max_updates is None else config.max_updates
    began, past = time.perf_counter(), [(0.0, *_played(slots))]
    while past[-1][0] < _PART * seconds and not (past[1:] and interrupted()):
        slots.budget = Budget.of(None, min(past[-1][2] + 2 ** (len(past) - 1), most))
        if not slots.advance(look=False):
            break  # no seed has an update left
        past.append((time.perf_counter() - began, *_played(slots)))
    if len(past) == 1:
        return max(1, round(past[0][1]))
    end, played, updates = past[-1]
    half, before, made = next((x for x in past[1:-1] if x[0] >= end / 2), past[-2])
    a_block = config.block_length * (end - half) / (updates - made)
    evaluating = slots.seconds_to_evaluate()
    speed = (played - before) / (end - half) * a_block / (a_block + evaluating)
    left = max(seconds - end - evaluating, 0.0)
    return min(max(1, round(past[0][1] + speed * left)), MAX_COUNT)


def _played(slots: Slots) -> tuple[float, int]:
    """Returns the env steps of the mean seed, and the updates of the seed with the most."""
    states = slots.states().train_states
    updates = counts.to_int(states.num_updates)
    return float(counts.to_int(states.env_steps).mean()), int(updates.max())


def summary_of(
    driver: Driver, engine: str, compile_seconds: float, test: dict[str, Any]
) -> dict[str, Any]:
    """Returns the contents of summary.json.

    Args:
      driver: of the run, at its end.
      engine: the name of the engine that played.
      compile_seconds: wall time of compiling.
      test: from ``Driver.test``, empty if the run was interrupted.
    """
    record, seconds = driver.record, driver.seconds()
    end = {"status": "stopped", "reason": HOPELESS} if record.hopeless() else {"status": "finished"}
    return {
        **(end if test else {"status": "interrupted"}),
        **record.summary(engine, compile_seconds, seconds),
        "best_updates": counts.to_int(driver.best.num_updates).tolist(),
        **test,
    }

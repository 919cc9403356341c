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
from mjx_reinforce.training.driver import Driver, Observer, Runs, Training, check_layout
from mjx_reinforce.training.record import HOPELESS, Record, RunRecord
from mjx_reinforce.training.resume import Checkpoint
from mjx_reinforce.training.slots import Compiled, Slots, compile_slots, started
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
        self._clock = prepared.clock
        #: The groups that have runs to be trained, and these in chunks.
        self._stages: list[tuple[Part, list[Runs]]] = []
        for part in prepared.parts:
            if left := [x for x in part.chunks if not (files is not None and files.has(x.name))]:
                self._stages.append((part, left))
        #: Runs that have ended here, what checkpoints brought of them, and of how many.
        self._done, self._brought = 0, 0.0
        self._total = sum(len(x.seed) for _, left in self._stages for x in left)
        #: The programs of the group that is next.
        self._next: Future[Compiled] = Future()

    def compile_first(self) -> None:
        """Compiles the programs of the first group, if any runs are left, as the caller would."""
        if self._stages:
            self._next.set_result(self._compile(self._stages[0][0]))
        self._clock.compiling = time.perf_counter() - self._clock.began

    def conduct(self, interrupted: Callable[[], bool]) -> tuple[Training | None, dict[str, Any]]:
        """Trains all groups, to their end or until they are interrupted.

        Returns:
          The runs that were trained last, if any were, and the contents of the last file.

        Raises:
          OSError: the first or the last files cannot be written.
        """
        if self._files is not None:
            self._files.open()
        self._display.start(self._clock.compiling)
        driver, ended = None, True
        for part, runs, compiled in self._chunks():
            driver = self._begin(part, runs, compiled, interrupted)
            driver.drive(interrupted)
            for observer in self._observers:
                observer.ended(driver)
            ended = driver.record.done()
            if not ended:
                break
            self._done += len(runs.seed)
        if isinstance(driver, Driver):
            # A signal after that changes nothing: what is left takes a second or two.
            test, engine = driver.test(interrupted), self._prepared.parts[0].ready.engine
            summary = summary_of(driver, engine, self._clock.compiling, test)
        else:
            assert self._files is not None
            summary = dict(self._files.contents, status="finished" if ended else "interrupted")
            summary["compile_seconds"] += self._clock.compiling
            summary["run_seconds"] += self._clock.running()
        for observer in self._observers:
            observer.finished(driver, summary)
        return driver, summary

    def began(self, driver: Training) -> None:
        """Remembers how far a sweep's runs are that go on."""
        self._brought += np.minimum(driver.record.used(), 1.0).sum()

    def updated(self, driver: Training, met: np.ndarray) -> None:
        """Shows how far a sweep is."""
        done = self._done + np.minimum(driver.record.used(), 1.0).sum()
        fraction, gained = float(done / self._total), float(done - self._brought) / self._total
        now = driver.record.measure(fraction, driver.seconds(), gained, self._clock.running())
        self._display.show_progress(now)

    def _compile(self, part: Part) -> Compiled:
        """Returns the programs of a group."""
        return compile_slots(part.ready.programs(), part.group.config, part.width)

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
        slots, say = Slots(compiled, runs.seed, settings), self._display.say
        if self._prepared.alone:
            given = config, part.ready, slots, runs, self._prepared.found, say
            driver = begin_run(*given, self._observers, interrupted)
        else:
            driver = Training(config, slots, Record(config), runs, self._observers)
        for observer in self._observers:
            observer.began(driver)
        if not self._prepared.alone:
            say(self._heading(runs))
        return driver

    def _heading(self, runs: Runs) -> str:
        """Returns which configurations the lines that follow are of."""
        every = self._prepared.design.configurations
        here = [every[number] for number in np.unique(runs.configuration)]
        values = {name: [*dict.fromkeys(say(values[name]) for values in here)] for name in here[0]}
        count = f"{counted(len(here), 'configuration')} of {len(every):,}"
        few = {name: x if len(x) < 5 else (x[0], "...", x[-1]) for name, x in values.items()}
        said = (f"{setting_in_words(name)} {', '.join(x)}" for name, x in few.items())
        return f"{'; '.join(said)} ({count}, {counted(len(runs.seed), 'run')})"


def begin_run(
    config: Config,
    ready: Ready,
    slots: Slots,
    runs: Runs,
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
      runs: the same, by their numbers.
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
    return Driver(config, slots, RunRecord(config, ready.threshold), runs, observers)


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

"""Training runs, chunk by chunk, while the programs of the next group compile."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.runs.display import Display, SweepScreen
from mjx_reinforce.runs.plan import Part, Prepared
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.store.ready import Ready
from mjx_reinforce.training.driver import Driver, Observer, Runs, Training, check_layout
from mjx_reinforce.training.record import HOPELESS, Record, RunRecord
from mjx_reinforce.training.resume import Checkpoint
from mjx_reinforce.training.slots import Compiled, Slots, Stopwatch, compile_slots, started
from mjx_reinforce.training.state import Budget, begin_with, budget_of


def conduct(
    prepared: Prepared,
    files: Files[Any] | None,
    display: Display,
    observers: Sequence[Observer[Any]],
    interrupt: Interrupt,
) -> tuple[Training | None, dict[str, Any]]:
    """Trains the chunks that have not ended yet, to their end or until they are interrupted.

    Args:
      prepared: what a run or a sweep is made of.
      files: of it, if it has any.
      display: its screen.
      observers: who sees it, besides these.
      interrupt: what listens to signals.

    Returns:
      The runs that were trained last, if any were, and the contents of the last file.

    Raises:
      OSError: the first or the last files cannot be written.
    """
    written = [] if files is None else [files]
    left = [
        part._replace(chunks=[x for x in part.chunks if not any(f.has(x.name) for f in written)])
        for part in prepared.parts
    ]
    screen = display if prepared.alone else SweepScreen(display, prepared, left)
    everyone, clock = [*written, screen, *observers], prepared.clock
    chunks = _compiled([part for part in left if part.chunks], clock)
    first = [*itertools.islice(chunks, 1)]
    clock.compiling = time.perf_counter() - clock.began
    # Not before: a kill while it compiles leaves nothing that would refuse the next.
    interrupt.defer(display.say)
    for each in written:
        each.open()
    display.start(clock.compiling)
    driver = None
    for part, runs, compiled in itertools.chain(first, chunks):
        config = dataclasses.replace(part.group.config, num_seeds=len(runs.seed))
        settings = {name: values[runs.place] for name, values in part.group.settings.items()}
        slots = Slots(compiled, runs.seed, settings)
        if prepared.alone:
            given = config, part.ready, slots, runs, prepared.found, prepared.actors
            driver = begin_run(*given, display.say, everyone, interrupt.heard)
        else:
            driver = Training(config, slots, Record(config), runs, everyone)
        for observer in everyone:
            observer.began(driver)
        driver.drive(interrupt.heard)
        for observer in everyone:
            observer.ended(driver)
        if not driver.record.done():
            break
    if isinstance(driver, Driver):
        # A signal after that changes nothing: what is left takes a second or two.
        test, engine = driver.test(interrupt.heard), prepared.parts[0].ready.engine
        summary = summary_of(driver, engine, clock.compiling, test)
    else:
        assert files is not None
        ended = driver is None or driver.record.done()
        summary = dict(files.contents, status="finished" if ended else "interrupted")
        summary["compile_seconds"] += clock.compiling
        summary["run_seconds"] += clock.running()
    for observer in everyone:
        observer.finished(driver, summary)
    return driver, summary


def _compiled(parts: Sequence[Part], clock: Stopwatch) -> Iterator[tuple[Part, Runs, Compiled]]:
    """Yields chunks with the programs of their group; those of the next compile meanwhile."""
    waiting = [functools.partial(_compile, part) for part in parts[:1]]
    for number, part in enumerate(parts, start=1):
        compiled = clock.wait(waiting.pop())
        following = [functools.partial(_compile, later) for later in parts[number : number + 1]]
        waiting = [started(task).result for task in following]
        for runs in part.chunks:
            yield part, runs, compiled


def _compile(part: Part) -> Compiled:
    """Returns the programs of a group."""
    return compile_slots(part.ready.programs(), part.group.config, part.width)


def begin_run(
    config: Config,
    ready: Ready,
    slots: Slots,
    runs: Runs,
    found: Checkpoint | None = None,
    actors: Actor | None = None,
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
      actors: [S, ...] with which it begins, if not with its own.
      say: shows a line to the user.
      observers: who sees it.
      interrupted: whether it is to end soon.
    """
    if found is not None:
        check_layout(found, slots)  # before a file is touched
    if actors is not None:
        slots.restore(begin_with(slots.states(), actors))
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

"""Training runs, chunk by chunk, while the programs of the next group compile."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator, Sequence
from typing import Any

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.runs.display import Display, SweepScreen
from mjx_reinforce.runs.plan import Part, Plan
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.setup.compile_times import keep_seconds
from mjx_reinforce.training.driver import Driver, Observer, RunDriver, Runs, begin_run
from mjx_reinforce.training.record import Record
from mjx_reinforce.training.slots import Compiled, Slots, Stopwatch, compile_slots, started


def conduct(
    plan: Plan,
    files: Files[Any] | None,
    display: Display,
    observers: Sequence[Observer[Any]],
    interrupt: Interrupt,
) -> tuple[Driver | None, dict[str, Any]]:
    """Trains the chunks that have not ended yet, to their end or until they are interrupted.

    Args:
      plan: what a run or a sweep is made of.
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
        for part in plan.parts
    ]
    screen = display if plan.alone else SweepScreen(display, plan, left)
    everyone, clock = [*written, screen, *observers], plan.clock
    chunks = _compiled([part for part in left if part.chunks], clock)
    chunks = itertools.chain([*itertools.islice(chunks, 1)], chunks)  # compiles the first
    clock.compiling = time.perf_counter() - clock.began
    # Where others compute beside this, what it computed itself is nearer to a quiet machine's time.
    quiet = min(clock.compiling, time.process_time() - clock.computed)
    if any(part.chunks for part in left):
        keep_seconds(plan.design.configs[0], plan.design.over, quiet)
    # Not before: a kill while it compiles leaves nothing that would refuse the next.
    interrupt.defer(display.say)
    for each in written:
        each.open()
    display.start(clock.compiling)
    driver = None
    for part, runs, compiled in chunks:
        config = dataclasses.replace(part.group.config, num_seeds=len(runs.seed))
        settings = {name: values[runs.member] for name, values in part.group.settings.items()}
        slots = Slots(compiled, runs.seed, settings)
        if plan.alone:
            given = config, part.ready.threshold, slots, runs, plan.found, plan.actors
            driver = begin_run(*given, display.say, everyone, interrupt.heard)
        else:
            driver = Driver(config, slots, Record(config), runs, everyone)
        for observer in everyone:
            observer.began(driver)
        driver.drive(interrupt.heard)
        for observer in everyone:
            observer.ended(driver)
        if not driver.record.done():
            break
    if isinstance(driver, RunDriver):
        # A signal after that changes nothing: what is left takes a second or two.
        test, engine = driver.test(interrupt.heard), plan.parts[0].ready.engine
        summary = driver.summary(engine, clock.compiling, test)
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

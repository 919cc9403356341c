"""Training runs, chunk by chunk, while the programs of the next group compile."""

import dataclasses
import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from mjx_reinforce.console.interrupt import Interrupt
from mjx_reinforce.runs.compile_times import keep_seconds
from mjx_reinforce.runs.display import Display, SweepScreen
from mjx_reinforce.runs.plan import GroupPlan, Plan
from mjx_reinforce.runs.saving import Files
from mjx_reinforce.training.driver import (
    Driver,
    Observer,
    RunDriver,
    Runs,
    begin_run,
    sweep_summary,
)
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
      files: of the run or sweep. A sweep always has some; a run has None if it is to leave nothing.
      display: its screen.
      observers: who sees it, besides these.
      interrupt: what listens to signals.

    Returns:
      The runs that were trained last, if any were, and the contents of the last file.

    Raises:
      OSError: the first or the last files cannot be written.
    """
    # No loop below runs for the files of a run that leaves none.
    own_files = [] if files is None else [files]
    screen = display
    if plan.design.is_sweep:
        screen = SweepScreen(display, plan, _unfinished(plan.group_plans, own_files))
    # The files are first: an error of theirs ends the run before a user's function sees an
    # evaluation that is nowhere on the disk.
    all_observers = [*own_files, screen, *observers]
    clock = plan.clock
    compiled_chunks = _first_compiled(_unfinished_stages(plan, files), plan)
    # Not before: a kill while it compiles leaves nothing that would refuse the next.
    interrupt.defer(display.say)
    for run_files in own_files:
        run_files.open()
    display.start(clock.compiling)
    driver = None
    for group_plan, runs, compiled_programs in compiled_chunks:
        driver = _begin(
            plan,
            group_plan,
            runs,
            compiled_programs,
            say=display.say,
            observers=all_observers,
            interrupted=interrupt.heard,
        )
        for observer in all_observers:
            observer.began(driver)
        driver.drive(interrupt.heard)
        for observer in all_observers:
            observer.ended(driver)
        # A chunk that is not done was interrupted, and so is what would follow it.
        if not driver.record.done():
            break
    if plan.design.is_sweep:
        assert files is not None
        summary = sweep_summary(files.contents, driver, clock) | files.outcome()
    else:
        assert isinstance(driver, RunDriver)
        # A signal after that changes nothing: what is left takes a second or two.
        test_metrics = driver.test(interrupt.heard)
        summary = driver.summary(plan.group_plans[0].ready.engine, clock.compiling, test_metrics)
    for observer in all_observers:
        observer.finished(driver, summary)
    return driver, summary


def _unfinished_stages(plan: Plan, files: Files[Any] | None) -> Iterator[list[GroupPlan]]:
    """Yields what is left to train of each stage, once those before have ended."""
    if files is None:
        yield plan.group_plans
        return
    for group_plans in files.stages():
        yield _unfinished(group_plans, [files])


def _unfinished(group_plans: Sequence[GroupPlan], own_files: Sequence[Files]) -> list[GroupPlan]:
    """Returns the groups of which some chunks have not ended yet, with these chunks alone."""
    unfinished_groups = []
    for group_plan in group_plans:
        chunks = [x for x in group_plan.chunks if not any(files.has(x.name) for files in own_files)]
        if chunks:
            unfinished_groups.append(group_plan._replace(stages=[chunks]))
    return unfinished_groups


def _begin(
    plan: Plan,
    group_plan: GroupPlan,
    runs: Runs,
    compiled_programs: Compiled,
    *,
    say: Callable[[str], None],
    observers: Sequence[Observer[Any]],
    interrupted: Callable[[], bool],
) -> Driver:
    """Returns the runs of a chunk before their first update.

    Args:
      plan: of the run or the sweep.
      group_plan: of the chunk's group.
      runs: of the chunk.
      compiled_programs: the programs of the group.
      say: shows a line to the user.
      observers: who sees the runs.
      interrupted: whether they are to end soon.
    """
    group = group_plan.group
    # The number of seeds is here that of the chunk's runs, whatever configuration each is of.
    num_seeds = len(runs.seed) // group.config.race
    config = dataclasses.replace(group.config, num_seeds=num_seeds)
    settings = {name: values[runs.member] for name, values in group.settings.items()}
    slots = Slots(compiled_programs, runs.seed, settings)
    if plan.design.is_sweep:
        return Driver(config, slots, Record(config), runs, observers=observers)
    return begin_run(
        config,
        group_plan.ready.threshold,
        slots,
        runs,
        plan.checkpoint,
        actors=plan.actors,
        say=say,
        observers=observers,
        interrupted=interrupted,
    )


def _compiled(
    group_plans: Sequence[GroupPlan],
    clock: Stopwatch,
    compile: Callable[[GroupPlan], Compiled],
) -> Iterator[tuple[GroupPlan, Runs, Compiled]]:
    """Yields chunks with the programs of their group; those of the next compile meanwhile."""
    # A list with the task of the group that is next, or with none behind the last one.
    compilations = [functools.partial(compile, group_plan) for group_plan in group_plans[:1]]
    for group_number, group_plan in enumerate(group_plans, start=1):
        compiled_programs = clock.wait(compilations.pop())
        # One group ahead, and not all: compiling takes memory and cores from what trains.
        next_compilations = [
            functools.partial(compile, next_plan)
            for next_plan in group_plans[group_number : group_number + 1]
        ]
        compilations = [started(compilation).result for compilation in next_compilations]
        for runs in group_plan.chunks:
            yield group_plan, runs, compiled_programs


def _compiled_stages(
    stages: Iterable[Sequence[GroupPlan]], plan: Plan
) -> Iterator[tuple[GroupPlan, Runs, Compiled]]:
    """Yields ``_compiled`` of each stage; if there may be several, groups keep their programs."""
    programs: dict[int, Compiled] = {}

    def compile(group_plan: GroupPlan) -> Compiled:
        """Returns the programs of a group, those that it kept if it has some."""
        group_number = int(group_plan.group.members[0])
        if group_number in programs:
            return programs[group_number]
        compiled_programs = _compile(group_plan)
        if plan.design.until_decided:
            programs[group_number] = compiled_programs
        return compiled_programs

    for group_plans in stages:
        yield from _compiled(group_plans, plan.clock, compile)


def _first_compiled(
    stages: Iterable[Sequence[GroupPlan]], plan: Plan
) -> Iterator[tuple[GroupPlan, Runs, Compiled]]:
    """Returns ``_compiled`` of stages, whose first programs are compiled now, before anything runs.

    How long that took is on the plan's clock, and kept for the forecast of later runs.
    """
    clock = plan.clock
    compiled_chunks = _compiled_stages(stages, plan)
    # A generator does nothing before it is asked: the first chunk is taken from it, and put back.
    first_chunks = [*itertools.islice(compiled_chunks, 1)]
    compiled_chunks = itertools.chain(first_chunks, compiled_chunks)
    clock.compiling = time.perf_counter() - clock.began
    # Where others compute beside this, what it computed itself is nearer to a quiet machine's time.
    quiet_seconds = min(clock.compiling, time.process_time() - clock.computed)
    if first_chunks:
        keep_seconds(plan.design.configs[0], plan.design.over, quiet_seconds)
    return compiled_chunks


def _compile(group_plan: GroupPlan) -> Compiled:
    """Returns the programs of a group."""
    return compile_slots(group_plan.ready.programs(), group_plan.group.config, group_plan.width)

"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import contextlib
import dataclasses
import gc
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import tyro

from mjx_reinforce import envs
from mjx_reinforce.registry import check_name
from mjx_reinforce.runs.alarms import silence_alarms
from mjx_reinforce.runs.build import build, policy_settings
from mjx_reinforce.runs.config import Config, check
from mjx_reinforce.runs.defaults import named_task, of_task
from mjx_reinforce.runs.files import prepare
from mjx_reinforce.runs.memory import check_size
from mjx_reinforce.runs.plan import Plan, make_plan
from mjx_reinforce.runs.presets import PRESETS
from mjx_reinforce.runs.settings import GROUPS

_FILES = (
    "config.json",
    "metrics.csv",
    "returns.npz",
    "summary.json",
    "learning_curve.png",
    "policy/",
)


def main() -> None:
    """Reads the command line, trains, and exits: 0 done, 2 bad input, 130 interrupted."""
    directory = None
    silence_alarms()
    try:
        with _collection_paused():
            config = parse(sys.argv[1:])
            check(config)
            check_size(config)
            directory = prepare(config.output, config.env, config.overwrite)
            env = envs.make(config.env)
            _configure_jax()
            learner, horizon = build(env, config)
            plan = make_plan(env, learner, horizon, config)
    except ValueError as error:
        _refuse(str(error), directory)
    try:
        interrupted = train(env, learner, horizon, config, plan, directory)
    except RuntimeError as error:  # XLA's
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        remedy = "lower --num-seeds, --num-episodes, --eval-episodes or --horizon"
        _refuse(f"this run does not fit into memory ({error}); {remedy}", directory)
    sys.exit(130 if interrupted else 0)


def _refuse(message: str, directory: Path | None) -> NoReturn:
    """Says what is wrong, leaves no empty run directory behind, and exits."""
    if directory and not any(directory.iterdir()):
        directory.rmdir()
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


def parse(arguments: Sequence[str]) -> Config:
    """Returns the settings that a command line asks for; --help and bad flags exit.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: there is no such preset.
    """
    default, prog = of_task(named_task(arguments)), "python -m mjx_reinforce.train"
    if arguments and not arguments[0].startswith("-"):
        name, *arguments = arguments
        check_name("preset", name, PRESETS)
        default, prog = PRESETS[name][1], f"{prog} {name}"
    else:
        prog = f"{prog} [PRESET]"
    groups = [
        (title, group, group(**{f.name: getattr(default, f.name) for f in fields(group)}))
        for title, group in GROUPS.items()
    ]
    form = tyro.conf.OmitArgPrefixes[dataclasses.make_dataclass("Arguments", groups, frozen=True)]
    parsed = tyro.cli(form, args=arguments, prog=prog, description=_description())
    return Config(
        **{name: x for title in GROUPS for name, x in vars(getattr(parsed, title)).items()}
    )


def _description() -> str:
    width = max(map(len, PRESETS))
    presets = "\n".join(f"  {name:{width}}  {line}" for name, (line, _) in PRESETS.items())
    return (
        "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. "
        f"Leaves {', '.join(_FILES)} in the run directory.\n\n"
        "Defaults depend on the task: --help shows those of InvertedPendulum-v5, --help --env ID "
        "those of another.\n\n"
        f"Presets, published programs whose settings replace the defaults:\n{presets}\n\n"
        f"Environments: {', '.join(envs.names())}."
    )


def _configure_jax() -> None:
    """Turns on exact float32 products and the compilation cache, unless the user chose."""
    import jax

    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    settings = jax.config.values
    if settings["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(Path(cache) / "mjx_reinforce"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if settings["jax_default_matmul_precision"] is None:
        jax.config.update("jax_default_matmul_precision", "highest")


def train(
    env: Any, learner: Any, horizon: int, config: Config, plan: Plan, directory: Path
) -> bool:
    """Trains to the budget, or to Ctrl-C, and writes the run's files.

    Args:
      env: what is trained on.
      learner: how.
      horizon: the time limit of an episode in steps.
      config: the settings of the run.
      plan: what is said of it beforehand.
      directory: where the files go.

    Returns:
      Whether it was interrupted.
    """
    with _collection_paused():
        from mjx_reinforce.reports.curves import draw_learning_curve, load_libraries
        from mjx_reinforce.runs.display import Display, print_summary
        from mjx_reinforce.runs.interrupt import Interrupt
        from mjx_reinforce.runs.log import RunLog
        from mjx_reinforce.runs.record import Record
        from mjx_reinforce.runs.state import compile_programs, first_state

    threshold = getattr(env, "reward_threshold", None)
    with Display() as display, Interrupt(display.say) as interrupt:
        display.say(plan.text)
        started = time.perf_counter()
        with _collection_paused(), display.compiling(plan.compiling):
            state = first_state(learner, config)
            programs = compile_programs(env, learner, horizon, config, state)
        compile_seconds = time.perf_counter() - started
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        record, log = Record(config, threshold), RunLog(directory)
        log.begin(dataclasses.asdict(config) | {"horizon": horizon, "output": str(directory)})
        display.start(compile_seconds)
        threading.Thread(target=load_libraries, daemon=True).start()
        began = time.perf_counter()
        while True:
            result = programs.evaluate(state)
            seconds = time.perf_counter() - began
            log.add_rows(record.add_evaluation(result, seconds))
            display.show_progress(record.progress(seconds))
            if record.finished() or interrupt.is_set():
                break
            state, metrics = programs.advance(state)
            for event in record.add_updates(metrics):
                display.show_nonfinite(event)
    log.save_policy(state.train_states.actor, policy_settings(env, config))
    run_seconds = time.perf_counter() - began
    summary = record.summary(learner.engine.name, compile_seconds, run_seconds)
    history, training = record.history(), record.training()
    axis = "episodes" if config.env_steps is None else "env_steps"
    picture = draw_learning_curve(history, training, config.env, threshold, axis)
    log.finish(training, picture, summary)
    print_summary(display.console, summary, directory)
    return interrupt.is_set()


@contextlib.contextmanager
def _collection_paused() -> Iterator[None]:
    """Stops the garbage collector in a block that makes many objects and no garbage.

    Imports and tracing are such: it saves a second in eight. The objects of a block that
    succeeds are never looked at again.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        if enabled:
            gc.enable()


if __name__ == "__main__":
    main()

"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

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

from mjx_reinforce import envs
from mjx_reinforce.registry import check_name
from mjx_reinforce.runs import resume
from mjx_reinforce.runs.config import Config, check
from mjx_reinforce.runs.interrupt import Interrupt
from mjx_reinforce.runs.presets import PRESETS
from mjx_reinforce.runs.settings import GROUPS

_FILES = (
    "config.json",
    "metrics.csv",
    "returns.npz",
    "summary.json",
    "learning_curve.png",
    "policy/",
    "checkpoint/",
)


def main() -> None:
    """Reads the command line, trains, and exits.

    The status is 0 when done, 1 if files cannot be written, 2 for bad input, 130 after Ctrl-C and
    143 after SIGTERM.
    """
    with Interrupt() as interrupt, contextlib.ExitStack() as held:
        sys.exit(_main(sys.argv[1:], interrupt, held))


def _main(arguments: Sequence[str], interrupt: Interrupt, held: contextlib.ExitStack) -> int:
    """Returns the exit status of a command line; ``held`` keeps what is released at its end."""
    from mjx_reinforce.runs.files import locked

    directory = None
    try:
        with _collection_paused():
            config = parse(arguments)
            check(config)
            directory = _directory(config)
            interrupt.on_exit(lambda: _remove_if_empty(directory))
            held.enter_context(locked(directory))
            env = envs.make(config.env)
            _configure_jax()
            start = _start(env, config)
    except ValueError as error:
        _refuse(str(error), directory)
    try:
        interrupted = train(env, *start, config, directory, interrupt)
    except RuntimeError as error:  # XLA's
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        remedy = "lower --num-seeds, --num-episodes, --eval-episodes or --horizon"
        _refuse(f"this run does not fit into memory ({error}); {remedy}", directory)
    except OSError as error:
        remedy = f"make room, then go on with --resume {directory}"
        _refuse(f"cannot write the files of this run ({error}); {remedy}", directory, status=1)
    return 128 + interrupted if interrupted else 0


def _directory(config: Config) -> Path:
    """Returns the run directory; makes it, unless the run goes on in its own."""
    from mjx_reinforce.runs.files import prepare

    if config.resume is not None:
        return config.resume
    return prepare(config.output, config.env, config.overwrite)


def _start(env: Any, config: Config) -> tuple[Any, int, Any]:
    """Returns the learner, the horizon, and the checkpoint from which the run goes on, if any.

    Raises:
      ValueError: the settings do not fit the environment, or the run cannot go on here.
    """
    from mjx_reinforce.runs.build import build
    from mjx_reinforce.runs.files import provenance

    learner, horizon = build(env, config)
    if config.resume is None:
        return learner, horizon, None
    resume.check_program(config.resume, provenance())
    return learner, horizon, resume.find(learner, config, print)


def _refuse(message: str, directory: Path | None, status: int = 2) -> NoReturn:
    """Says what is wrong, leaves no empty run directory behind, and exits."""
    _remove_if_empty(directory)
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)


def _remove_if_empty(directory: Path | None) -> None:
    if directory and not any(directory.iterdir()):
        directory.rmdir()


def parse(arguments: Sequence[str]) -> Config:
    """Returns the settings that a command line asks for; --help and bad flags exit.

    Args:
      arguments: a preset's name, if any, then flags.

    Raises:
      ValueError: there is no such preset, or the run to resume is not there or has other settings.
    """
    default, prog, preset = Config(), "python -m mjx_reinforce.train", None
    if arguments and not arguments[0].startswith("-"):
        preset, *arguments = arguments
        check_name("preset", preset, PRESETS)
        default, prog = PRESETS[preset][1], f"{prog} {preset}"
    else:
        prog = f"{prog} [PRESET]"
    config = _read(arguments, default, prog)
    if config.resume is None:
        return config
    if preset is not None:
        raise ValueError(f"--resume has the run's own settings: leave the preset {preset} out")
    known = resume.read_settings(config.resume)
    asked = _read(arguments, known, prog)
    resume.check_settings(known, asked)
    if resume.is_done(known, asked):
        print(f"{known.resume} is finished; to go on, give a larger --env-steps or --max-updates")
        sys.exit(0)
    return asked


def _read(arguments: Sequence[str], default: Config, prog: str) -> Config:
    """Returns the settings that flags ask for, with others as given; --help and bad flags exit."""
    import tyro

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
    env: Any,
    learner: Any,
    horizon: int,
    found: Any,
    config: Config,
    directory: Path,
    interrupt: Interrupt,
) -> int | None:
    """Trains to the budget, or until a signal, and writes the run's files.

    Args:
      env: what is trained on.
      learner: how.
      horizon: the time limit of an episode in steps.
      found: the checkpoint from which the run goes on, if any.
      config: the settings of the run.
      directory: where the files go.
      interrupt: what listens to signals.

    Returns:
      The number of the signal that interrupted it, or None.
    """
    with _collection_paused():
        from mjx_reinforce.reports.curves import load_libraries
        from mjx_reinforce.runs.display import Display, print_summary

    with Display() as display:
        interrupt.on_exit(display.console.show_cursor)
        display.say(f"engine {learner.engine.name}: {learner.engine.why}; compiling")
        session, compile_seconds = _compile(env, learner, horizon, config, directory, display)
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        interrupt.defer(display.say)
        _begin(session, horizon, found)
        display.start(compile_seconds)
        threading.Thread(target=load_libraries, daemon=True).start()
        interrupted = _loop(session, interrupt, evaluated=found is not None)
    if not session.saved:
        session.save()
    summary = _finish(session, learner.engine.name, compile_seconds, interrupted)
    print_summary(display.console, summary, directory)
    return interrupted


def _compile(
    env: Any, learner: Any, horizon: int, config: Config, directory: Path, display: Any
) -> tuple[Any, float]:
    """Returns a run before its first update, and how long it took to compile, in seconds."""
    with _collection_paused():
        from mjx_reinforce.runs.best import first_best
        from mjx_reinforce.runs.build import policy_settings
        from mjx_reinforce.runs.log import RunLog
        from mjx_reinforce.runs.record import Record
        from mjx_reinforce.runs.session import Session
        from mjx_reinforce.runs.state import compile_programs, first_state

    started = time.perf_counter()
    with _collection_paused():
        state = first_state(learner, config)
        programs = compile_programs(env, learner, horizon, config, state)
    seconds = time.perf_counter() - started
    record = Record(config, getattr(env, "reward_threshold", None))
    best, policy = first_best(state.train_states), policy_settings(env, config)
    session = Session(config, policy, programs, record, RunLog(directory), display, state, best)
    return session, seconds


def _begin(session: Any, horizon: int, found: Any) -> None:
    """Writes the first files, or takes the run and its files back to where it goes on."""
    config, log = session.config, session.log
    if config.resume is None:
        settings = dataclasses.asdict(config) | {"horizon": horizon, "output": str(log.directory)}
        del settings["resume"]
        log.begin(settings)
        return
    budget = {name: getattr(config, name) for name in resume.BUDGETS}
    log.resume(resume.read_record(config.resume), budget, found)
    if found is not None:
        session.restore(found)
    session.display.say(f"going on after {session.record.updates.max()} updates")


def _loop(session: Any, interrupt: Interrupt, *, evaluated: bool) -> int | None:
    """Trains until the budget is used, or a signal came, whose number is returned.

    Args:
      session: the run.
      interrupt: what listens to signals.
      evaluated: whether the present policies have been.
    """
    if not evaluated:
        session.evaluate()
    while not session.record.finished():
        if interrupt.number is not None:
            return interrupt.number
        session.advance()
        session.evaluate()
        session.save_if_due()
    return None


def _finish(
    session: Any, engine: str, compile_seconds: float, interrupted: int | None
) -> dict[str, Any]:
    """Writes the last files; returns the contents of summary.json."""
    from mjx_reinforce.reports.curves import draw_learning_curve

    config, record = session.config, session.record
    # A run that was interrupted is to end soon, and is tested when it has been resumed.
    test = {} if interrupted else session.test()
    run_seconds = session.seconds()
    summary = {
        "status": "interrupted" if interrupted else "finished",
        **record.summary(engine, compile_seconds, run_seconds),
        "best_updates": session.best.num_updates.tolist(),
        **test,
    }
    history, training = record.history(), record.training()
    axis = "episodes" if config.env_steps is None else "env_steps"
    picture = draw_learning_curve(history, training, config.env, record.threshold, axis)
    session.save_policies()
    session.log.finish(training, picture, summary)
    return summary


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

"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import dataclasses
import gc
import os
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tyro

from mjx_reinforce import envs
from mjx_reinforce.registry import check_name
from mjx_reinforce.runs.build import build, policy_settings
from mjx_reinforce.runs.config import GROUPS, Config, check
from mjx_reinforce.runs.presets import PRESETS

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
    gc.disable()  # imports and tracing make many objects and no garbage: a second in eight
    directory = None
    try:
        config = parse(sys.argv[1:])
        check(config)
        from mjx_reinforce.runs import files as records

        directory = records.prepare(config.output, config.env, config.overwrite)
        env = envs.make(config.env)
        _configure_jax()
        learner, horizon = build(env, config)
    except ValueError as error:
        _refuse(str(error), directory)
    try:
        interrupted = train(env, learner, horizon, config, directory)
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
    default, prog = Config(), "python -m mjx_reinforce.train"
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


class Programs:
    """The two compiled programs of a run, over all seeds at once.

    A carry is ``(TrainState [S, ...], env steps used [S])``. ``advance`` moves it on
    by ``eval_every`` updates, except seeds whose budget is used, which stand still;
    it donates its argument. ``evaluate`` only looks.
    """

    def __init__(self, env: Any, learner: Any, horizon: int, config: Config):
        """Traces both, then compiles them side by side."""
        import jax
        import jax.numpy as jnp
        from jax import lax

        from mjx_reinforce.runs.evaluation import evaluate

        def update(carry, _):
            states, used = carry
            active = jnp.ones(config.num_seeds, bool)
            if config.env_steps is not None:
                active &= used < config.env_steps
            if config.max_updates is not None:
                active &= states.num_updates < config.max_updates
            states, metrics = jax.vmap(learner.step)(states, active)
            return (states, used + metrics["env_steps"]), metrics | {"active": active}

        def advance(carry):
            return lax.scan(update, carry, length=config.eval_every)

        def look(actor, key):
            return jax.vmap(
                lambda actor: evaluate(
                    env,
                    learner,
                    actor,
                    key,
                    num_episodes=config.eval_episodes,
                    horizon=horizon,
                )
            )(actor)

        # Two domains under one seed: whatever the user types, no key is in both.
        train_key = jax.random.fold_in(jax.random.key(config.seed), 0)
        self.eval_key = jax.random.fold_in(jax.random.key(config.eval_seed), 1)
        states = jax.jit(jax.vmap(learner.init))(jax.random.split(train_key, config.num_seeds))
        self.carry = (states, jnp.zeros(config.num_seeds, jnp.int32))
        with ThreadPoolExecutor() as pool:  # the first compiles while the second is traced
            look_program = pool.submit(jax.jit(look).lower(states.actor, self.eval_key).compile)
            lowered = jax.jit(advance, donate_argnums=0).lower(self.carry)
            self.advance = lowered.compile()
            self._look = look_program.result()

    def evaluate(self) -> dict[str, np.ndarray]:
        """Returns the evaluation of the present policies, [S] each."""
        return _to_numpy(self._look(self.carry[0].actor, self.eval_key))


def train(env: Any, learner: Any, horizon: int, config: Config, directory: Path) -> bool:
    """Trains to the budget, or to Ctrl-C, and writes the run's files.

    Returns:
      Whether it was interrupted.
    """
    from mjx_reinforce.export import policy_files as checkpoint
    from mjx_reinforce.export.files import write_json
    from mjx_reinforce.reports import curves as report
    from mjx_reinforce.runs import files as records
    from mjx_reinforce.runs.display import Display, Interrupt, print_summary
    from mjx_reinforce.runs.log import RunLog

    settings = dataclasses.asdict(config) | {"horizon": horizon, "output": str(directory)}
    threshold = getattr(env, "reward_threshold", None)
    with Display() as display, Interrupt(display) as interrupt:
        display.say(f"engine {learner.engine.name}: {learner.engine.why}; compiling")
        started = time.perf_counter()
        programs = Programs(env, learner, horizon, config)
        compile_seconds = time.perf_counter() - started
        gc.freeze()
        gc.enable()
        # Not before: a run killed while it compiles leaves nothing that would refuse the next.
        write_json(directory / "config.json", settings | records.provenance())
        display.say(f"compiled in {compile_seconds:.1f} s")
        display.start()
        threading.Thread(target=report.load_libraries, daemon=True).start()
        log = RunLog(config, directory, display, learner.engine.name, threshold)
        while not interrupt.is_set():
            log.evaluation(programs.evaluate())
            if log.finished():
                break
            programs.carry, metrics = programs.advance(programs.carry)
            log.updates(_to_numpy(metrics))
        else:
            log.evaluation(programs.evaluate())
        actor = programs.carry[0].actor
    checkpoint.save_policy(directory / "policy", actor, policy_settings(env, config))
    summary = log.finish(compile_seconds)
    print_summary(display.console, summary, directory)
    return interrupt.is_set()


def _to_numpy(tree: dict[str, Any]) -> dict[str, np.ndarray]:
    import jax

    return {name: np.asarray(value) for name, value in jax.device_get(tree).items()}


if __name__ == "__main__":
    main()

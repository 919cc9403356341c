"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import dataclasses
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from mjx_reinforce import envs
from mjx_reinforce.config import Config, check

_FILES = "config.json", "metrics.csv", "summary.json", "learning_curve.png", "policy/"


def main() -> None:
    """Reads the command line, trains, and exits: 0 done, 2 bad input, 130 interrupted."""
    config = tyro.cli(Config, prog="python -m mjx_reinforce.train", description=_description())
    try:
        check(config)
        from mjx_reinforce import records

        directory = records.prepare(config.output, config.env, config.overwrite)
        env = envs.make(config.env)
        _configure_jax()
        learner, horizon = build(env, config)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    interrupted = train(env, learner, horizon, config, directory)
    sys.exit(130 if interrupted else 0)


def _description() -> str:
    return (
        "Train policies by REINFORCE on MuJoCo, many seeds at once, and report over the seeds. "
        f"Leaves {', '.join(_FILES)} in the run directory. "
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


def build(env: Any, config: Config) -> tuple[Any, int]:
    """Builds the learner that the settings describe.

    Returns:
      The learner, and the horizon in env steps.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    import optax

    from mjx_reinforce import estimators, learner
    from mjx_reinforce.checkpoint import build_policy
    from mjx_reinforce.registry import ESTIMATORS, load

    horizon = learner.check_horizon(env, config.horizon)
    estimator = load(ESTIMATORS[config.estimator])(config.discount)
    if config.standardize:
        estimator = estimators.standardize(estimator, floor=config.standardize_floor)
    if config.discount_weights:
        estimator = estimators.discount_weights(estimator, config.discount)
    schedule = optax.linear_schedule(
        config.learning_rate, config.final_learning_rate, config.decay_updates
    )
    built = learner.reinforce(
        env,
        policy=build_policy(policy_settings(env, config)),
        estimator=estimator,
        optimizer=learner.default_optimizer(schedule, config.max_grad_norm),
        num_episodes=config.num_episodes,
        horizon=horizon,
        entropy_cost=config.entropy_cost,
        loss_per=config.loss_per,
        normalize_steps=config.normalize_steps,
        engine=config.engine,
    )
    return built, horizon


def policy_settings(env: Any, config: Config) -> dict[str, Any]:
    """Returns what ``checkpoint.build_policy`` needs to rebuild the policy without the env."""
    from mjx_reinforce.types import action_space, observation_size

    space = action_space(env)
    return {
        "env": config.env,
        "policy": config.policy,
        "hidden_sizes": config.hidden_sizes,
        "initial_std": config.initial_std,
        "observation_size": observation_size(env),
        "action_low": space.low.tolist(),
        "action_high": space.high.tolist(),
    }


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

        from mjx_reinforce.evaluation import evaluate

        def update(carry, _):
            states, used = carry
            active = used < config.env_steps
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
    from mjx_reinforce import checkpoint, records, report
    from mjx_reinforce.display import Display, Interrupt, print_summary
    from mjx_reinforce.runlog import RunLog

    settings = dataclasses.asdict(config) | {"horizon": horizon, "output": str(directory)}
    records.write_json(directory / "config.json", settings | records.provenance())
    with Display(config.env_steps) as display, Interrupt(display) as interrupt:
        started = time.perf_counter()
        programs = Programs(env, learner, horizon, config)
        compile_seconds = time.perf_counter() - started
        display.say(f"engine {learner.engine.name}: {learner.engine.why}")
        display.say(f"compiled in {compile_seconds:.1f} s")
        display.start()
        threading.Thread(target=report.load_libraries, daemon=True).start()
        log = RunLog(config, directory, display, learner.engine.name)
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
    summary = log.finish(compile_seconds, getattr(env, "reward_threshold", None))
    print_summary(display.console, summary, directory)
    return interrupt.is_set()


def _to_numpy(tree: dict[str, Any]) -> dict[str, np.ndarray]:
    import jax

    return {name: np.asarray(value) for name, value in jax.device_get(tree).items()}


if __name__ == "__main__":
    main()

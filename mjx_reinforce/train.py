"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import dataclasses
import os
import signal
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
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
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
            state, used = carry
            proposed, metrics = jax.vmap(learner.step)(state)
            active = used < config.env_steps

            def choose(new, old):
                return jnp.where(active.reshape(active.shape + (1,) * (new.ndim - 1)), new, old)

            used = used + jnp.where(active, metrics["env_steps"], 0)
            return (jax.tree.map(choose, proposed, state), used), metrics | {"active": active}

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
        lowered = [
            jax.jit(advance, donate_argnums=0).lower(self.carry),
            jax.jit(look).lower(states.actor, self.eval_key),
        ]
        with ThreadPoolExecutor() as pool:
            self.advance, self._look = pool.map(lambda program: program.compile(), lowered)

    def evaluate(self) -> dict[str, np.ndarray]:
        """Returns the evaluation of the present policies, [S] each."""
        return _to_numpy(self._look(self.carry[0].actor, self.eval_key))


def train(env: Any, learner: Any, horizon: int, config: Config, directory: Path) -> bool:
    """Trains to the budget, or to Ctrl-C, and writes the run's files.

    Returns:
      Whether it was interrupted.
    """
    from mjx_reinforce import records
    from mjx_reinforce.display import Display, print_summary

    settings = dataclasses.asdict(config) | {"horizon": horizon, "output": str(directory)}
    records.write_json(directory / "config.json", settings | records.provenance())
    with Display(config.env_steps) as display, _Interrupt(display) as interrupt:
        started = time.perf_counter()
        programs = Programs(env, learner, horizon, config)
        compile_seconds = time.perf_counter() - started
        display.say(f"engine {learner.engine.name}: {learner.engine.why}")
        display.say(f"compiled in {compile_seconds:.1f} s")
        display.start()
        log = _Log(config, directory, display, learner.engine.name)
        while not interrupt.is_set():
            log.evaluation(programs)
            if np.all(log.used >= config.env_steps):
                break
            programs.carry, metrics = programs.advance(programs.carry)
            log.updates(_to_numpy(metrics))
        else:
            log.evaluation(programs)
    summary = log.finish(env, programs, compile_seconds, policy_settings(env, config))
    print_summary(display.console, summary, directory)
    return interrupt.is_set()


class _Log:
    """Everything measured so far, and the files it goes to."""

    def __init__(self, config: Config, directory: Path, display: Any, engine: str):
        self.used = np.zeros(config.num_seeds, np.int64)
        self._config, self._directory, self._display = config, directory, display
        self._engine = engine
        self._rows: list[dict[str, Any]] = []
        self._evaluations: list[dict[str, np.ndarray]] = []
        self._broken: list[dict[str, Any]] = []
        self._last: dict[str, np.ndarray] = {}
        self._simulated = 0.0
        self._update = np.zeros(config.num_seeds, np.int64)
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    def updates(self, metrics: dict[str, np.ndarray]) -> None:
        """Takes in the metrics [K, S] of a block of updates."""
        active = metrics["active"]
        steps = np.where(active, metrics["env_steps"], 0)
        self.used += steps.sum(axis=0)
        self._simulated += np.sum(steps / np.maximum(metrics["useful_step_fraction"], 1e-9))
        self._last = {name: values[-1] for name, values in metrics.items()}
        for k, s in zip(*np.nonzero(active), strict=True):
            episodes, skipped = metrics["nonfinite_episodes"][k, s], metrics["skipped_update"][k, s]
            if episodes or skipped:
                self._report_broken(int(s), int(self._update[s] + k), int(episodes), bool(skipped))
        self._update += active.sum(axis=0)

    def _report_broken(self, seed: int, update: int, episodes: int, skipped: bool) -> None:
        self._broken.append(
            {"seed": seed, "update": update, "episodes": episodes, "skipped": skipped}
        )
        what = f"{episodes} non-finite episodes" + (", update skipped" if skipped else "")
        self._display.say(f"[yellow]seed {seed}, update {update}: {what}[/yellow]")

    def evaluation(self, programs: Programs) -> None:
        """Evaluates, shows it, and writes metrics.csv."""
        from mjx_reinforce import records
        from mjx_reinforce.statistics import iqm

        result = programs.evaluate()
        self._evaluations.append(result | {"env_steps": self.used.copy()})
        for s in range(self._config.num_seeds):
            self._rows.append(self._row(s, result))
        records.write_csv(self._directory / "metrics.csv", self._rows)
        returns = result["eval_return"]
        rate = self.used.sum() / self.seconds
        self._display.evaluated(
            int(self._update.max()),
            float(self.used.mean()),
            float(iqm(returns)),
            float(returns.min()),
            float(rate),
        )

    def _row(self, seed: int, result: dict[str, np.ndarray]) -> dict[str, Any]:
        def last(name):
            return self._last[name][seed].item() if self._last else ""

        return {
            "seed": seed,
            "update": int(self._update[seed]),
            "env_steps": int(self.used[seed]),
            "wall_seconds": round(self.seconds, 3),
            "train_return": last("episode_return"),
            "eval_return": result["eval_return"][seed].item(),
            "eval_return_stochastic": result["eval_return_stochastic"][seed].item(),
            "eval_length": result["eval_length"][seed].item(),
            "train_length": last("episode_length"),
            "entropy": last("entropy"),
            "gradient_norm": last("gradient_norm"),
            "useful_step_fraction": last("useful_step_fraction"),
            "nonfinite_episodes": last("nonfinite_episodes"),
            "skipped_update": last("skipped_update"),
        }

    def finish(
        self, env: Any, programs: Programs, compile_seconds: float, settings: dict[str, Any]
    ) -> dict[str, Any]:
        """Writes the summary, the picture and the policies; returns the summary."""
        from mjx_reinforce import checkpoint, records, report

        seconds = self.seconds
        threshold = getattr(env, "reward_threshold", None)
        history = {
            name: np.stack([evaluation[name] for evaluation in self._evaluations])
            for name in ("eval_return", "env_steps")
        }
        summary = {
            "env": self._config.env,
            "engine": self._engine,
            "num_seeds": self._config.num_seeds,
            **report.summarize(history, threshold),
            "env_steps": self.used.tolist(),
            "compile_seconds": compile_seconds,
            "run_seconds": seconds,
            "env_steps_per_second": float(self.used.sum() / seconds),
            "useful_step_fraction": float(self.used.sum() / max(self._simulated, 1.0)),
            "nonfinite": self._broken,
        }
        checkpoint.save_policy(self._directory / "policy", programs.carry[0].actor, settings)
        report.draw_learning_curve(
            self._directory / "learning_curve.png", history, self._config.env, threshold
        )
        records.write_json(self._directory / "summary.json", summary)
        return summary


class _Interrupt(threading.Event):
    """Ctrl-C asks the run to stop after the present block; a second one stops at once."""

    def __init__(self, display: Any):
        super().__init__()
        self._display = display

    def __enter__(self) -> "_Interrupt":
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: Any) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: Any) -> None:
        del number, frame
        self.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._display.say("stopping after this block of updates; Ctrl-C again stops at once")


def _to_numpy(tree: dict[str, Any]) -> dict[str, np.ndarray]:
    import jax

    return {name: np.asarray(value) for name, value in jax.device_get(tree).items()}


if __name__ == "__main__":
    main()

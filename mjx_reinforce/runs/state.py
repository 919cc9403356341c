"""A run in progress: the state of all its seeds, and the compiled programs that move it on."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax

from mjx_reinforce.learners.learner import Learner, TrainState
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.evaluation import evaluate
from mjx_reinforce.types import Environment

Arrays = dict[str, np.ndarray]


@struct.dataclass(kw_only=True)
class RunState:
    """All that a run needs to go on.

    train_states: [S, ...] the ``TrainState`` of every seed
    env_steps: [S] int32, how many each seed has played in training
    """

    train_states: TrainState
    env_steps: jax.Array


class Programs(NamedTuple):
    """The compiled programs of a run, over all seeds at once.

    advance: (RunState) -> (RunState, metrics [K, S]), K = ``eval_every`` updates later, but for
      seeds whose budget is used, which stand still; the memory of its argument is used again.
      To the metrics of ``Learner.step`` it adds ``active`` (False for a seed that stood still),
      and ``updates_total`` and ``env_steps_total``, the seed's counts after the update
    evaluate: (RunState) -> [S] each, what ``evaluation.evaluate`` returns for every seed
    test: (Actor [S, ...]) -> the same on start states that nothing else is played on
    """

    advance: Callable[[RunState], tuple[RunState, Arrays]]
    evaluate: Callable[[RunState], Arrays]
    test: Callable[[Actor], Arrays]


def first_state(learner: Learner, config: Config) -> RunState:
    """Returns the state before the first update."""
    key = _key(config.seed, domain=0)
    init = jax.jit(jax.vmap(learner.init))
    return RunState(
        train_states=init(jax.random.split(key, config.num_seeds)),
        env_steps=jnp.zeros(config.num_seeds, jnp.int32),
    )


def compile_programs(
    env: Environment, learner: Learner, horizon: int, config: Config, state: RunState
) -> Programs:
    """Compiles the programs of a run.

    Args:
      env: what is trained on.
      learner: how.
      horizon: T, the time limit of an episode in steps.
      config: the settings of the run.
      state: any state of the run; only its shapes are read.
    """
    key = _key(config.eval_seed, domain=1)
    advance = jax.jit(_advance(learner, config), donate_argnums=0)
    look = jax.jit(_evaluate(env, learner, horizon, config))
    with ThreadPoolExecutor() as pool:  # the first compiles while the second is traced
        looking = pool.submit(look.lower(state.train_states.actor, key).compile)
        advancing = advance.lower(state).compile()
        compiled = looking.result()

    def advanced(state: RunState) -> tuple[RunState, Arrays]:
        state, metrics = advancing(state)
        return state, _to_numpy(metrics)

    def evaluated(state: RunState) -> Arrays:
        return _to_numpy(compiled(state.train_states.actor, key))

    def tested(actor: Actor) -> Arrays:
        return _to_numpy(compiled(actor, _key(config.eval_seed, domain=2)))

    return Programs(advanced, evaluated, tested)


def _key(seed: int, domain: int) -> jax.Array:
    """Returns the root of the keys of training (domain 0), evaluation (1), or the last test (2).

    The domains share no key, whatever seeds the user chooses.
    """
    return jax.random.fold_in(jax.random.key(seed), domain)


def _advance(learner: Learner, config: Config) -> Callable[..., Any]:
    """Returns a function that makes ``eval_every`` updates of all seeds."""

    def update(state: RunState, _: None) -> tuple[RunState, dict[str, jax.Array]]:
        active = jnp.ones(config.num_seeds, bool)
        if config.env_steps is not None:
            active &= state.env_steps < config.env_steps
        if config.max_updates is not None:
            active &= state.train_states.num_updates < config.max_updates
        train_states, metrics = jax.vmap(learner.step)(state.train_states, active)
        env_steps = state.env_steps + metrics["env_steps"]
        counts = {"updates_total": train_states.num_updates, "env_steps_total": env_steps}
        state = RunState(train_states=train_states, env_steps=env_steps)
        return state, metrics | counts | {"active": active}

    def advance(state: RunState) -> tuple[RunState, dict[str, jax.Array]]:
        return lax.scan(update, state, length=config.eval_every)

    return advance


def _evaluate(env: Environment, learner: Learner, horizon: int, config: Config) -> Any:
    """Returns a function that evaluates actors [S, ...], all on the same start states."""

    def one(actor: Actor, key: jax.Array) -> dict[str, jax.Array]:
        return evaluate(
            env, learner, actor, key, num_episodes=config.eval_episodes, horizon=horizon
        )

    return jax.vmap(one, in_axes=(0, None))


def _to_numpy(tree: dict[str, jax.Array]) -> Arrays:
    return {name: np.asarray(value) for name, value in jax.device_get(tree).items()}

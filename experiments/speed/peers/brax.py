"""Brax's PPO on our environments, for so many seconds on one GPU."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from brax.training.agents.ppo import train as ppo
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.kit.rows import words
from experiments.speed.peers import rows
from experiments.speed.peers.clock import Budgets, Clock
from experiments.speed.peers.settings import BRAX, Brax
from mjx_reinforce import envs

#: More updates than any budget in seconds allows.
_ENDLESS = 10**6


class Rescaled(Wrapper):
    """An environment whose actions go from -1 to 1, as those of brax's policies do."""

    def __init__(self, env: Any):
        """Takes an environment with bounded actions.

        Raises:
          ValueError: its actions have no bounds.
        """
        super().__init__(env)
        self.low, self.high = env.action_space
        if not np.all(np.isfinite([self.low, self.high])):
            raise ValueError(f"actions have no bounds: {env.action_space}; brax's PPO needs them")

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state after an ``action`` [A] from -1 to 1."""
        return self.env.step(state, self.low + (action + 1) / 2 * (self.high - self.low))


class _Enough(Exception):  # noqa: N818 - no error: brax's training has no other way to end
    """Every budget is used up."""


def facts() -> dict[str, Any]:
    """Returns what all rows of brax say."""
    return {
        "device": jax.devices()[0].device_kind,
        "version": brax.__version__,
        "libraries": words({"jax": jax.__version__}),
        "environment": "mjx_reinforce",
    }


def train(
    task: str,
    seed: int,
    seconds: Sequence[float],
    episodes: int,
    report: Callable[[dict[str, Any]], None],
) -> None:
    """Trains on one of our environments until the last budget is used up.

    Args:
      task: a key of ``settings.BRAX``.
      seed: of all that is random in training.
      seconds: budgets of training (s).
      episodes: of an evaluation, on starts of their own.
      report: is called with what a row says, at each budget.
    """
    settings = BRAX[task]
    train_on(Rescaled(envs.make(task)), settings, seed, seconds, episodes, report)


def train_on(
    env: Env,
    settings: Brax,
    seed: int,
    seconds: Sequence[float],
    episodes: int,
    report: Callable[[dict[str, Any]], None],
) -> None:
    """As ``train``, on any environment with ``max_episode_steps`` and actions from -1 to 1.

    The clock starts after the second update, since the first two can compile: the peer has their
    env steps for nothing.
    """
    mend_jax()
    budgets, clock = Budgets(seconds), Clock()
    arguments = settings.arguments
    update = arguments["batch_size"] * arguments["unroll_length"] * arguments["num_minibatches"]
    horizon: int = env.max_episode_steps  # pyright: ignore[reportAttributeAccessIssue]
    starts = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), episodes)

    @functools.partial(jax.jit, static_argnums=0)
    def returns(make_policy: Callable[..., Any], params: Any) -> jax.Array:
        return play(env, make_policy(params, deterministic=True), starts, horizon)

    def after_update(env_steps: int, make_policy: Callable[..., Any], params: Any) -> None:
        nonlocal clock
        if env_steps <= 2 * update:
            clock = Clock()
            return
        spent = clock.seconds
        for budget in budgets.due(spent):
            with clock.paused():
                reached = np.asarray(returns(make_policy, params))
                said = {"settings": words(arguments), "source": settings.source}
                report(rows.result(budget, spent, env_steps, reached) | said)
        if budgets.spent:
            raise _Enough

    try:
        ppo.train(
            env,
            num_timesteps=_ENDLESS * update,
            num_evals=_ENDLESS + 1,  # one update between two calls of after_update
            run_evals=False,
            policy_params_fn=after_update,
            episode_length=horizon,
            seed=seed,
            max_devices_per_host=1,
            **arguments,
        )
    except _Enough:
        return


def play(env: Env, policy: Callable[..., Any], keys: jax.Array, horizon: int) -> jax.Array:
    """Returns the return of each episode [E].

    Args:
      env: the environment.
      policy: from observations [E, O] and a key to actions [E, A] and something else.
      keys: [E] of the starts.
      horizon: env steps after which an episode is cut short.
    """

    def step(carry, _):
        state, total, running = carry
        state = jax.vmap(env.step)(state, policy(state.obs, keys[0])[0])
        total += jnp.where(running, state.reward, 0)
        return (state, total, running & (state.done == 0)), None

    state = jax.vmap(env.reset)(keys)
    start = state, jnp.zeros(len(keys)), jnp.ones(len(keys), bool)
    return jax.lax.scan(step, start, length=horizon)[0][1]


def mend_jax() -> None:
    """Gives JAX back ``device_put_replicated``, which brax 0.14.2 needs and JAX 0.10 has not."""
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = _replicated  # pyright: ignore[reportAttributeAccessIssue]


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """Returns arrays with one copy a device, along a new first axis, which brax calls "i"."""
    placed = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
    return jax.tree.map(lambda x: jax.device_put(jnp.stack([x] * len(devices)), placed), tree)

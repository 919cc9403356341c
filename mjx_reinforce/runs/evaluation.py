"""Playing a policy without training it, on keys that no training uses."""

import jax
import jax.numpy as jnp

from mjx_reinforce.engines.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learners.learner import Learner
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.types import Environment


def evaluate(
    env: Environment,
    learner: Learner,
    actor: Actor,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    active: bool | jax.Array = True,
    sampled: bool = True,
) -> dict[str, jax.Array]:
    """Plays N episodes with the policy's mode, and N with its samples.

    Args:
      env: what is played.
      learner: whose policy and engine it is.
      actor: the parameters and observation statistics.
      key: consumed; pass the same one each time to see the same start states, and each seed one of
        its own: else the choice of the starts is a chance that no interval over seeds covers.
      num_episodes: N, of each kind.
      horizon: T, the time limit in steps.
      active: [] where False nothing is played, and what is returned says nothing.
      sampled: whether the second N are played; the first are the same without them.

    Returns:
      ``eval_return`` and ``eval_length`` [], means over the deterministic
      episodes, ``eval_return_stochastic`` [], over the sampled ones if there are any,
      ``eval_steps`` [], the steps of all episodes, and ``simulated_steps`` []. A return is NaN if
      one of its episodes left the finite numbers: what that earned until then says nothing.
    """
    trajectory = learner.engine.rollout(
        env,
        learner.act,
        actor,
        learner.policy.distribution,
        key,
        num_episodes=(1 + sampled) * num_episodes,
        horizon=horizon,
        deterministic=jnp.arange((1 + sampled) * num_episodes) < num_episodes,
        active=active,
    )
    returns, lengths = episode_returns(trajectory), episode_lengths(trajectory)
    returns = jnp.where(trajectory.nonfinite | ~jnp.isfinite(returns), jnp.nan, returns)
    stochastic = {"eval_return_stochastic": jnp.mean(returns[num_episodes:])} if sampled else {}
    return stochastic | {
        "eval_return": jnp.mean(returns[:num_episodes]),
        "eval_length": jnp.mean(lengths[:num_episodes]),
        "eval_steps": jnp.sum(lengths),
        "simulated_steps": trajectory.simulated,
    }

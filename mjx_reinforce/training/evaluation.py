"""Playing a policy without training it, on keys that no training uses."""

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Environment, Trajectory
from mjx_reinforce.engine.play.episode import episode_keys
from mjx_reinforce.engine.play.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learning.learner import Learner
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.training.hosting import Guests


def guests_of(
    key: jax.Array, *, num_episodes: int, active: bool | jax.Array = True, sampled: bool = True
) -> Guests:
    """Returns the episodes of an evaluation: N with the policy's mode, and N with its samples.

    Args:
      key: consumed; pass the same one each time to see the same start states, and each seed one of
        its own: else the choice of the starts is a chance that no interval over seeds covers.
      num_episodes: N, of each kind.
      active: [] where False nothing is played, and what was measured says nothing.
      sampled: whether the second N are played; the first are the same without them.
    """
    keys = episode_keys(key, (1 + sampled) * num_episodes)
    return Guests(keys, num_episodes, jnp.asarray(active))


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
    """Plays the episodes of an evaluation alone; returns what ``measure`` does.

    Args:
      env: what is played.
      learner: whose policy and engine it is.
      actor: the parameters and observation statistics.
      key: as for ``guests_of``, with the other arguments that are not named here.
      num_episodes: N, of each kind.
      horizon: T, the time limit in steps.
      active: [] where False nothing is played, and what is returned says nothing.
      sampled: whether the second N are played.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> actor = learner.init(jax.random.key(0)).actor
      >>> found = mr.evaluate(env, learner, actor, jax.random.key(1), num_episodes=4, horizon=20)
      >>> 1 <= found["eval_return"].item() <= 20
      True
    """
    guests = guests_of(key, num_episodes=num_episodes, active=active, sampled=sampled)
    trajectory = learner.engine.rollout(
        env,
        learner.act,
        actor,
        learner.policy.distribution,
        guests.keys,
        num_episodes=len(guests.keys),
        horizon=horizon,
        deterministic=guests.deterministic(),
        active=guests.active,
    )
    return measure(trajectory, guests) | {"simulated_steps": trajectory.simulated}


def measure(trajectory: Trajectory, guests: Guests) -> dict[str, jax.Array]:
    """Returns what the episodes of an evaluation show.

    ``eval_return`` and ``eval_length`` [], means over the deterministic episodes,
    ``eval_return_stochastic`` [], over the sampled ones if there are any, ``eval_steps`` [], the
    steps of all episodes, and ``simulated_steps`` [], those that were simulated for them alone:
    none where they rode with others. A return is NaN if one of its episodes left the finite
    numbers: what that earned until then says nothing.
    """
    returns, lengths = episode_returns(trajectory), episode_lengths(trajectory)
    returns = jnp.where(trajectory.nonfinite | ~jnp.isfinite(returns), jnp.nan, returns)
    modes = guests.num_modes
    sampled = len(guests.keys) > modes
    stochastic = {"eval_return_stochastic": jnp.mean(returns[modes:])} if sampled else {}
    return stochastic | {
        "eval_return": jnp.mean(returns[:modes]),
        "eval_length": jnp.mean(lengths[:modes]),
        "eval_steps": jnp.sum(lengths),
        "simulated_steps": jnp.zeros((), jnp.int32),
    }

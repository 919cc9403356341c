"""Returns of a policy's episodes in our simulation."""

import functools
from typing import Any

from mjx_reinforce import Player, envs
from mjx_reinforce.export.run_files import Run


def own_simulation(run: Run, player: Player, num_episodes: int) -> Any:
    """Returns a function from an actor to the returns [N] of episodes without noise.

    Args:
      run: gives the task and its time limit.
      player: whose policy the actors are of.
      num_episodes: N.

    Returns:
      (actor, root of all randomness of the starts) -> returns [N].
    """
    import jax

    from mjx_reinforce.engine.play import choice
    from mjx_reinforce.engine.play.rollouts import episode_returns
    from mjx_reinforce.learning.policy import act

    env, policy = envs.make(run.env), player.policy
    whose = choice.ActingPolicy(functools.partial(act, policy), player.actor, policy.distribution)
    engine = choice.choose("auto", env, whose, run.horizon)

    @jax.jit
    def returns(actor, root):
        return episode_returns(
            engine.rollout(
                env,
                whose.act,
                actor,
                policy.distribution,
                # Training and its evaluations split the keys of their roots; this is not split.
                jax.random.key(root),
                num_episodes=num_episodes,
                horizon=run.horizon,
                deterministic=True,
            )
        )

    return returns

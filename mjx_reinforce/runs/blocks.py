"""How many updates go by between two evaluations."""

from mjx_reinforce.runs.config import Config

#: A block of so many updates has room for them whatever the budget is; it takes little memory.
_ALWAYS_ROOM = 100


def block_length(config: Config) -> int:
    """Returns how many updates a block between two evaluations has room for.

    That is ``eval_every``, but where it is great no more than the budget can need, at one step an
    episode. A block that is shorter anyway does not depend on the budget, so that a run with
    another budget finds its programs in the compilation cache.
    """
    bounds = [config.eval_every]
    if config.max_updates is not None:
        bounds.append(config.max_updates)
    if config.env_steps is not None:
        bounds.append(-(-config.env_steps // config.fewest_episodes))
    return min(config.eval_every, max(_ALWAYS_ROOM, min(bounds)))

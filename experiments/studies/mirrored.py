"""Do mirrored first actions have correlated returns? Pairs of branches under the same later noise.

    python -m experiments.studies.mirrored Hopper-v5 Walker2d-v5
    python -m experiments.studies.mirrored Hopper-v5 --run RUN

A policy plays with noise, by default the one that comes with the package, otherwise the best seed
of a run. At some of its states, it branches: one branch takes the mean action plus s times z, where
s is the policy's standard deviation, the other the mean action minus s times z. Both go on with the
same later noise, of which there are many draws for each state.

The table has the correlation of the two branches' discounted returns by depth, the env steps that
they last: within states, over the draws of z and of the later noise. The difference of the
branches' returns, an estimate of the gradient at the state, has 1 - correlation times the variance
of a difference under independent noise. Standard errors are over states.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.kit.markdown import table
from mjx_reinforce import envs, load, make_vec
from mjx_reinforce.learning.policy import act

_TASKS = tuple(x for x in envs.names() if x.endswith("-v5"))
#: How many env steps the branches last, at which they are compared.
DEPTHS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
#: At which env steps of an episode it branches, at most, and for how many episodes.
_LAST_BRANCH, _NUM_STATES = 400, 64
#: Draws of z and of the later noise for each state.
_NUM_DRAWS = 32
_DISCOUNT = 0.995


def main() -> None:
    """Reads the command line, plays the branches, and prints a table."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.mirrored",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tasks", nargs="+", choices=_TASKS)
    parser.add_argument("--run", type=Path, help="whose best seed plays")
    parser.add_argument("--seed", type=int, default=20261202, help="of all randomness")
    arguments = parser.parse_args()
    lines = []
    for task in arguments.tasks:
        returns = branch_returns(task, load(arguments.run or task), arguments.seed)
        pairs = [correlation(x) for x in returns]
        lines.append([task, *(f"{value:.2f} ± {error:.2f}" for value, error in pairs)])
    print(table(["task", *(f"{depth} steps" for depth in DEPTHS)], lines))


def branch_returns(task: str, player: Any, seed: int) -> np.ndarray:
    """Returns the discounted returns [D, S, M, 2] of branches, by depth, state, and draw.

    Args:
      task: an environment id.
      player: whose policy plays.
      seed: of all randomness.
    """
    shape = (_NUM_STATES, _NUM_DRAWS, 2)
    vec = make_vec(envs.make(task), int(np.prod(shape)), autoreset="disabled")
    policy, size = player.policy, vec.action_size
    family = policy.distribution
    start_key, state_key, moment_key, draw_key = jax.random.split(jax.random.key(seed), 4)

    def play(state: Any, noise: jax.Array) -> Any:
        """Makes one step with noise [N, A]."""
        return vec.step(state, family.sample(act(policy, player.actor, state.obs), noise))

    @jax.jit
    def states() -> Any:
        """Returns states of S episodes, each at an env step of its own, in all their branches."""
        moments = jax.random.randint(moment_key, (_NUM_STATES,), 0, _LAST_BRANCH)

        def step(carry: Any, noise_of: tuple[jax.Array, jax.Array]) -> Any:
            state, has_branched = carry
            number, key = noise_of
            noise = jax.random.normal(key, (_NUM_STATES, size))
            # An episode that ends earlier branches in its last state before that.
            is_before = (number < moments) & ~has_branched
            new_state = play(state, _spread(noise, shape))
            goes_on = is_before & ~new_state.done.reshape(shape)[:, 0, 0]
            mask = jnp.broadcast_to(goes_on[:, None, None], shape).reshape(-1)
            state = _where(mask, new_state, state)
            return (state, has_branched | ~goes_on), None

        keys = jax.random.split(start_key, _NUM_STATES)
        start = vec.reset(_spread(keys, shape))
        noise_of = (jnp.arange(_LAST_BRANCH), jax.random.split(state_key, _LAST_BRANCH))
        return jax.lax.scan(step, (start, jnp.zeros(_NUM_STATES, bool)), noise_of)[0][0]

    @jax.jit
    def rewards(state: Any) -> jax.Array:
        """Returns the rewards [T, N] of the branches."""

        def step(carry: Any, noise_of: tuple[jax.Array, jax.Array]) -> Any:
            state, is_over = carry
            number, key = noise_of
            noise = jax.random.normal(key, (*shape[:2], 1, size))
            # The first action is mirrored, all others are not.
            sign = jnp.where(number == 0, jnp.array([1.0, -1.0]), 1.0)
            state = play(state, (noise * sign[:, None]).reshape(-1, size))
            return (state, is_over | state.done), jnp.where(is_over, 0.0, state.reward)

        noise_of = (jnp.arange(DEPTHS[-1]), jax.random.split(draw_key, DEPTHS[-1]))
        is_over = jnp.zeros(int(np.prod(shape)), bool)
        return jax.lax.scan(step, (state, is_over), noise_of)[1]

    earned = np.asarray(rewards(states()), float)
    powers = _DISCOUNT ** np.arange(len(earned))
    sums = np.cumsum(powers[:, None] * earned, axis=0)
    return sums[np.array(DEPTHS) - 1].reshape(len(DEPTHS), *shape)


def _spread(x: jax.Array, shape: Sequence[int]) -> jax.Array:
    """Returns what each state has [S, ...] for all of its branches [N, ...]."""
    return jnp.repeat(x, shape[1] * shape[2], axis=0)


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    def choose(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, new, old)


def correlation(returns: np.ndarray) -> tuple[float, float]:
    """Returns the correlation of pairs within states, and its standard error (jackknife).

    Args:
      returns: [S, M, 2] of the two branches, by state and draw.
    """
    centered = returns - returns.mean(axis=(1, 2), keepdims=True)
    products = (centered[..., 0] * centered[..., 1]).sum(axis=1)
    squares = (centered**2).sum(axis=(1, 2)) / 2
    value = products.sum() / squares.sum()
    left_out = (products.sum() - products) / (squares.sum() - squares)
    n = len(returns)
    return float(value), float(np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)))


if __name__ == "__main__":
    main()

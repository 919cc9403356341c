"""How far is a policy from the optimum? A search for better actions in the same episodes.

    python -m experiments.studies.optimum Reacher-v5 --starts 32
    python -m experiments.studies.optimum Pusher-v5 --starts 16 --rounds 500
    python -m experiments.studies.optimum InvertedPendulum-v5 InvertedDoublePendulum-v5

From fixed starts, the policy of a task that comes with the package plays without noise, in float64.
Then CMA-ES (Hansen 2016, arXiv:1604.00772) searches corrections of its actions, linear between
knots in time, and from rest, without the policy, actions themselves. Nothing here is random but the
starts, so the better of the two is a return that can be had from this start, and the optimum is
not below it. It may be above: the search is local, and knots are few. How much its second half
still found says how far from done it was.

A pendulum's reward is largest upright at rest. The time limit times that reward is a bound that no
policy exceeds, and nothing is searched.

``experiments/studies/results/data/optimum.csv`` gets a row for each start, and keeps the others.
Starts that it has are not searched again. ``python -m experiments.studies.results page`` makes the
table of docs/results.md from it.
"""

import argparse
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.kit import rows
from experiments.studies.results import tables
from mjx_reinforce import envs, load, make_vec
from mjx_reinforce.learning.policy import act

_FILE = Path(__file__).parent / "results" / "data" / "optimum.csv"
_COLUMNS = ("task", "method", "start", "policy", "best", "second_half", "best_from_rest", "rounds")
_COLUMNS += ("episodes", "knots", "commit", "machine")
_TASKS = tuple(x for x in envs.names() if x.endswith("-v5"))
#: Tasks whose reward no state exceeds that of the model's own pose at rest.
_PENDULUMS = ("InvertedPendulum-v5", "InvertedDoublePendulum-v5")
#: Root of the starts, and of the search.
_ROOT = 20261201
#: A search is over at most so many numbers.
_MOST_NUMBERS = 100
#: The standard deviation of a search at first, as a share of half the range of an action.
_SPREAD = 0.1

#: (corrections [N, K, A] as shares of half an action's range, share of the policy's action []) ->
#: returns [N].
Returns = Callable[..., np.ndarray]


def main() -> None:
    """Reads the command line, searches what is not searched yet, and prints the table."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.studies.optimum",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("tasks", nargs="+", choices=_TASKS)
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=300, help="of a search")
    parser.add_argument("--episodes", type=int, default=64, help="of a round")
    arguments = parser.parse_args()
    if arguments.rounds < 2 or arguments.episodes < 4:
        parser.error("a search needs 2 --rounds or more, of 4 --episodes or more")
    jax.config.update("jax_enable_x64", True)
    origin = {"commit": rows.commit(), "machine": rows.machine()}
    for task in arguments.tasks:
        known = [x for x in _known() if x["task"] == task]
        starts = sorted({*range(arguments.starts)} - {int(x["start"]) for x in known})
        for row in _start_rows(task, starts, arguments.rounds, arguments.episodes):
            rows.append(_FILE, [rows.rounded(row | origin, 9)], _COLUMNS)
            print(row, flush=True)
    print(tables.distances(_known()))


def _known() -> list[dict[str, Any]]:
    return rows.read(_FILE) if _FILE.exists() else []


def _start_rows(
    task: str, starts: list[int], rounds: int, episodes: int
) -> Iterator[dict[str, Any]]:
    """Yields a row for each start; ``episodes`` is N."""
    bound = upright_return(task) if task in _PENDULUMS else None
    env = envs.make(task)
    num_knots = min(env.max_episode_steps, _MOST_NUMBERS // env.action_size)
    games = _games(task, num_knots, episodes)
    nothing = np.zeros((num_knots, env.action_size))
    for start in starts:
        returns = games(start)
        played = float(returns(np.tile(nothing, (episodes, 1, 1)), share=1.0)[0])
        row = {"task": task, "start": start, "policy": played}
        row |= {"episodes": episodes, "knots": num_knots}
        if bound is not None:
            row |= {"method": "bound", "rounds": 0, "second_half": 0.0}
            yield row | {"best": bound, "best_from_rest": bound}
            continue
        # With the policy, and from rest without it.
        searches = [functools.partial(returns, share=share) for share in (1.0, 0.0)]
        bests = [search(score, nothing, rounds, episodes) for score in searches]
        best = max(bests, key=lambda x: x[-1])
        row |= {"method": "search", "best": best[-1], "second_half": best[-1] - best[rounds // 2]}
        yield row | {"best_from_rest": bests[1][-1], "rounds": rounds}


def upright_return(task: str) -> float:
    """Returns the most that an episode of a pendulum earns: its reward at rest, at each step."""
    env: Any = envs.make(task, reset_noise_scale=0.0)
    state = jax.jit(env.reset)(jax.random.key(0))
    state = jax.jit(env.step)(state, jnp.zeros(env.action_size))
    return float(state.reward) * env.max_episode_steps


def _games(task: str, num_knots: int, num_episodes: int) -> Callable[[int], Returns]:
    """Returns what makes ``Returns`` of the number of a start."""
    env = envs.make(task)
    vec, player = make_vec(env, num_episodes, autoreset="disabled"), load(task)
    low, high = (np.asarray(x, float) for x in env.action_space)
    steps = np.arange(env.max_episode_steps)
    knots = np.linspace(0, len(steps) - 1, num_knots)
    # [T, K] what each knot adds to each step.
    weights = np.stack([np.interp(steps, knots, row) for row in np.eye(num_knots)], axis=1)

    @jax.jit
    def play(start: Any, corrections: jax.Array, share: jax.Array) -> jax.Array:
        added = jnp.einsum("tk,nka->tna", weights, corrections) * (high - low) / 2

        def step(carry: tuple[Any, jax.Array], added: jax.Array) -> tuple[Any, jax.Array]:
            state, is_over = carry
            mode = player.policy.distribution.mode(act(player.policy, player.actor, state.obs))
            state = vec.step(state, jnp.clip(share * mode + added, low, high))
            return (state, is_over | state.done), jnp.where(is_over, 0.0, state.reward)

        is_over = jnp.zeros(num_episodes, bool)
        return jax.lax.scan(step, (start, is_over), added)[1].sum(axis=0)

    def game(number: int) -> Returns:
        key = jax.random.fold_in(jax.random.key(_ROOT), number)
        start = vec.reset(jnp.broadcast_to(key, num_episodes))
        return lambda corrections, share: np.asarray(play(start, corrections, share))

    return game


def search(
    score: Callable[[np.ndarray], np.ndarray], center: np.ndarray, rounds: int, size: int
) -> np.ndarray:
    """Maximizes by CMA-ES, with the constants of its tutorial.

    Args:
      score: [size, *shape] -> [size], of which the largest is sought.
      center: [*shape] where the search begins, which is scored, too.
      rounds: how many times ``size`` points are scored.
      size: of a round, 4 or more.

    Returns:
      The best score so far after each round [rounds].
    """
    rng = np.random.default_rng(_ROOT)
    n, parents = center.size, size // 2
    weights = np.log((size + 1) / 2) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1 / np.sum(weights**2)
    path_rate = (4 + effective / n) / (n + 4 + 2 * effective / n)
    spread_rate = (effective + 2) / (n + effective + 5)
    rank_one = 2 / ((n + 1.3) ** 2 + effective)
    rank_many = 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective)
    rank_many = min(1 - rank_one, rank_many)
    damping = 1 + 2 * max(0, np.sqrt((effective - 1) / (n + 1)) - 1) + spread_rate
    usual_length = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    mean, covariance, spread = center.ravel().astype(float), np.eye(n), _SPREAD
    path, spread_path = np.zeros(n), np.zeros(n)
    bests = np.full(rounds, -np.inf)
    axes, scales = np.eye(n), np.ones(n)
    for i in range(rounds):
        moves = (rng.normal(size=(size, n)) * scales) @ axes.T
        if i == 0:
            moves[0] = 0
        scores = score((mean + spread * moves).reshape(size, *center.shape))
        bests[i] = max(scores.max(), bests[max(i - 1, 0)])
        best_moves = moves[np.argsort(-scores)[:parents]]
        move = weights @ best_moves
        mean = mean + spread * move
        whitened = axes @ ((axes.T @ move) / scales)
        spread_path *= 1 - spread_rate
        spread_path += np.sqrt(spread_rate * (2 - spread_rate) * effective) * whitened
        length = np.linalg.norm(spread_path) / usual_length
        is_short = length < (1.4 + 2 / (n + 1)) * np.sqrt(1 - (1 - spread_rate) ** (2 * i + 2))
        path *= 1 - path_rate
        path += is_short * np.sqrt(path_rate * (2 - path_rate) * effective) * move
        covariance *= 1 - rank_one - rank_many
        covariance += rank_one * np.outer(path, path)
        covariance += rank_many * (best_moves.T * weights) @ best_moves
        spread *= np.exp(spread_rate / damping * (length - 1))
        # The axes change slowly, and take longer than a round.
        if i % 8 == 7:
            squares, axes = np.linalg.eigh(covariance)
            scales = np.sqrt(np.maximum(squares, 1e-20))
    return bests


if __name__ == "__main__":
    main()

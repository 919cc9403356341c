"""How far every environment is from the installed Gymnasium: the tables of docs/parity.md.

    python -m experiments.checks.parity                               # all, minutes a task on a CPU
    python -m experiments.checks.parity --env Hopper-v5 --states 500

Four questions to each environment, in double and in single precision: how far one env step from
the same state leads apart; whether the same states end the episode; whether episodes start from the
same distribution; whether a fixed policy earns the same distribution of returns. A task that
Gymnasium lacks is compared with a transcription of the document it comes from.

The states are those that random actions reach from a reset, and as many pushed from there: onto the
joints' limits and past them, faster, into the floor, over the point of falling. Actions go 20%
beyond their bounds.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from scipy import stats

from experiments.checks.parity.native import Native
from experiments.checks.parity.sides import Ours, Outcome, Peer, make_peer, stack
from experiments.checks.parity.states import draw_states
from experiments.kit.markdown import table
from mjx_reinforce import envs
from mjx_reinforce.engine.base import Discrete

DTYPES = ("float64", "float32")
KEYS = ("env", "dtype", "states", "qpos", "qvel", "observation", "reward")
KEYS += ("terminated_mismatches", "terminated_rounding")
KEYS += ("reset_observation", "reset_p_value", "return_p_value")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Compare environments with Gymnasium's, step by step and in distribution."""

    env: tuple[str, ...] = tuple(envs.names())
    """Environments."""
    dtype: tuple[str, ...] = DTYPES
    """Precisions of our side; Gymnasium's is always double."""
    states: int = 2000
    """States to step from."""
    batch: int = 250
    """Our states at once; also the number of episodes whose returns are compared."""
    resets: int = 4000
    """Starts drawn on each side."""
    horizon: int = 100
    """Env steps of an episode whose return is compared, at most."""
    engine: Literal["vmap", "native"] = "vmap"
    """What plays our side: ``jax.vmap`` of the environment, or machine code."""
    seed: int = 0
    """Of states, actions, starts and policies."""
    tolerance: float | None = None
    """At which Gymnasium's constraint solver stops; by default its own 1e-8. Given one, it is
    Newton's for all tasks (the Humanoids have PGS, which ends 1e-3 early); 0 tells Gymnasium's
    distance from the optimum, which is most of what is seen in double precision, from ours."""


def peer_steps(peer: Peer, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> Outcome:
    """Takes one env step from each state."""
    outcomes = []
    for case in zip(qpos, qvel, action, strict=True):
        peer.place(*case[:2])
        outcomes.append(peer.step(case[2]))
    return stack(outcomes)


def step_errors(
    ours: Ours | Native, peer: Peer, states: tuple[np.ndarray, ...], expected: Outcome, eps: float
) -> dict[str, Any]:
    """Compares one env step from each state.

    Args:
      ours: our side.
      peer: the other side.
      states: qpos, qvel and actions.
      expected: what the peer makes of them.
      eps: the precision of our side.

    Returns:
      The largest absolute errors (of the reward and its terms: where both agree on the end), the
      number of states that end the episode on one side only, and how many more of these the peer
      itself decides either way when positions and velocities change by 100 eps.
    """
    actual = ours.steps(*states)
    names = ("qpos", "qvel", "observation")
    row: dict[str, Any] = {name: _max_error(actual, expected, name) for name in names}
    agree = actual.terminated == expected.terminated
    row["reward"] = _max_error(actual, expected, "reward", agree)
    our_terms, their_terms = actual.terms, expected.terms
    for name in their_terms.keys() & our_terms.keys():
        error = np.abs(our_terms[name] - their_terms[name])[agree].max(initial=0)
        row["reward"] = max(row["reward"], float(error))
    cases = [[x[i] for x in states] for i in np.flatnonzero(~agree)]
    rounding = sum(_undecided(peer, *case, size=100 * eps) for case in cases)
    row["terminated_mismatches"] = len(cases) - rounding
    row["terminated_rounding"] = rounding
    return row


def _max_error(actual: Outcome, expected: Outcome, name: str, where: Any = ...) -> float:
    """Returns the largest absolute difference, NaN where only one side is."""
    x, y = getattr(actual, name)[where], getattr(expected, name)[where]
    return float(np.where(np.isnan(x) & np.isnan(y), 0, np.abs(x - y)).max(initial=0))


def _undecided(
    peer: Peer, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, size: float
) -> bool:
    """Returns whether the peer ends the episode for some small changes of a state, not for all."""
    random, ends = np.random.default_rng(0), set()
    for _ in range(50):
        qpos_scale, qvel_scale = (size * random.uniform(-1, 1, x.shape) for x in (qpos, qvel))
        peer.place(qpos + qpos_scale * (1 + abs(qpos)), qvel + qvel_scale * (1 + abs(qvel)))
        ends.add(bool(peer.step(action).terminated))
    return len(ends) == 2


def reset_errors(starts: Outcome, peer: Peer, theirs: Outcome, dtype: str) -> dict[str, float]:
    """Compares starts: the observation at each of ours, and the distributions of both.

    Args:
      starts: ours.
      peer: the other side.
      theirs: starts of the peer.
      dtype: our precision, to which theirs are rounded.

    Returns:
      The largest error of an observation, of up to 100 starts, and ``same_distribution``.
    """
    some = [peer.place(*case) for case in zip(starts.qpos[:100], starts.qvel[:100], strict=True)]
    first = starts._replace(observation=starts.observation[: len(some)])
    samples = [np.concatenate([x.qpos, x.qvel], axis=1) for x in (starts, theirs)]
    return {
        "reset_observation": _max_error(first, stack(some), "observation"),
        "reset_p_value": same_distribution(samples[0], samples[1].astype(dtype)),
    }


def same_distribution(x: np.ndarray, y: np.ndarray) -> float:
    """Tests whether two samples, [N, D] and [M, D], have one distribution.

    The two-sample Kolmogorov-Smirnov test of every entry and of D random directions, which see
    how entries depend on each other (Cramér and Wold, 1936).

    Returns:
      The least p-value, corrected for the number of tests by Bonferroni's rule.
    """
    varies = np.ptp(y, axis=0) > 0
    if not np.array_equal(x[0, ~varies], y[0, ~varies]) or np.any(np.ptp(x[:, ~varies], axis=0)):
        return 0.0
    x, y = (z[:, varies] / y[:, varies].std(axis=0) for z in (x, y))
    directions = np.random.default_rng(0).standard_normal((y.shape[1], y.shape[1]))
    columns = [np.concatenate([z, z @ directions], axis=1).T for z in (x, y)]
    values = [stats.ks_2samp(a, b).pvalue for a, b in zip(*columns, strict=True)]  # type: ignore
    return min(1.0, len(values) * min(values))


def fixed_policy(env: Any, observation_size: int, seed: int) -> Callable[..., np.ndarray]:
    """Returns a random policy that is the same on both sides.

    It maps observations [..., O] to actions: tanh of a linear function, scaled to the bounds, or
    the greater of linear functions.
    """
    random, space = np.random.default_rng(seed), env.action_space
    weights = random.standard_normal((observation_size, env.action_size))
    weights /= math.sqrt(observation_size)

    def act(observation: Any) -> Any:  # of NumPy or of JAX
        numpy: Any = observation.__array_namespace__()
        output = observation @ weights
        if isinstance(space, Discrete):
            return numpy.argmax(output, axis=-1)
        return (space.high + space.low) / 2 + (space.high - space.low) / 2 * numpy.tanh(output)

    return act


def peer_returns(
    peer: Peer, policy: Callable[..., np.ndarray], seed: int, count: int, horizon: int
) -> np.ndarray:
    """Plays episodes one by one; returns their returns [count]."""
    returns = []
    for episode in range(count):
        state, total = peer.reset(seed + episode), 0.0
        for _ in range(horizon):
            state = peer.step(policy(state.observation))
            total += float(state.reward)
            if state.terminated:
                break
        returns.append(total)
    return np.array(returns)


class Theirs(NamedTuple):
    """What the peer says, once for all precisions.

    peer: the other side
    states: qpos, qvel and actions to step from
    expected: where they lead
    starts: of episodes
    """

    peer: Peer
    states: tuple[np.ndarray, ...]
    expected: Outcome
    starts: Outcome

    @classmethod
    def play(
        cls, env_id: str, *, states: int, resets: int, seed: int, tolerance: float | None
    ) -> "Theirs":
        """Draws the states and the starts."""
        peer = make_peer(env_id, tolerance)
        cases = draw_states(peer, envs.make(env_id).action_space, states, seed)
        starts = stack([peer.reset(seed + i) for i in range(resets)])
        return cls(peer, cases, peer_steps(peer, *cases), starts)


def compare(env_id: str, dtype: str, theirs: Theirs, settings: Settings) -> dict[str, Any]:
    """Returns the row of one environment in one precision."""
    with jax.enable_x64(dtype == "float64"):
        ours = (Native if settings.engine == "native" else Ours)(env_id, settings.batch)
        starts = ours.starts(settings.seed, settings.resets)
        row = {"env": env_id, "dtype": dtype, "states": settings.states}
        row |= reset_errors(starts, theirs.peer, theirs.starts, dtype)
        eps = float(np.finfo(dtype).eps)
        row |= step_errors(ours, theirs.peer, theirs.states, theirs.expected, eps)
        policy = fixed_policy(ours.env, starts.observation.shape[1], settings.seed)
        horizon = min(settings.horizon, ours.env.max_episode_steps)
        returns = ours.returns(policy, settings.seed, horizon)
        expected = peer_returns(theirs.peer, policy, settings.seed, settings.batch, horizon)
        row["return_p_value"] = float(stats.ks_2samp(returns, expected).pvalue)  # type: ignore
    return {key: row[key] for key in KEYS}


def main() -> None:
    """Compares and prints, a row for each task and precision."""
    settings = tyro.cli(Settings, prog="python -m experiments.checks.parity", description=__doc__)
    jax.config.update("jax_default_matmul_precision", "highest")
    played = {name: getattr(settings, name) for name in ("states", "resets", "seed", "tolerance")}
    print(
        "qpos to reward, reset observation: largest absolute error. terminated rounding: mismatches"
        "\nthat Gymnasium decides either way within rounding, not counted before. p-values: "
        "Kolmogorov-Smirnov, of starts\nBonferroni-corrected; of many rows some are small.\n"
    )
    print(table([key.replace("_", " ") for key in KEYS], []))
    for env_id in settings.env:
        theirs = Theirs.play(env_id, **played)
        for dtype in settings.dtype:
            print(line(compare(env_id, dtype, theirs, settings)), flush=True)


def line(row: dict[str, Any]) -> str:
    """Returns a row of the table."""
    cells = [f"{x:.1g}" if isinstance(x, float) else str(x) for x in row.values()]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()

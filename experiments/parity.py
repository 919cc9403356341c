"""How far every environment is from the installed Gymnasium, in one table.

    python experiments/parity.py                               # all, minutes a task on a CPU
    python experiments/parity.py --env Hopper-v5 --states 500 --json rows.json

Four questions to each environment, in double and in single precision: how far one env step from
the same state leads apart; whether the same states end the episode; whether episodes start from the
same distribution; whether a fixed policy earns the same distribution of returns. A task that
Gymnasium lacks is compared with a transcription of the document it comes from.

The states are those that random actions reach from a reset, and as many pushed from there: onto the
joints' limits and past them, faster, into the floor, over the point of falling. Actions go 20 %
beyond their bounds.
"""

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import gymnasium
import jax
import mujoco
import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy import stats

from mjx_reinforce import envs
from mjx_reinforce.types import Discrete

DTYPES = ("float64", "float32")
KEYS = (
    "env",
    "dtype",
    "states",
    "qpos",
    "qvel",
    "observation",
    "reward",
    "terminated_mismatches",
    "terminated_rounding",
    "reset_observation",
    "reset_p_value",
    "return_p_value",
)


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
    seed: int = 0
    """Of states, actions, starts and policies."""
    tolerance: float | None = None
    """At which Gymnasium's constraint solver stops; by default its own 1e-8. Given one, it is
    Newton's for all tasks (the Humanoids have PGS, which ends 1e-3 early); 0 tells Gymnasium's
    distance from the optimum, which is most of what is seen in double precision, from ours."""
    json: Path | None = None
    """Where to write the rows."""


class Outcome(NamedTuple):
    """States after a reset or a step, [...] one or [N, ...] many; float64.

    qpos: [..., nq] positions
    qvel: [..., nv] velocities
    observation: [..., O]
    reward: [...]
    terminated: [...]
    terms: the reward's terms by name, [...] each; none at a reset of the peer
    """

    qpos: np.ndarray
    qvel: np.ndarray
    observation: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    terms: dict[str, np.ndarray]


class Peer(Protocol):
    """The other side: one environment with a state that can be set.

    limits: [nq, 2] where the positions' limits are, or the episode's end; NaN where there is none
    """

    limits: np.ndarray

    def reset(self, seed: int) -> Outcome:
        """Starts an episode."""
        ...

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> Outcome:
        """Starts from a given state."""
        ...

    def step(self, action: np.ndarray) -> Outcome:
        """Takes one env step."""
        ...


class MujocoPeer:
    """One of Gymnasium's MuJoCo tasks."""

    def __init__(self, env_id: str, tolerance: float | None):
        self._env: Any = _make(env_id)
        model = self._env.model
        if tolerance is not None:
            model.opt.tolerance, model.opt.iterations = tolerance, 100
            model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON  # type: ignore
        self.limits = np.full((model.nq, 2), np.nan)
        limited = model.jnt_limited != 0
        self.limits[model.jnt_qposadr[limited]] = model.jnt_range[limited]

    def reset(self, seed: int) -> Outcome:
        """Starts an episode."""
        return self._outcome(self._env.reset(seed=seed)[0])

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> Outcome:
        """Starts from a given state, the solver's warm start forgotten."""
        mujoco.mj_resetData(self._env.model, self._env.data)  # type: ignore
        self._env.set_state(qpos, qvel)
        return self._outcome(self._env._get_obs())

    def step(self, action: np.ndarray) -> Outcome:
        """Takes one env step."""
        observation, reward, terminated, _, info = self._env.step(action)
        return self._outcome(observation, reward, terminated, info)

    def _outcome(
        self, observation: Any, reward: Any = 0.0, terminated: Any = False, terms: Any = None
    ):
        data = self._env.data
        return _outcome(data.qpos.copy(), data.qvel.copy(), observation, reward, terminated, terms)


class CartPeer:
    """A cart whose ``state`` is position, velocity, angle and angular velocity.

    Gymnasium rounds the observation to single precision; the state is compared instead.
    """

    def __init__(self, env: Any, max_angle: float):
        self._env = env
        self.limits = np.array([[-2.4, 2.4], [-max_angle, max_angle]])

    def reset(self, seed: int) -> Outcome:
        """Starts an episode."""
        self._env.reset(seed=seed)
        return self._outcome()

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> Outcome:
        """Starts from a given state."""
        self._env.reset(seed=0)
        self._env.state = np.array([qpos[0], qvel[0], qpos[1], qvel[1]])
        return self._outcome()

    def step(self, action: np.ndarray) -> Outcome:
        """Takes one step."""
        _, reward, terminated, *_ = self._env.step(action)
        return self._outcome(reward, terminated)

    def _outcome(self, reward: float = 0.0, terminated: bool = False) -> Outcome:
        state = np.array(self._env.state, float)
        return _outcome(state[[0, 2]], state[[1, 3]], state, reward, terminated)


class DocumentCart:
    """The cart of document 002, transcribed."""

    max_angle = 20 * np.pi / 180

    def reset(self, seed: int) -> None:
        """Starts an episode."""
        self.state = -0.05 + 0.1 * np.random.default_rng(seed).random(4)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Takes one step of Euler's method."""
        x, x_dot, theta, theta_dot = self.state
        total_mass, polemass_length = 1.1, 0.05
        force = 10.0 * action[0]
        costheta, sintheta = math.cos(theta), math.sin(theta)
        temp = (force + polemass_length * theta_dot**2 * sintheta) / total_mass
        theta_acc = (9.8 * sintheta - costheta * temp) / (
            0.5 * (4.0 / 3.0 - 0.1 * costheta**2 / total_mass)
        )
        x_acc = temp - polemass_length * theta_acc * costheta / total_mass
        self.state = self.state + 0.02 * np.array([x_dot, x_acc, theta_dot, theta_acc])
        x, _, theta, _ = self.state
        done = bool(x < -2.4 or x > 2.4 or theta < -self.max_angle or theta > self.max_angle)
        return self.state, 0.0 if done else 1.0, done


def _outcome(
    qpos: Any, qvel: Any, observation: Any, reward: Any, terminated: Any, terms: Any = None
) -> Outcome:
    return Outcome(
        np.asarray(qpos, float),
        np.asarray(qvel, float),
        np.asarray(observation, float),
        np.asarray(reward, float),
        np.asarray(terminated, bool),
        {name: np.asarray(value, float) for name, value in (terms or {}).items()},
    )


def _make(env_id: str) -> Any:
    """Gymnasium's task, without a word on its age."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(env_id).unwrapped


def make_peer(env_id: str, tolerance: float | None = None) -> Peer:
    """Returns what an environment is compared with; see ``Settings.tolerance``."""
    if env_id == "ContinuousCartPole-v0":
        return CartPeer(DocumentCart(), DocumentCart.max_angle)
    if env_id.startswith("CartPole"):
        env = _make(env_id)
        return CartPeer(env, env.theta_threshold_radians)
    return MujocoPeer(env_id, tolerance)


class Ours:
    """Our environment, compiled once for a batch.

    draw: typed keys [B] -> qpos and qvel of starts
    place: qpos and qvel, [B, ...] -> states
    step: states and actions, [B, ...] -> states
    """

    def __init__(self, env_id: str, batch: int):
        self.env: Any = envs.make(env_id)
        self.batch = batch
        self.draw: Callable[..., Any] = jax.jit(jax.vmap(self._draw))
        self.place: Callable[..., Any] = jax.jit(jax.vmap(self.env.set_state))
        self.step: Callable[..., Any] = jax.jit(jax.vmap(self.env.step))

    def _draw(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        physics = self.env.reset(key).pipeline_state
        return physics.qpos, physics.qvel

    def reset(self, seed: int) -> Any:
        """Returns a batch of starts."""
        return self.place(*self.draw(jax.random.split(jax.random.key(seed), self.batch)))

    def starts(self, seed: int, count: int) -> Outcome:
        """Returns at least ``count`` starts, a seed a batch."""
        seeds = range(seed, seed - (-count // self.batch))
        return stack([as_outcome(self.reset(seed)) for seed in seeds], np.concatenate)

    def steps(self, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> Outcome:
        """Takes one env step from each state."""
        parts, dtype = [], jax.dtypes.canonicalize_dtype(float)
        for first in range(0, len(qpos), self.batch):
            rows = np.arange(first, first + self.batch) % len(qpos)  # the last batch wraps around
            state = self.place(qpos[rows].astype(dtype), qvel[rows].astype(dtype))
            parts.append(as_outcome(self.step(state, _cast(action[rows], dtype))))
        return jax.tree.map(lambda x: x[: len(qpos)], stack(parts, np.concatenate))

    def returns(self, policy: Callable[..., np.ndarray], seed: int, horizon: int) -> np.ndarray:
        """Plays one batch of episodes; returns their returns [B]."""
        state = self.reset(seed)
        total, alive = np.zeros(self.batch), np.ones(self.batch, bool)
        for _ in range(horizon):
            action = _cast(policy(np.asarray(state.obs, float)), state.obs.dtype)
            after = self.step(state, action)
            total += np.where(alive, np.asarray(after.reward), 0)
            alive &= np.asarray(after.done) == 0
            state = jax.tree.map(functools.partial(_where, alive), after, state)
            if not alive.any():
                break
        return total


def _where(alive: np.ndarray, after: Any, before: Any) -> np.ndarray:
    """Lets a finished episode stand still: its state must not run off to infinity."""
    return np.where(alive.reshape(-1, *[1] * (after.ndim - 1)), after, before)


def _cast(action: np.ndarray, dtype: Any) -> np.ndarray:
    """Returns actions as our environments take them."""
    return action.astype(np.int32 if np.issubdtype(action.dtype, np.integer) else dtype)


def as_outcome(state: Any) -> Outcome:
    """Returns what a state of ours shares with Gymnasium's."""
    physics = state.pipeline_state
    return _outcome(physics.qpos, physics.qvel, state.obs, state.reward, state.done, state.metrics)


def stack(outcomes: list[Outcome], join: Callable[..., np.ndarray] = np.stack) -> Outcome:
    """Joins outcomes along the first axis."""
    return jax.tree.map(lambda *column: join(column), *outcomes)


def draw_states(
    peer: Peer, space: Any, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws states and actions: reached by random actions, and every other one pushed.

    Args:
      peer: where they are reached.
      space: the actions, our Box or Discrete.
      count: N.
      seed: of everything.

    Returns:
      qpos [N, nq], qvel [N, nv] and actions [N, A], or [N] if discrete.
    """
    random = np.random.default_rng(seed)
    reached = _reached(peer, space, random)
    qpos, qvel = map(np.array, zip(*(next(reached) for _ in range(count)), strict=True))
    for i in range(0, count, 2):
        qpos[i], qvel[i] = _pushed(qpos[i], qvel[i], peer.limits, random)
    action = np.array([random_action(space, random) for _ in range(count)])
    return qpos, qvel, action


def random_action(space: Any, random: np.random.Generator) -> np.ndarray:
    """Draws an action, of a Box up to 20 % beyond its bounds."""
    if isinstance(space, Discrete):
        return random.integers(space.num_actions)  # type: ignore
    return random.uniform(1.2 * space.low, 1.2 * space.high)


def _reached(
    peer: Peer, space: Any, random: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields one state in four on the way of episodes of up to 80 steps."""
    while True:
        state = peer.reset(int(random.integers(2**31)))
        for _ in range(random.integers(1, 81)):
            if random.uniform() < 0.25:
                yield state.qpos, state.qvel
            if state.terminated:
                break
            state = peer.step(random_action(space, random))


def _pushed(
    qpos: np.ndarray, qvel: np.ndarray, limits: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Moves a state a little or a lot, some of its joints to their limits, and makes it faster.

    A quaternion may lose its length here; MuJoCo and MJX both normalise it.
    """
    size = 10 ** random.uniform(-3, -0.5)
    qpos = qpos + size * random.uniform(-1, 1, qpos.shape)
    low, high = limits.T
    near = np.where(random.uniform(size=qpos.shape) < 0.5, low, high)
    near = near + 0.02 * (high - low) * random.standard_normal(qpos.shape)
    chosen = (random.uniform(size=qpos.shape) < 0.2) & np.isfinite(near)
    qvel = random.uniform(0, 2) * qvel + 10 * size * random.uniform(-1, 1, qvel.shape)
    return np.where(chosen, near, qpos), qvel


def peer_steps(peer: Peer, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> Outcome:
    """Takes one env step from each state."""
    outcomes = []
    for case in zip(qpos, qvel, action, strict=True):
        peer.place(*case[:2])
        outcomes.append(peer.step(case[2]))
    return stack(outcomes)


def step_errors(
    ours: Ours, peer: Peer, states: tuple[np.ndarray, ...], expected: Outcome, eps: float
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
    """Tells whether the peer ends the episode for some small changes of a state, not for all."""
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

    def act(observation: np.ndarray) -> np.ndarray:
        output = observation @ weights
        if isinstance(space, Discrete):
            return np.argmax(output, axis=-1)
        return (space.high + space.low) / 2 + (space.high - space.low) / 2 * np.tanh(output)

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


def compare(
    env_id: str, dtype: str, theirs: Theirs, settings: Settings, say: Callable[[str], None]
) -> dict[str, Any]:
    """Returns the row of one environment in one precision; ``say`` hears what comes next."""
    with jax.enable_x64(dtype == "float64"):
        ours = Ours(env_id, settings.batch)
        say("starts")
        starts = ours.starts(settings.seed, settings.resets)
        row = {"env": env_id, "dtype": dtype, "states": settings.states}
        row |= reset_errors(starts, theirs.peer, theirs.starts, dtype)
        say("steps")
        eps = float(np.finfo(dtype).eps)
        row |= step_errors(ours, theirs.peer, theirs.states, theirs.expected, eps)
        say("returns")
        policy = fixed_policy(ours.env, starts.observation.shape[1], settings.seed)
        horizon = min(settings.horizon, ours.env.max_episode_steps)
        returns = ours.returns(policy, settings.seed, horizon)
        expected = peer_returns(theirs.peer, policy, settings.seed, settings.batch, horizon)
        row["return_p_value"] = float(stats.ks_2samp(returns, expected).pvalue)  # type: ignore
    return {key: row[key] for key in KEYS}


def main() -> None:
    """Compares, prints and writes."""
    settings = tyro.cli(Settings, description=__doc__)
    jax.config.update("jax_default_matmul_precision", "highest")
    console, rows = Console(width=180), []
    with Progress(console=console) as progress:
        task = progress.add_task("", total=len(settings.env) * len(settings.dtype))
        for env_id in settings.env:

            def say(what: str, name: str = env_id):
                progress.update(task, description=f"{name}, {what}")

            say("Gymnasium")
            theirs = Theirs.play(
                env_id,
                states=settings.states,
                resets=settings.resets,
                seed=settings.seed,
                tolerance=settings.tolerance,
            )
            for dtype in settings.dtype:
                rows.append(compare(env_id, dtype, theirs, settings, say))
                progress.advance(task)
    show(console, rows)
    if settings.json:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def show(console: Console, rows: list[dict[str, Any]]) -> None:
    """Prints the table."""
    table = Table(*(key.replace("_", " ") for key in KEYS))
    for row in rows:
        table.add_row(*(_format(row[key]) for key in KEYS))
    console.print(table)
    console.print(
        "qpos to reward, reset observation: largest absolute error. terminated rounding: mismatches"
        "\nthat Gymnasium decides either way within rounding, not counted before. p-values: "
        "Kolmogorov-Smirnov, of starts\nBonferroni-corrected; of many rows some are small."
    )


def _format(value: Any) -> str:
    return f"{value:.2g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()

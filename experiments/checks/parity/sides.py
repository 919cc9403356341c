"""The two sides: Gymnasium's environment, and ours."""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import gymnasium
import jax
import mujoco
import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.envs.base import MujocoEnv


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

    draw: typed keys [B] -> qpos and qvel of starts, by name
    place: qpos and qvel, [B, ...] -> states
    step: states and actions, [B, ...] -> states
    """

    def __init__(self, env_id: str, batch: int):
        self.env: Any = envs.make(env_id)
        self.batch = batch
        self.draw: Callable[..., Any] = jax.jit(jax.vmap(self._draw))
        self.place: Callable[..., Any] = jax.jit(jax.vmap(self.env.set_state))
        self.step: Callable[..., Any] = jax.jit(jax.vmap(self.env.step))

    def _draw(self, key: jax.Array) -> dict[str, jax.Array]:
        if isinstance(self.env, MujocoEnv):  # without a forward pass, which takes seconds to trace
            return self.env.draw(key)[1]
        physics = self.env.reset(key).pipeline_state
        return {"qpos": physics.qpos, "qvel": physics.qvel}

    def reset(self, seed: int) -> Any:
        """Returns a batch of starts."""
        return self.place(**self.draw(jax.random.split(jax.random.key(seed), self.batch)))

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

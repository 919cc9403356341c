"""A generic task on any model, played by this package and by a plain loop of C MuJoCo."""

import copy
import importlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

from experiments.checks.robots.models import Start, start_of
from experiments.kit.rows import shared_clock
from mjx_reinforce import make_vec
from mjx_reinforce.engine.memory import num_cores
from mjx_reinforce.engine.play.choice import ActingPolicy, choose
from mjx_reinforce.envs.base import MujocoEnv

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: Compared are so many env steps, and one more, which ends the episode.
STEPS = 10
#: What counts as equal, relative above 1.
EQUAL = 1e-9
#: Physics steps an env step, for equality and for speed.
FRAME_SKIPS = {"equality": 2, "speed": 5}
#: The sine of the control makes so much of a turn in a physics step (rad), and differs from
#: actuator to actuator.
_TURN = 0.35
_PHASE = 1.3
#: C from a start that is moved by so much: what it then differs from itself, nobody can repeat.
_NUDGE = 1e-12
_NUM_NUDGES = 3
#: Episodes at once where speed is measured, the seconds of one measurement, and how many there are.
_NUM_EPISODES = 64
_SECONDS = 0.4
_MEASUREMENTS = 5
#: Warnings after which C has begun again, or has left something out: they end an episode.
_BREAKING = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL")


class Generic(MujocoEnv):
    """A task that any model can play: it sees time, qpos, qvel and every sensor."""

    def __init__(self, model: Any, start: Start, frame_skip: int):
        """Begins each episode at ``start``."""
        self.start = start
        super().__init__(
            xml_file=model, frame_skip=frame_skip, max_episode_steps=1000, reward_threshold=None
        )

    def initial(self, rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the start, the same in every episode."""
        real = jnp.result_type(float)
        return jnp.asarray(self.start.qpos, real), jnp.asarray(self.start.qvel, real)

    def observe(self, data: Any) -> jax.Array:
        """Returns the time, qpos, qvel and the sensors."""
        return observation(data, jnp)

    def outcome(self, before: Any, data: Any, action: jax.Array) -> Any:
        """Returns ``reward`` and ``is_over``."""
        limit = (STEPS + 0.5) * self.dt
        if self.frame_skip == FRAME_SKIPS["speed"]:
            limit = np.inf
        return reward(before.qpos, data, action, self.dt), is_over(data, limit), {}


def observation(data: Any, xp: Any) -> Any:
    """Returns what the task sees of a simulation, by JAX or NumPy."""
    return xp.concatenate([xp.reshape(data.time, 1), data.qpos, data.qvel, data.sensordata])


def reward(qpos: Any, data: Any, action: Any, dt: float) -> Any:
    """Returns a reward of positions before and after, the height of the mass, and the action."""
    return (data.qpos - qpos).sum() / dt + data.subtree_com[0, 2] - 1e-3 * (action**2).sum()


def is_over(data: Any, limit: float) -> Any:
    """Returns whether the mass has fallen far, or it is late."""
    return (data.subtree_com[0, 2] < -10.0) | (data.time > limit)


class Sine:
    """A distribution whose mode is played: the control of the policy."""

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Draws a number that is not used."""
        return jax.random.normal(key, (*shape, 1))

    def sample(self, outputs: jax.Array, noise: jax.Array) -> jax.Array:
        """Returns the control."""
        return outputs

    def mode(self, outputs: jax.Array) -> jax.Array:
        """Returns the control."""
        return outputs


def policy_of(start: Start, timestep: float) -> ActingPolicy:
    """Returns a policy that plays a sine around the start's control."""
    phases = _PHASE * np.arange(start.control.size)
    actor = jax.tree.map(jnp.asarray, (start.control, start.amplitude, phases))

    def act(actor: Any, seen: jax.Array) -> jax.Array:
        control, amplitude, phase = actor
        return control + amplitude * jnp.sin(_TURN / timestep * seen[..., :1] + phase)

    return ActingPolicy(act, actor, Sine())


class Played(NamedTuple):
    """An episode of T env steps: observation [T + 1, O], reward [T] and over [T].

    Where the last step broke the episode, the observation after it is not there.
    """

    observation: np.ndarray
    reward: np.ndarray
    over: np.ndarray


def by_c(model: Any, start: Start, actions: np.ndarray, nudge: np.ndarray | float = 0.0) -> Played:
    """Returns an episode by C MuJoCo alone, under actions [T, A]."""
    data = mujoco.MjData(model)
    data.qpos[:] = start.qpos
    data.qvel[:] = start.qvel + nudge
    mujoco.mj_forward(model, data)
    frame_skip = FRAME_SKIPS["equality"]
    dt = frame_skip * model.opt.timestep
    observations = [observation(data, np)]
    rewards, overs = [], []
    for action in actions:
        qpos = data.qpos.copy()
        data.ctrl[:] = action
        if _breaks(model, data, frame_skip):
            return Played(*map(np.asarray, (observations, [*rewards, 0.0], [*overs, True])))
        observations.append(observation(data, np))
        rewards.append(reward(qpos, data, action, dt))
        overs.append(is_over(data, (STEPS + 0.5) * dt))
        if overs[-1]:
            break
    return Played(*map(np.asarray, (observations, rewards, overs)))


def _breaks(model: Any, data: Any, num_steps: int) -> bool:
    """Makes physics steps, and returns whether C has begun again or has left something out."""
    try:
        mujoco.mj_step(model, data, num_steps)
    except mujoco.FatalError:
        return True
    kinds = [getattr(mujoco.mjtWarning, f"mjWARN_{name}") for name in _BREAKING]
    return any(data.warning[int(kind)].number for kind in kinds)


def by_rollout(engine: Any, env: Generic, policy: ActingPolicy) -> tuple[Played, np.ndarray]:
    """Returns an episode by training's rollout, and its actions [T, A]."""
    options: Any = {"num_episodes": 2, "horizon": STEPS + 2, "deterministic": True}
    play = jax.jit(
        lambda actor, key: engine.rollout(
            env, policy.act, actor, policy.distribution, key, **options
        )
    )
    episodes = jax.tree.map(np.asarray, play(policy.actor, jax.random.key(0)))
    length = int(episodes.mask[:, 1].sum())
    over = np.arange(1, length + 1) == length
    shown = Played(episodes.observation[:length, 1], episodes.reward[:length, 1], over)
    return shown, episodes.action[:length, 1]


def by_make_vec(name: str, env: Generic, actions: np.ndarray) -> Played:
    """Returns an episode by ``make_vec``, under actions [T, A]."""
    vec = make_vec(env, 2, autoreset="disabled", engine=name)

    @jax.jit
    def play(key: jax.Array, actions: jax.Array) -> Any:
        def step(state: Any, action: jax.Array) -> Any:
            state = vec.step(state, jnp.broadcast_to(action, (2, action.size)))
            return state, (state.final_obs[1], state.reward[1], state.terminated[1])

        start = vec.reset(key)
        return start.obs[1], jax.lax.scan(step, start, actions)[1]

    first, (observations, rewards, overs) = play(jax.random.key(0), jnp.asarray(actions))
    return Played(*map(np.asarray, (jnp.concatenate([first[None], observations]), rewards, overs)))


def difference(shown: Played, expected: Played) -> tuple[float, str]:
    """Returns the largest difference, relative above 1, and where it is."""
    if not np.array_equal(shown.over, expected.over):
        return np.inf, f"ends after {shown.over.size} env steps, not {expected.over.size}"
    count = min(len(shown.observation), len(expected.observation))
    pairs = {
        "observation": (shown.observation[:count], expected.observation[:count]),
        "reward": (shown.reward, expected.reward),
    }
    errors = {}
    for name, (x, y) in pairs.items():
        error = np.abs(x - y) / np.maximum(1, np.abs(y))
        errors[name] = np.nan_to_num(np.where(np.isnan(x) & np.isnan(y), 0, error), nan=np.inf)
    name = max(errors, key=lambda name: errors[name].max(initial=0))
    place = [int(i) for i in np.unravel_index(errors[name].argmax(), errors[name].shape)]
    return float(errors[name].max(initial=0)), f"{name} {place}"


def equality(model: Any, name: str) -> dict[str, Any]:
    """Returns how far the engine of a name is from C MuJoCo in ten env steps."""
    start = start_of(model)
    env = Generic(model, start, FRAME_SKIPS["equality"])
    policy = policy_of(start, model.opt.timestep)
    default = choose("auto", env)  # without a policy nothing is compiled
    start_time = time.perf_counter()
    engine = choose(name, env, policy, STEPS + 2)
    rolled_out, actions = by_rollout(engine, env, policy)
    seconds = time.perf_counter() - start_time
    row = {"engine": engine.name, "why": engine.why, "seconds": f"{seconds:.1f}"}
    if default.name == "mujoco":  # then this row is that of auto, too
        row |= {"auto": "mujoco", "why": default.why}
    episodes = {"rollout": rolled_out, "make_vec": by_make_vec(name, env, actions)}
    return row | _verdict(episodes, model, start, actions)


def _verdict(
    episodes: dict[str, Played], model: Any, start: Start, actions: np.ndarray
) -> dict[str, str]:
    """Returns the error and whether the episodes are C MuJoCo's, and the cause where they are not.

    Args:
      episodes: by the name of what played them.
      model: the model.
      start: where they began.
      actions: [T, A] of all.
    """

    def worst(expected: Played) -> tuple[float, str]:
        """Returns the largest difference of an episode, and where it is."""
        differences = {name: difference(shown, expected) for name, shown in episodes.items()}
        name = max(differences, key=lambda name: differences[name][0])
        return differences[name][0], f"{name}, {differences[name][1]}"

    expected = by_c(model, start, actions)
    error, place = worst(expected)
    row = {"error": f"{error:.1e}", "verdict": "equal", "cause": ""}
    if error <= EQUAL:
        if len(expected.observation) == len(expected.reward):
            row["cause"] = f"C begins again in env step {len(expected.reward)}, which ends it"
        return row
    from_optimum, _ = worst(by_c(optimum(model), start, actions))
    if from_optimum <= EQUAL:
        cause = f"C stops before its optimum, from which this is {from_optimum:.1e}"
        return row | {"verdict": "optimum", "cause": cause}
    random = np.random.default_rng(0)
    nudges = [_NUDGE * random.standard_normal(model.nv) for _ in range(_NUM_NUDGES)]
    moved = [by_c(model, start, actions, nudge) for nudge in nudges]
    apart = max(difference(episode, expected)[0] for episode in moved)
    cause = f"after a start 1e-12 apart C differs by {apart:.1e}"
    if error <= apart:
        return row | {"verdict": "chaos", "cause": cause}
    return row | {"verdict": "differing", "cause": f"{place}; {cause}"}


def optimum(model: Any) -> Any:
    """Returns a model whose solver goes on to the optimum."""
    exact = copy.copy(model)
    exact.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    exact.opt.tolerance = exact.opt.ls_tolerance = 0
    exact.opt.iterations = 200
    exact.opt.ls_iterations = max(50, model.opt.ls_iterations)
    return exact


def speed(model: Any) -> dict[str, Any]:
    """Returns the env steps a second of training's rollout beside those of a bare ``Batch``.

    Both take turns, and each number is a median over turns. The speed counts the first of
    ``_clocks``; the ratio has a value for each of the two.
    """
    start = start_of(model)
    policy = policy_of(start, model.opt.timestep)
    bare = _bare_batch(model, start)
    pace, _ = bare(2)
    horizon = int(np.clip(pace * _SECONDS / _NUM_EPISODES, 4, 500))
    start_time = time.perf_counter()
    env = Generic(model, start, FRAME_SKIPS["speed"])
    engine = choose("auto", env, policy, horizon)
    options: Any = {"num_episodes": _NUM_EPISODES, "horizon": horizon, "deterministic": True}
    play = jax.jit(
        lambda actor, key: engine.rollout(
            env, policy.act, actor, policy.distribution, key, **options
        )
    )

    def ours() -> np.ndarray:
        began = _clocks()
        episodes = jax.block_until_ready(play(policy.actor, jax.random.key(0)))
        return float(episodes.mask.sum()) / (_clocks() - began)

    ours()
    seconds = time.perf_counter() - start_time
    rates = [(ours(), bare(horizon)) for _ in range(_MEASUREMENTS)]
    rate, _ = np.median([rate for rate, _ in rates], axis=0)
    ratios = np.median([rate / bare_rate for rate, bare_rate in rates], axis=0)
    return {
        "engine": engine.name,
        "why": engine.why,
        "seconds": f"{seconds:.1f}",
        "steps_per_s": round(rate),
        "ratio": f"{ratios[0]:.3g}",
        "ratio_by_clock": f"{ratios[1]:.3g}",
        "verdict": "measured",
    }


def _clocks() -> np.ndarray:
    """Returns [2] seconds: those that a core of this process has computed, and the clock's.

    Other programs slow down the second one only.
    """
    return np.array([shared_clock(), time.perf_counter()])


def _bare_batch(model: Any, start: Start) -> Callable[[int], np.ndarray]:
    """Returns a function of a number of env steps: C MuJoCo's env steps a second, by clocks."""
    batch = Batch(model, _NUM_EPISODES, nthread=num_cores())
    frame_skip = FRAME_SKIPS["speed"]
    turns = _TURN * frame_skip
    phases = _PHASE * np.arange(model.nu)

    def play(num_steps: int) -> np.ndarray:
        batch.reset()
        batch.bind("qpos")[:] = start.qpos
        batch.bind("qvel")[:] = start.qvel
        began = _clocks()
        for step in range(num_steps):
            batch.bind("ctrl")[:] = start.control + start.amplitude * np.sin(turns * step + phases)
            batch.step(nstep=frame_skip)
        return num_steps * _NUM_EPISODES / (_clocks() - began)

    return play

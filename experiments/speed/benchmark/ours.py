"""Our engines, as `python -m experiments.speed.benchmark` times them."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from mujoco import mjx

from experiments.speed.benchmark.robots import make
from experiments.speed.benchmark.rows import TRAINED, UNTRAINED, Candidate
from mjx_reinforce import Actor, Policy, act, categorical, load, mlp_policy, normal
from mjx_reinforce.engine.base import Discrete, action_space, observation_size
from mjx_reinforce.engine.devices import executable
from mjx_reinforce.engine.play.choice import ActingPolicy, choose
from mjx_reinforce.learning import normalize

#: Name in the table -> engine.
ENGINES = {"plain MJX": "vmap", "native": "native"}


@struct.dataclass
class LoopState:
    """A state of a looping environment, and where it starts again."""

    inner: Any
    start: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array


class Loop:
    """An environment whose episodes never end: they start again where they started."""

    def __init__(self, env: Any, steps: int):
        self.env, self.max_episode_steps = env, steps
        self.action_size, self.action_space = env.action_size, action_space(env)

    def reset(self, rng):
        """Starts an episode, and remembers the start."""
        state = self.env.reset(rng)
        return LoopState(state, state, state.obs, state.reward, state.done)

    def step(self, state, action):
        """Steps, or goes back to the start where the episode is over."""
        after = self.env.step(state.inner, action)
        over = after.done > 0
        inner = jax.tree.map(lambda s, x: jnp.where(over, s, x), state.start, after)
        return LoopState(inner, state.start, inner.obs, after.reward, jnp.zeros_like(after.done))


def rollouts(
    env_id: str, name: str, batches: list[int], steps: int, precision: str = "float32"
) -> list[Candidate]:
    """Whole rollouts with a policy, its noise and all that an update needs, for every batch."""
    with jax.enable_x64(precision == "float64"):
        return list(map(rollout_of(env_id, name, steps, precision), batches))


def rollout_of(
    env_id: str, name: str, steps: int, precision: str = "float32", run: Path | None = None
) -> Callable[[int], Candidate]:
    """Makes the machine code of a rollout; returns what compiles a program of so many episodes.

    Args:
      env_id: the task.
      name: one of ``ENGINES``.
      steps: of an episode.
      precision: for the row.
      run: whose best policy plays; an untrained one if not given.

    Raises:
      ValueError: the engine cannot play this.
    """
    task: Any = make(env_id)
    if name == "plain MJX":
        task._dynamics.forward = partial(mjx.forward, task.model)
        task._dynamics.physics_step = partial(mjx.step, task.model)
    env = Loop(task, steps)
    if run is None:
        network, actor = untrained(env)
    else:
        player = load(run)
        network, actor = player.policy, player.actor
    play_act = partial(act, network)
    began = time.perf_counter()
    policy = ActingPolicy(play_act, actor, network.distribution)
    engine = choose(ENGINES[name], env, policy, steps)
    choosing = time.perf_counter() - began  # machine code is made here

    def of(batch: int) -> Candidate:
        def play(actor, key):
            sizes = {"num_episodes": batch, "horizon": steps}
            return engine.rollout(env, play_act, actor, network.distribution, key, **sizes)

        row = {"what": UNTRAINED if run is None else TRAINED, "engine": name, "task": env_id}
        row |= {"precision": precision, "batch": batch, "steps": steps, "settings": engine.why}
        return compiled(row, play, actor, batch * steps, choosing)

    return of


def untrained(env: Any) -> tuple[Policy, Actor]:
    """Returns a new policy with layers of 16 and 32 units, and its parameters."""
    size = observation_size(env)
    space = action_space(env)
    # The noise decides how soon a robot falls; it is that of all rows so far, in the action's unit.
    noisy = partial(normal, initial_std=0.5)
    distribution = (categorical if isinstance(space, Discrete) else noisy)(space)
    network = mlp_policy(size, distribution, (16, 32))
    params = network.init(jax.random.key(0))
    return network, Actor(params=params, normalizer=normalize.init(size))


def compiled(
    row: dict[str, Any], fn: Callable[..., Any], argument: Any, env_steps: int, before: float
) -> Candidate:
    """Compiles ``fn(argument, key)``, and notes how long that and what came before took (s)."""
    started = time.perf_counter()
    program = executable(jax.jit(fn).lower(argument, jax.random.key(0)))
    row["compile_seconds"] = before + time.perf_counter() - started
    row["device"] = jax.devices()[0].device_kind
    keys = iter(jax.random.split(jax.random.key(1), 1000))
    return Candidate(row, lambda: jax.block_until_ready(program(argument, next(keys))), env_steps)

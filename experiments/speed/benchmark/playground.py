"""Env steps of MuJoCo Playground's tasks under random actions: Playground's own, and ours."""

import concurrent.futures
import functools
import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco_playground import registry

import mjx_reinforce as mr
from experiments.speed.benchmark.rows import Candidate

#: What stands before a task's name in its id.
PREFIX = "playground:"
#: What a row says of the actions.
STEPS = "env steps, random actions"
#: Its physics -> what a row says of the engine.
IMPLEMENTATIONS = {"jax": "Playground, MJX", "warp": "Playground, MJX-Warp"}
#: Env steps of a call, and how long the calls of a timed run take together (s), about.
_STEPS = 10
_RUN_SECONDS = 0.7
#: A task's own room for contacts (``naconmax``), which all worlds share, is for so many worlds.
_WORLDS = 8192
#: Starts of MJX, which are repeated: to make as many as there are worlds takes long.
_STARTS = 128


class Stepping(NamedTuple):
    """Programs of something that plays a task; traced first, then compiled.

    row: of what is timed
    start: key -> the states of the worlds
    advance: (states, key) -> the states after ``_STEPS`` env steps of all worlds
    """

    row: dict[str, Any]
    start: Any
    advance: Any


def compiled(task: str, batches: tuple[int, ...]) -> list[Stepping]:
    """Returns the programs of all that play a task, for each number of worlds; compiled at once.

    What fails is left out, and its reason is printed.
    """
    # One trace after the other: while ours goes on, Playground's functions are exchanged.
    traced = [
        stepping
        for batch in batches
        for implementation in (None, *IMPLEMENTATIONS)
        for stepping in _or_reason(_traced, task, batch, implementation)
    ]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        programs = pool.map(lambda stepping: _or_reason(_compiled, stepping), traced)
        return [stepping for steppings in programs for stepping in steppings]


def _or_reason(make: Callable[..., Any], *arguments: Any) -> list[Any]:
    """Returns what is made, alone; or nothing, after the reason is printed."""
    try:
        return [make(*arguments)]
    except Exception as error:  # whatever it raises, the others are timed
        print(f"left out: {arguments[:3]!r:.100}: {error!r:.500}", file=sys.stderr, flush=True)
        return []


def _traced(task: str, batch: int, implementation: str | None) -> Stepping:
    """Returns the programs of ours (None), or of Playground's own."""
    if implementation is None:
        settings = "make_vec"
        task_env: Any = mr.envs.make(task)
        action_size = task_env.action_size
        vec = mr.make_vec(task_env, num_envs=batch)
        start = vec.reset
        step = vec.step
    else:
        env, settings = _environment(task, batch, implementation)
        action_size = env.action_size
        start = functools.partial(_start, env, batch, implementation)
        step = jax.vmap(env.step)

    def advance(states: Any, key: jax.Array) -> Any:
        """Draws the actions [N, A] of each step evenly from [-1, 1]."""

        def take(states: Any, key: jax.Array) -> tuple[Any, None]:
            action = jax.random.uniform(key, (batch, action_size), minval=-1, maxval=1)
            return step(states, action), None

        return jax.lax.scan(take, states, jax.random.split(key, _STEPS))[0]

    key = jax.random.key(0)
    states = jax.eval_shape(start, key)
    engine = "native" if implementation is None else IMPLEMENTATIONS[implementation]
    row = {"what": STEPS, "engine": engine, "task": task, "precision": "float32"}
    row |= {"batch": batch, "steps": _STEPS, "settings": settings}
    row["device"] = jax.devices()[0].device_kind
    return Stepping(row, jax.jit(start).lower(key), jax.jit(advance).lower(states, key))


def _environment(task: str, batch: int, implementation: str) -> tuple[Any, str]:
    """Returns Playground's environment, and its settings in words."""
    name = task.removeprefix(PREFIX)
    config: Any = registry.get_default_config(name)
    # All worlds of Warp share the room; MJX has its own in each.
    room = math.ceil(config.naconmax * max(1, batch / _WORLDS))
    overrides = {"impl": implementation, "naconmax": room}
    env: Any = registry.load(name, config_overrides=overrides)
    if implementation == "warp":
        # Its kernels would print a line wherever the few iterations of the files are used up.
        env._mjx_model = env.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
    return env, f"naconmax {room}"


def _start(env: Any, batch: int, implementation: str, key: jax.Array) -> Any:
    """Returns the states of all worlds."""
    num_starts = min(batch, _STARTS) if implementation == "jax" else batch
    states = jax.vmap(env.reset)(jax.random.split(key, num_starts))
    if num_starts == batch:
        return states
    repeats = math.ceil(batch / num_starts)
    return jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=0)[:batch], states)


def _compiled(stepping: Stepping) -> Stepping:
    """Returns programs that can be called, and how long XLA took (s)."""
    began = time.perf_counter()
    start = stepping.start.compile()
    advance = stepping.advance.compile()
    if stepping.row["engine"] == IMPLEMENTATIONS["warp"]:
        # Warp compiles its kernels when they first run.
        key = jax.random.key(0)
        jax.block_until_ready(advance(start(key), key))
    row = stepping.row | {"compile_seconds": time.perf_counter() - began}
    return Stepping(row, start, advance)


def _lacking(states: Any) -> str:
    """Returns what Warp had too little room for, but for iterations, of which files allow few."""
    from mujoco.mjx.third_party.mujoco_warp import OverflowType  # pyright: ignore

    flags = OverflowType(
        int(np.bitwise_or.reduce(np.asarray(states.data._impl.overflow), axis=None))
    )
    names = [flag.name for flag in flags if "ITERATIONS" not in str(flag.name)]
    return f"too little room for {', '.join(map(str, names))}" if names else "room enough"


def candidates(steppings: list[Stepping]) -> list[Candidate]:
    """Returns what is timed; what fails, such as for lack of memory, is left out."""
    return [x for stepping in steppings for x in _or_reason(_candidate, stepping)]


def _candidate(stepping: Stepping) -> Candidate:
    """Returns what is timed: worlds that go on from where they are."""
    row = stepping.row
    states = [stepping.start(jax.random.key(0))]
    keys = iter(jax.random.split(jax.random.key(1), 100_000))

    def advance() -> float:
        """Makes the env steps of a call; returns how long it took (s)."""
        began = time.perf_counter()
        states[0] = jax.block_until_ready(stepping.advance(states[0], next(keys)))
        return time.perf_counter() - began

    advance()  # warms up
    if row["engine"] == IMPLEMENTATIONS["warp"]:
        row = row | {"settings": f"{row['settings']}; {_lacking(states[0])}"}
    num_calls = max(1, math.ceil(_RUN_SECONDS / advance()))

    def run() -> None:
        """Makes the env steps of a timed run."""
        for _ in range(num_calls):
            advance()

    return Candidate(row, run, num_calls * _STEPS * int(row["batch"]))

"""Tasks of MuJoCo Playground on this CPU: our physics and speed beside Playground's and C MuJoCo's.

Episodes begin where the task's own ``reset`` has them begin, and the same random actions are
applied. After some env steps the positions and velocities are compared, each error divided by the
number where that is above 1. A file of the suite allows its solver few iterations, so that each
solver ends elsewhere: in the last column ours and MJX's run to the optimum.

Speed is that of env steps without resets, of both in turn, in float32.
"""

import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from mujoco import mjx  # pyright: ignore[reportAttributeAccessIssue] (a C extension)

from experiments.kit import markdown
from mjx_reinforce import envs, make_vec
from mjx_reinforce.engine.play.counter import key_of_words
from mjx_reinforce.engine.play.program import machine_map
from mjx_reinforce.engine.team import supported

#: One task of each model of the suite; those of the humanoid and the fish compile longest.
TASKS = (
    *("AcrobotSwingup", "BallInCup", "CartpoleSwingup", "CheetahRun", "FingerSpin", "HopperHop"),
    *("PendulumSwingup", "ReacherEasy", "SwimmerSwimmer6", "WalkerRun"),
)
#: What counts as equal in float32; of a task that is not, the solvers run to the optimum, too.
_EQUAL = 1e-6
#: What lets a solver run to the optimum.
_ITERATIONS = {"iterations": 100, "ls_iterations": 50}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What is compared."""

    tasks: tuple[str, ...] = TASKS
    """Names of Playground's registry."""
    what: Literal["parity", "speed", "engines"] = "parity"
    """The errors; env steps a second; or what plays each task."""
    float64: bool = False
    """Whether JAX computes in float64."""
    episodes: int = 32
    """Episodes of a comparison."""
    steps: int = 5
    """Env steps of a comparison."""
    batch: int = 256
    """Environments at once where speed is measured."""
    rounds: int = 3
    """How often speed is measured; the median counts."""


def _moved(
    reset: Callable[..., Any], step: Callable[..., Any], read: Callable[..., Any], actions: Any
) -> np.ndarray:
    """Returns positions and velocities [N, nq + nv] after env steps.

    Args:
      reset: (words of keys [N, 2]) -> states.
      step: (states, actions [N, A]) -> states.
      read: state -> what has ``qpos`` and ``qvel``.
      actions: [T, N, A].
    """
    words = jax.random.key_data(jax.random.split(jax.random.key(0), actions.shape[1]))
    state = reset(words)
    for action in actions:
        state = step(state, action)
    data = read(state)
    return np.concatenate([data.qpos, data.qvel], axis=1).astype(float)


def _error(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.max(np.abs(x - y) / np.maximum(1, np.abs(y))))


def _ends(env: Any, settings: Settings, others: dict[str, Any]) -> dict[str, np.ndarray]:
    """Returns where episodes are by machine code, and by others, each with their name."""
    shape = (settings.steps, settings.episodes, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1)
    words = jax.ShapeDtypeStruct((2,), np.uint32)
    start = jax.eval_shape(lambda: env.reset(jax.random.key(0)))

    def begin(reset: Callable[..., Any]) -> Callable[..., Any]:
        return lambda words: reset(key_of_words(words))

    ours = (
        machine_map(begin(env.reset), words, env=env),
        machine_map(env.step, start, actions[0, 0], env=env),
    )
    mapped = {
        name: (jax.vmap(begin(task.reset)), jax.vmap(task.step)) for name, task in others.items()
    }
    ends = {}
    for name, (reset, step) in {"ours": ours, **mapped}.items():
        place = "data" if name == "mjx" else "pipeline_state"
        read = _reader(place)
        ends[name] = _moved(jax.jit(reset), jax.jit(step), read, actions)
    return ends


def _reader(place: str) -> Callable[[Any], Any]:
    return lambda state: getattr(state, place)


def parity(settings: Settings) -> None:
    """Prints the errors of each task."""
    header = ["task", "ours, MJX", "ours, C", "MJX, C", "to the optimum: ours, MJX"]
    rows = []
    for name in settings.tasks:
        env: Any = envs.from_playground(name)
        ends = _ends(env, settings, {"mjx": env.task, "c": env.in_c_mujoco()})
        pairs = [("ours", "mjx"), ("ours", "c"), ("mjx", "c")]
        errors = [_error(ends[x], ends[y]) for x, y in pairs]
        row = [name, *(f"{error:.0e}" for error in errors), ""]
        if errors[0] > _EQUAL:
            for option, count in _ITERATIONS.items():
                setattr(env.task.mj_model.opt, option, count)
            env.task._mjx_model = mjx.put_model(env.task.mj_model, impl="jax")
            ends = _ends(envs.from_playground(env.task), settings, {"mjx": env.task})
            row[-1] = f"{_error(ends['ours'], ends['mjx']):.0e}"
        rows.append(row)
        print(*rows[-1], file=sys.stderr, flush=True)
    print(markdown.table(header, rows))


def _rate(advance: Callable[[Any], Any], state: Any, count: int) -> float:
    """Returns env steps a second of a compiled function that makes so many."""
    begin = time.perf_counter()
    jax.block_until_ready(advance(state))
    return count / (time.perf_counter() - begin)


def speed(settings: Settings) -> None:
    """Prints env steps a second of each task."""
    rows = []
    for name in settings.tasks:
        env: Any = envs.from_playground(name)
        num_steps = 20
        shape = (num_steps, settings.batch, env.action_size)
        actions = jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1)
        vec = make_vec(env, settings.batch, engine="native", autoreset="disabled")
        keys = jax.random.split(jax.random.key(0), settings.batch)
        sides = {
            "ours": (vec.step, vec.reset(jax.random.key(0))),
            "mjx": (jax.vmap(env.task.step), jax.jit(jax.vmap(env.task.reset))(keys)),
        }
        rates: dict[str, list[float]] = {}
        programs = {side: _program(step, actions) for side, (step, _) in sides.items()}
        for measured in range(-1, settings.rounds):
            for side, (_, state) in sides.items():
                rate = _rate(programs[side], state, num_steps * settings.batch)
                if measured >= 0:  # the first one compiles
                    rates.setdefault(side, []).append(rate)
        ours, theirs = (float(np.median(rates[side])) for side in ("ours", "mjx"))
        rows.append([name, f"{ours:,.0f}", f"{theirs:,.0f}", f"{ours / theirs:.0f}"])
        print(*rows[-1], file=sys.stderr, flush=True)
    print(markdown.table(["task", "ours", "MJX", "ratio"], rows))


def _program(step: Callable[..., Any], actions: jax.Array) -> Callable[[Any], Any]:
    """Returns a compiled function that makes the env steps of all actions [T, N, A]."""

    @jax.jit
    def advance(state: Any) -> Any:
        return jax.lax.scan(lambda x, action: (step(x, action), None), state, actions)[0]

    return advance


def engines(settings: Settings) -> None:
    """Prints what plays each task."""
    rows = []
    for name in settings.tasks:
        env: Any = envs.from_playground(name)
        start = jax.eval_shape(lambda env=env: env.reset(jax.random.key(0)))
        action = jnp.zeros(env.action_size)
        try:
            machine_map(env.step, start, action, env=env)
            native = "yes"
        except Exception as error:  # whatever stops it is what is asked
            native = str(error)
        rows.append([name, env.mj_model.nv, native, supported.why(env.mj_model, ()) or "yes"])
        print(*rows[-1], file=sys.stderr, flush=True)
    print(markdown.table(["task", "degrees of freedom", "machine code", "teams"], rows))


def main(settings: Settings) -> None:
    """Compares, and prints a table."""
    jax.config.update("jax_enable_x64", settings.float64)
    {"parity": parity, "speed": speed, "engines": engines}[settings.what](settings)


if __name__ == "__main__":
    main(tyro.cli(Settings))

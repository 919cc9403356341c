"""Tasks of MuJoCo Playground on this CPU: our physics and speed beside Playground's and C MuJoCo's.

Episodes begin where the task's own ``reset`` has them begin, and the same random actions are
applied. After some env steps the positions and velocities are compared, each error divided by the
number where that is above 1. A file of the suite allows its solver few iterations, so that each
solver ends elsewhere: where ours and MJX's differ, all also begin from one start (ours), and their
solvers also run to the optimum from there. With ``--float64`` rounding is out of the question.

Env steps a second are those of the same programs, without resets, of all in turn.
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
from mjx_reinforce import envs
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
_TO_OPTIMUM = {"iterations": 100, "ls_iterations": 50, "tolerance": 0.0}
#: What an engine knows of a simulation before an env step.
_STATE = ("qpos", "qvel", "qacc_warmstart")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What is compared."""

    tasks: tuple[str, ...] = TASKS
    """Names of Playground's registry."""
    what: Literal["steps", "engines"] = "steps"
    """Errors and env steps a second, or what plays each task."""
    float64: bool = False
    """Whether JAX computes in float64."""
    episodes: int = 256
    """Episodes at once."""
    steps: int = 5
    """Env steps after which episodes are compared."""
    timed_steps: int = 20
    """Env steps of a program that is timed."""
    rounds: int = 3
    """How often speed is measured; the median counts. 0: it is not."""


class Side:
    """Something that plays a task.

    advance: () -> positions and velocities after each env step [T, N, nq + nv], compiled
    """

    def __init__(
        self, reset: Callable[..., Any], step: Callable[..., Any], place: str, settings: Settings
    ):
        """Compiles a program.

        Args:
          reset: (words of keys [N, 2]) -> states.
          step: (states, actions [N, A]) -> states.
          place: the field of a state that has ``qpos`` and ``qvel``.
          settings: how many episodes and steps.
        """
        words = jax.random.key_data(jax.random.split(jax.random.key(0), settings.episodes))
        # A start is made once: XLA need not make it fast, which takes it a minute.
        options = {"xla_backend_optimization_level": 0}
        self.start = jax.jit(reset, compiler_options=options)(words)
        self._place = place

        def play(start: Any, actions: jax.Array) -> jax.Array:
            """Returns what is compared after each env step."""

            def advance(state: Any, action: jax.Array) -> Any:
                state = step(state, action)
                return state, self.compared(state)

            return jax.lax.scan(advance, start, actions)[1]

        self._play = jax.jit(play)

    def compared(self, state: Any) -> jax.Array:
        """Returns positions and velocities [N, nq + nv]."""
        data = getattr(state, self._place)
        return jnp.concatenate([data.qpos, data.qvel], axis=1)

    def advance(self, actions: jax.Array) -> np.ndarray:
        """Returns positions and velocities after each env step, [T, N, nq + nv]."""
        return np.asarray(self._play(self.start, actions), float)

    def begin_as(self, other: "Side") -> None:
        """Begins where another side does."""
        theirs = getattr(other.start, other._place)
        data = getattr(self.start, self._place)
        fields = {name: getattr(theirs, name) for name in _STATE}
        self.start = self.start.replace(**{self._place: data.replace(**fields)})


def _sides(env: Any, settings: Settings, others: dict[str, Any]) -> dict[str, Side]:
    """Returns machine code, and others that play the task, each with their name."""
    start = jax.eval_shape(lambda: env.reset(jax.random.key(0)))

    def begin(task: Any) -> Callable[..., Any]:
        return lambda words: task.reset(key_of_words(words))

    words = jax.ShapeDtypeStruct((2,), np.uint32)
    action = jnp.zeros(env.action_size)
    reset = machine_map(begin(env), words, env=env)
    step = machine_map(env.step, start, action, env=env)
    sides = {"ours": Side(reset, step, "pipeline_state", settings)}
    for name, task in others.items():
        place = "data" if name == "mjx" else "pipeline_state"
        sides[name] = Side(jax.vmap(begin(task)), jax.vmap(task.step), place, settings)
    return sides


def _error(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.max(np.abs(x - y) / np.maximum(1, np.abs(y))))


def _actions(env: Any, settings: Settings) -> jax.Array:
    shape = (settings.timed_steps, settings.episodes, env.action_size)
    return jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1)


def steps(settings: Settings) -> None:
    """Prints the errors of each task, and env steps a second."""
    header = ["task", "ours, MJX", "ours, C", "MJX, C", "at the start: ours, MJX"]
    header += ["one start: ours, MJX", "to the optimum: ours, MJX", "ours, C", "MJX, C"]
    rows = []
    for name in settings.tasks:
        env: Any = envs.from_playground(name)
        sides = _sides(env, settings, {"mjx": env.task, "c": env.in_c_mujoco()})
        actions = _actions(env, settings)
        errors = _errors(sides, actions, settings)
        begin = [np.asarray(sides[side].compared(sides[side].start)) for side in ("ours", "mjx")]
        errors.append(_error(*begin))
        rates = _rates(sides, actions, settings.rounds) if settings.rounds else {}
        if errors[0] > _EQUAL:
            _begin_alike(sides)
            errors.append(_errors(sides, actions, settings)[0])
            for option, limit in _TO_OPTIMUM.items():
                setattr(env.task.mj_model.opt, option, limit)
            env.task._mjx_model = mjx.put_model(env.task.mj_model, impl="jax")
            exact = envs.from_playground(env.task)
            exact_sides = _sides(exact, settings, {"mjx": env.task, "c": exact.in_c_mujoco()})
            _begin_alike(exact_sides)
            errors += _errors(exact_sides, actions, settings)
        cells = [f"{error:.0e}" for error in errors]
        row = [name, *cells, *[""] * (len(header) - 1 - len(cells))]
        row += [f"{rates[side]:,.0f}" for side in rates]
        rows.append([*row, f"{rates['ours'] / rates['mjx']:.1f}"] if rates else row)
        print(*rows[-1], sep="|", file=sys.stderr, flush=True)
    if settings.rounds:
        header += ["ours/s", "MJX/s", "C/s", "ours/MJX"]
    print(markdown.table(header, rows))


def _errors(sides: dict[str, Side], actions: jax.Array, settings: Settings) -> list[float]:
    """Returns the errors after ``settings.steps``: ours beside MJX, ours and MJX beside C."""
    ends = {side: x.advance(actions)[settings.steps - 1] for side, x in sides.items()}
    return [_error(ends[x], ends[y]) for x, y in (("ours", "mjx"), ("ours", "c"), ("mjx", "c"))]


def _begin_alike(sides: dict[str, Side]) -> None:
    """Has all sides begin where ours does."""
    for name in ("mjx", "c"):
        sides[name].begin_as(sides["ours"])


def _rates(sides: dict[str, Side], actions: jax.Array, rounds: int) -> dict[str, float]:
    """Returns env steps a second of programs that are compiled, the medians of all rounds."""
    seconds: dict[str, list[float]] = {side: [] for side in sides}
    for _ in range(rounds):
        for side, program in sides.items():
            begin = time.perf_counter()
            program.advance(actions)
            seconds[side].append(time.perf_counter() - begin)
    count = actions.shape[0] * actions.shape[1]
    return {side: count / float(np.median(times)) for side, times in seconds.items()}


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
    {"steps": steps, "engines": engines}[settings.what](settings)


if __name__ == "__main__":
    main(tyro.cli(Settings))

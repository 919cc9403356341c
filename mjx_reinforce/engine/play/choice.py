"""The choice of an engine: the same episodes, from the same noise, at different speeds.

``vmap`` maps the environment's step with ``jax.vmap``. ``native`` writes out the whole step, policy
included, in scalars (``engine.scalar``), and repeats it in machine code for a CPU or in a kernel
for an NVIDIA GPU (``engine.cpu``, ``engine.gpu``). ``mujoco`` maps the step too, of which C MuJoCo
computes the physics, on the cores of the CPU. Trajectories agree up to rounding.
``choose`` is for episodes, ``map_function`` for a function of one environment over many.
"""

import functools
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine import base
from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, Trajectory
from mjx_reinforce.engine.checks import check_count, check_key, check_name, check_parts
from mjx_reinforce.engine.contract import check_policy
from mjx_reinforce.engine.play import available, c_mujoco, cxx, native, program, rollouts
from mjx_reinforce.engine.play import teams as team

#: This JAX multiplies wrongly on CPUs, in some functions that are mapped over some 16,000 rows and
#: more, and says nothing (JAX's issue 39103). Where we looked, with 33,000 to 65,000 rows, no
#: step, policy or gradient of ours was wrong.
_WRONG_JAX = "0.10.2"

#: What an engine plays with: a rollout, or a function of many environments.
Function = TypeVar("Function")
Rollout: TypeAlias = Callable[..., Trajectory]


class ActingPolicy(NamedTuple):
    """The policy that all episodes share.

    act: (actor, observation [..., O]) -> outputs [..., K] of the distribution
    actor: what ``act`` reads, or its shapes
    distribution: the family whose parameters the outputs are
    """

    act: Callable[[Any, jax.Array], jax.Array]
    actor: Any
    distribution: Acts


class Engine(NamedTuple):
    """A way to play episodes.

    name: "vmap", "native" or "mujoco"
    why: the reason it was chosen, for people
    rollout: as ``mjx_reinforce.engine.play.rollouts.vmap_rollout``
    seconds: wall time that making it took, most of it for machine code
    """

    name: str
    why: str
    rollout: Rollout
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"Engine({self.name})"


ENGINES = ("auto", "vmap", "native", "mujoco")


def choose(
    name: str, env: Environment, policy: ActingPolicy | None = None, horizon: int | None = None
) -> Engine:
    """Returns an engine by name; "auto" is the fastest that supports the environment.

    Args:
      name: one of ``ENGINES``.
      env: what is played.
      policy: who plays it; None where every episode has parameters of its own, which
        machine code cannot hold.
      horizon: T, the time limit in steps, for machine code.

    Raises:
      ValueError: the name is unknown, or the engine does not support the environment, or a variable
        of ours has a value that means nothing.
    """
    start_time = time.perf_counter()
    check_name("engine", name, dict.fromkeys(ENGINES))
    available.check_variables()

    def engine_in_c(task: Environment, reason: str) -> Engine:
        return Engine("mujoco", reason, _rollout_in_c(task), time.perf_counter() - start_time)

    # Without machine code for the whole episode, vmap would play on a CPU.
    has_whole_episodes = policy is not None or available.platform() == "gpu"
    is_for_teams = has_whole_episodes and teams_may_play(name, env)
    in_c = None if is_for_teams else _in_c_mujoco(name, env)
    if in_c is not None:
        return engine_in_c(*in_c)

    def in_machine_code() -> Rollout | str:
        if policy is None or horizon is None:
            return "every episode has a policy of its own"
        # Of a key that machine code cannot draw from "auto" plays by ``vmap``; who asked for
        # "native" gets an error.
        native_rollout = _from_any_key if name == "auto" else native.native_rollout
        return native.unsupported(env, *policy, horizon) or native_rollout

    engine_name, reason, rollout = pick(name, in_machine_code, rollouts.vmap_rollout)
    if engine_name == "vmap" and name == "auto" and policy is not None:
        in_c = instead_of_vmap(env, reason)
        if in_c is not None:
            return engine_in_c(*in_c)
    if engine_name == "vmap":
        _warn_of_wrong_products()
    if engine_name == "native" and available.platform() == "gpu":
        reason += f", {team.played_by(env)}"
    elif engine_name == "native" and program.has_one_lane(env):
        reason += ", made by the C++ compiler"
    return Engine(engine_name, reason, rollout, time.perf_counter() - start_time)


def teams_may_play(name: str, env: Environment) -> bool:
    """Returns whether an engine of this name lets teams of lanes try, also what MJX refuses."""
    is_here = name in ("auto", "native") and (
        available.platform() == "gpu" or program.has_one_lane(env)
    )
    return is_here and not available.unavailable() and team.why_not(env) is None


def _in_c_mujoco(name: str, env: Environment) -> tuple[Environment, str] | None:
    """Returns what C MuJoCo plays and the reason; None if another engine is asked for or faster.

    Args:
      name: one of ``ENGINES``.
      env: what is played.

    Raises:
      ValueError: it is asked for by name, and cannot play this.
    """
    refusal = getattr(c_mujoco.innermost(env), "refusal", None)
    if refusal is not None and name in ("vmap", "native"):
        remedy = "choose auto"
        # The device code may play it, which is compiled here.
        if name == "native" and available.platform() == "cpu" and cxx.compiler() is None:
            remedy += ", or install a C++ compiler if the run was played with one"
        raise ValueError(f"the {name} engine cannot play this: {refusal}; {remedy}")
    reason = c_mujoco.why_best(env)
    if name != "mujoco" and (name != "auto" or reason is None):
        return None
    task = c_mujoco.played_by_c(env)
    if isinstance(task, str):
        if name == "mujoco":
            raise ValueError(f"the engine mujoco cannot play this: {task}; choose auto")
        return None
    if name == "mujoco":
        reason = "chosen by name"
    return task, c_mujoco.in_words(str(reason))


def instead_of_vmap(env: Environment, reason: str) -> tuple[Environment, str] | None:
    """Returns what C MuJoCo plays where machine code cannot hold an env step, and the reason.

    On a CPU, XLA then compiles for minutes, and plays such a model slower than C MuJoCo
    (docs/decisions.md). None where there is no machine code for anything and, on other devices, for
    models that C MuJoCo does not play best.
    """
    is_best = c_mujoco.why_best(env) is not None
    if not is_best and (available.platform() != "cpu" or available.unavailable()):
        return None
    task = c_mujoco.played_by_c(env)
    if isinstance(task, str):
        return None
    return task, c_mujoco.in_words(reason)


def _rollout_in_c(task: Any) -> Rollout:
    """Returns the rollout of an environment that C MuJoCo steps; the one it is given is ignored."""
    # A wrapper may offer the names of what it is around, but its own step is more than that one's.
    env_step = task.step_unfinished if hasattr(type(task), "step_unfinished") else task.step
    mapped_step = jax.vmap(env_step, in_axes=-1, out_axes=-1)

    def play(_: Environment, *arguments: Any, **options: Any) -> Trajectory:
        return rollouts.vmap_rollout(task, *arguments, env_step=mapped_step, **options)

    return play


def pick(
    name: str, native_maker: Callable[[], Function | str], vmap_function: Function
) -> tuple[str, str, Function]:
    """Returns an engine's name, the reason it was chosen, and what it plays with.

    Args:
      name: one of ``ENGINES``.
      native_maker: returns what plays, or why machine code cannot.
      vmap_function: what plays with ``vmap``.

    Raises:
      ValueError: the name is unknown, or the engine cannot play this.
    """
    check_name("engine", name, dict.fromkeys(ENGINES))
    reason = "chosen by name"
    if name != "vmap":
        # It is compiled here, so that what LLVM refuses is a reason for ``vmap``, too.
        function = native_maker()
        if not isinstance(function, str):
            if name == "auto":
                reason = f"machine code for this {jax.default_backend().upper()}"
            return "native", reason, function
        if name == "native":
            raise ValueError(f"the native engine cannot play this: {function}; choose auto")
        reason = f"machine code cannot play this: {function}"
    return "vmap", reason, vmap_function


def _warn_of_wrong_products() -> None:
    """Warns, where ``vmap`` plays, of a JAX that computes some products wrongly."""
    if (jax.default_backend(), jax.__version__) == ("cpu", _WRONG_JAX):
        warnings.warn(
            f"JAX {_WRONG_JAX} computes some products of many rows wrongly on CPUs, and the engine "
            "is vmap, which leaves all to it; with Python 3.12 or newer take a newer JAX "
            "(docs/troubleshooting.md)",
            stacklevel=3,
        )


def _from_any_key(
    env: Environment, act: Act, actor: PyTree, distribution: Acts, key: jax.Array, **options: Any
) -> Trajectory:
    """Plays in machine code, or as ``vmap`` where that cannot draw the noise of the key.

    Arguments and options are those of ``rollouts.vmap_rollout``.
    """
    if reason := native.against_key(key):
        warnings.warn(f"machine code cannot play this: {reason}; vmap plays it", stacklevel=2)
        return rollouts.vmap_rollout(env, act, actor, distribution, key, **options)
    return native.native_rollout(env, act, actor, distribution, key, **options)


class MapEngine(NamedTuple):
    """A way to map a function.

    name: "vmap", "native" or "mujoco"
    why: the reason it was chosen, for people
    call: the function of a batch, whose first axis of every array is N
    """

    name: str
    why: str
    call: Callable[..., Any]

    def __repr__(self) -> str:
        return f"MapEngine({self.name})"


def environment_of(name: str, env: Environment) -> tuple[Environment, str | None]:
    """Returns what an engine maps functions of, and why C MuJoCo computes its physics.

    Args:
      name: one of ``ENGINES``.
      env: the environment.

    Returns:
      The environment with its physics computed by C MuJoCo, and the reason; or itself, and None.

    Raises:
      ValueError: the name is unknown, or the engine cannot play this.
    """
    check_name("engine", name, dict.fromkeys(ENGINES))
    return _in_c_mujoco(name, env) or (env, None)


def map_function(
    name: str, env: Environment, function: Callable[..., Any], *examples: PyTree
) -> MapEngine:
    """Returns a function of one environment mapped over many.

    Args:
      name: one of ``choice.ENGINES``; "auto" is the fastest that supports the function.
      env: the environment.
      function: of its state, and of what else there is; it draws from no typed key that is given.
      *examples: the function's arguments, or their shapes.

    Raises:
      ValueError: the name is unknown, or the engine does not support the function.
    """
    available.check_variables()
    native_maker = functools.partial(machine_code, env, function, *examples)
    engine = MapEngine(*pick(name, native_maker, jax.vmap(function)))
    if engine.name == "vmap":
        _warn_of_wrong_products()
    return engine


def machine_code(
    env: Environment, function: Callable[..., Any], *examples: PyTree
) -> Callable[..., Any] | str:
    """Returns the function of many environments in machine code, or why that is not possible.

    Arguments are those of ``map_function``.
    """
    if reason := available.unavailable():
        return reason
    name = f"{getattr(function, '__name__', 'a function')} of {program.name_of(env)}"
    try:
        return program.machine_map(function, *examples, env=env, name=name)
    except Exception as error:  # whatever it is, another engine may play this
        return program.refusal(error)


#: A policy of more parameters than about 64-64 is computed for all episodes together, by XLA: each
#: lane of machine code would read all parameters in each step.
_MAX_PARAMETERS = 8_000


def rollout(
    env: Environment,
    act: Act,
    actor: PyTree,
    distribution: Acts,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    engine: str = "auto",
    deterministic: bool | jax.Array = False,
    active: bool | jax.Array = True,
) -> Trajectory:
    """Plays N episodes from fresh resets, each to its end or to the horizon.

    An episode's reset and noise come from its own key alone, whatever N is and whichever engine
    plays. Call this under ``jax.jit``: outside of it, what is played is traced again each time.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs [K] of the distribution: any function that JAX can
        trace, of one observation. Of a flax.linen module it is ``module.apply``; of others see
        docs/vector.md.
      actor: what ``act`` reads, a pytree of arrays, such as the parameters of a network.
      distribution: the family whose parameters the outputs are, ours or your own.
      key: consumed; [N] the episodes' own, or [] and that of episode i is this one folded with i.
      num_episodes: N.
      horizon: T, the time limit in steps; reaching it ends an episode.
      engine: "auto"; "native", "vmap" or "mujoco". With "auto" a small policy is played in
        machine code, policy and all; a larger one by XLA, with the env step in machine code. What
        neither plays fast, C MuJoCo plays.
      deterministic: [] or [N] whether an episode takes the mode.
      active: [] or [N] whether an episode is played: else it has no step, and zeros stand for it.

    Returns:
      The episodes. A non-finite observation, reward or ``done`` ends its episode, with reward 0 for
      that step, and shows in ``nonfinite``.

    Raises:
      ValueError: an argument makes no sense, or the engine cannot play this.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> family = mr.categorical(env.action_space)
      >>> policy = mr.mlp_policy(env.observation_size, family)
      >>> episodes = mr.rollout(
      ...     env, policy.apply, policy.init(jax.random.key(0)), family, jax.random.key(1),
      ...     num_episodes=8, horizon=20,
      ... )
      >>> episodes.reward.shape
      (20, 8)
    """
    if hasattr(env, "num_envs"):
        raise ValueError("rollout takes one environment, and this is many: pass its env, vec.env")
    check_parts(env)
    check_key(key)
    check_count("num_episodes", num_episodes)
    check_count("horizon", horizon)
    check_policy(act, actor, distribution, base.shapes(env.reset, jax.random.key(0)).obs)
    policy = ActingPolicy(act, actor, distribution)
    play = _rollout_of(engine, env, policy, horizon)
    # The engine was chosen by the policy of one observation, which machine code computes;
    # ``vmap_rollout`` passes it those of all episodes.
    return play(
        env,
        _of_any_batch(act),
        actor,
        distribution,
        key,
        num_episodes=num_episodes,
        horizon=horizon,
        deterministic=deterministic,
        active=active,
    )


def _rollout_of(engine: str, env: Environment, policy: ActingPolicy, horizon: int) -> Rollout:
    """Returns the rollout of an engine."""
    num_parameters = sum(np.size(x) for x in jax.tree.leaves(policy.actor))
    # Whatever is best in C MuJoCo has no step in machine code, or a slow one.
    has_fast_step = available.platform() == "cpu" and c_mujoco.why_best(env) is None
    if engine == "auto" and num_parameters > _MAX_PARAMETERS and has_fast_step:
        start = base.shapes(env.reset, jax.random.key(0))
        step = machine_code(env, env.step, start, base.null_action(env))
        if not isinstance(step, str):
            return functools.partial(rollouts.vmap_rollout, env_step=_episodes_last(step))
    # The parameters may be tracers here: an engine is chosen by their shapes.
    shapes = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, policy.actor))
    return choose(engine, env, policy._replace(actor=shapes), horizon).rollout


def _of_any_batch(act: Act) -> Act:
    """Returns a policy of one observation [O] as one of [O] or [N, O]."""

    def act_on_any(params: PyTree, observation: jax.Array) -> jax.Array:
        if observation.ndim == 1:
            return act(params, observation)
        return jax.vmap(act, (None, 0))(params, observation)

    return act_on_any


def _episodes_last(step: Callable[[Any, jax.Array], Any]) -> Callable[[Any, jax.Array], Any]:
    """Returns a step of N environments, the first axis of every array, with N as the last axis."""

    def step_last(state: PyTree, action: jax.Array) -> Any:
        state, action = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), (state, action))
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), step(state, action))

    return step_last

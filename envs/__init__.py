"""Gymnasium's MuJoCo tasks on MJX, exactly.

``make(id)`` builds one, ``names()`` lists them, ``register(id, ...)`` adds one.
An environment is a ``brax.envs.base.Env`` whose ``reset`` and ``step`` call MJX
directly. Nothing heavy is imported before ``make``.
"""

import enum
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, overload

from mjx_reinforce.engine import checks
from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.engine.physics import silence_mjx
from mjx_reinforce.registry import load_definition, load_own

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import Environment
    from mjx_reinforce.engine.vector.environment import VectorEnv
    from mjx_reinforce.engine.vector.for_brax import BraxVectorWrapper
    from mjx_reinforce.engine.vector.for_torch import TorchVectorEnv
    from mjx_reinforce.envs.base import MujocoEnv

silence_mjx()  # before any environment imports it

_TASKS = "mjx_reinforce.envs.tasks"
#: What stands before the name of a task of MuJoCo Playground.
_PLAYGROUND = "playground:"
#: id -> ("module:Class" or a callable, constructor arguments). One line a task.
_TABLE: dict[str, tuple[str | Callable[..., Any], dict[str, Any]]] = {
    "InvertedPendulum-v5": (f"{_TASKS}.pendulums:InvertedPendulum", {}),
    "InvertedPendulum-v4": (f"{_TASKS}.pendulums:InvertedPendulum", {"reward_at_fall": 1.0}),
    "InvertedDoublePendulum-v5": (f"{_TASKS}.pendulums:InvertedDoublePendulum", {}),
    "Reacher-v5": (f"{_TASKS}.arms:Reacher", {}),
    "Pusher-v5": (f"{_TASKS}.arms:Pusher", {}),
    "Swimmer-v5": (f"{_TASKS}.planar:Swimmer", {}),
    "HalfCheetah-v5": (f"{_TASKS}.planar:HalfCheetah", {}),
    "Hopper-v5": (f"{_TASKS}.planar:Hopper", {}),
    "Walker2d-v5": (f"{_TASKS}.planar:Walker2d", {}),
    "Ant-v5": (f"{_TASKS}.ant:Ant", {}),
    "Humanoid-v5": (f"{_TASKS}.humanoids:Humanoid", {}),
    "HumanoidStandup-v5": (f"{_TASKS}.humanoids:HumanoidStandup", {}),
    "CartPole-v1": (f"{_TASKS}.cart_pole:CartPole", {}),
    "CartPole-v0": (
        f"{_TASKS}.cart_pole:CartPole",
        {"max_episode_steps": 200, "reward_threshold": 195.0},
    ),
    "ContinuousCartPole-v0": (f"{_TASKS}.cart_pole:ContinuousCartPole", {}),
}


def names() -> list[str]:
    """Returns the ids that ``make`` knows, in order.

    Examples:
      >>> from mjx_reinforce import envs
      >>> "Hopper-v5" in envs.names()
      True
    """
    return sorted(_TABLE)


def make(id: str, /, **kwargs: object) -> "MujocoEnv":
    """Builds an environment: a ``MujocoEnv``, except of the cart-poles and of classes of your own.

    Args:
      id: one of ``names()``, or "module:Class" for one of your own, importable from here, or
        "playground:WalkerRun" for a task of MuJoCo Playground.
      **kwargs: arguments of the environment's class, over the table's.

    Raises:
      ValueError: the id is unknown, with the known ones; it cannot be imported or built; or it
        gives no environment.

    Examples:
      >>> from mjx_reinforce import envs
      >>> envs.make("CartPole-v1", max_episode_steps=50).max_episode_steps
      50
    """
    check_id(id)
    # "module:Class" has no entry in the table: the id says where it is.
    entry, settings = _TABLE.get(id, (id, {}))
    build = _import(id, entry)
    try:
        env = build(**(settings | kwargs))
    except BadEnvironmentError:
        raise
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        # A ValueError of our tasks is a message for the user; from a class of one's own it is not.
        is_message = ":" not in id or id.startswith(_PLAYGROUND)
        if isinstance(error, ValueError) and is_message:
            raise
        raise ValueError(f"cannot build the environment {id!r}: {checks.explain(error)}") from error
    checks.check_parts(env)
    return env


def from_playground(task: Any, /, **overrides: object) -> "MujocoEnv":
    """Builds an environment from a task of MuJoCo Playground, with the physics of an engine here.

    The task's own ``reset`` and ``step`` are traced, and their calls of Playground's physics are
    exchanged meanwhile. ``make`` does the same for the id "playground:WalkerRun".

    Args:
      task: a name of Playground's registry, such as "WalkerRun", or an instance of its ``MjxEnv``,
        also of a class of your own.
      **overrides: entries of the task's configuration, of a name.

    Raises:
      ValueError: Playground is not installed, or has no such task; the task does what no engine
        here can; or overrides are given for an instance.

    Examples:
      >>> from mjx_reinforce import envs
      >>> env = envs.from_playground("CartpoleBalance")  # doctest: +SKIP
      >>> env.observation_size, env.action_size  # doctest: +SKIP
      (5, 1)
    """
    from mjx_reinforce.envs import playground

    if isinstance(task, str):
        return playground.load(task, **overrides)
    checks.require(not overrides, f"{sorted(overrides)} are for a name; this task is made already")
    return playground.PlaygroundEnv(task)


def make_set(id: str, words: Sequence[str] = ()) -> Any:
    """Builds an environment with settings as ``--env-set`` has them, such as "frame_skip=2".

    Args:
      id: as for ``make``.
      words: NAME=VALUE each, see ``settings.read_settings``.

    Raises:
      ValueError: as ``make``; or a name or a value is none of the environment's settings.
    """
    if not words:
        return make(id)
    check_id(id)
    entry, _ = _TABLE.get(id, (id, {}))
    task = _import(id, entry)
    from mjx_reinforce.envs.settings import read_settings

    return make(id, **read_settings(task, words))


@overload
def make_vec(
    env: "str | Environment", num_envs: int, *, framework: Literal["torch"], **options: Any
) -> "TorchVectorEnv": ...


@overload
def make_vec(
    env: "str | Environment", num_envs: int, *, framework: Literal["jax"] = "jax", **options: Any
) -> "VectorEnv": ...


def make_vec(
    env: "str | Environment",
    num_envs: int,
    *,
    framework: str = "jax",
    autoreset: "str | enum.Enum | None" = None,
    max_episode_steps: int | None = None,
    engine: str = "auto",
    **settings: object,
) -> "VectorEnv | TorchVectorEnv":
    """Makes N environments that play at once, for any algorithm: ``mjx_reinforce.make_vec``.

    Args:
      env: an id of ``names()``, "module:Class" of your own, or an environment.
      num_envs: N.
      framework: "jax"; or "torch", which gives the ``VecEnv`` of RSL-RL.
      autoreset: when an environment whose episode has ended begins the next: "next_step" and
        "same_step" are Gymnasium's, whose ``AutoresetMode`` may be given; with "disabled" only
        ``restart`` does. By default "next_step"; for torch "same_step", the only one there.
      max_episode_steps: the time limit in steps; by default the task's.
      engine: "auto", "native" (machine code), "vmap", or "mujoco" (C MuJoCo).
      **settings: of the task, where ``env`` is an id.

    Raises:
      ValueError: an argument makes no sense, the environment is none, or it does not fit in memory;
        or torch is not installed.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> state = vec.step(state, vec.sample_actions(jax.random.key(1)))
      >>> state.obs.shape, state.reward.tolist()[:2]
      ((8, 4), [1.0, 1.0])
    """
    checks.check_name("framework", str(framework), dict.fromkeys(("jax", "torch")))
    options: Any = {"max_episode_steps": max_episode_steps, "engine": engine}
    if framework == "torch":
        from mjx_reinforce.engine.vector.for_torch import TorchVectorEnv  # loads JAX and torch

        options |= settings | {"autoreset": autoreset or "same_step"}
        return TorchVectorEnv(make_vec(env, num_envs, **options))
    from mjx_reinforce.engine.vector import environment  # loads JAX

    if isinstance(env, str):
        env = make(env, **settings)
    elif settings:
        raise ValueError(f"{sorted(settings)} are for an id; this environment is made already")
    options["autoreset"] = "next_step" if autoreset is None else autoreset
    return environment.make_vec(env, num_envs, **options)


def for_brax(
    env: "str | Environment",
    episode_length: int | None = None,
    action_repeat: int = 1,
    randomization_fn: Callable[..., Any] | None = None,
    *,
    autoreset: str = "same_step",
    engine: str = "auto",
) -> "BraxVectorWrapper":
    """Makes an environment for brax's trainers, in place of the wrappers that these have.

    It is the ``wrap_env_fn`` of brax's PPO: ``ppo.train(env, wrap_env_fn=for_brax, ...)``. One
    call steps all environments, and each episode has a start of its own. Actions are from -1 to 1,
    which are the bounds of the environment's.

    Args:
      env: an id of ``names()``, "module:Class" of your own, or an environment.
      episode_length: the time limit in steps; by default the task's.
      action_repeat: 1.
      randomization_fn: None; ``randomize`` of a ``MujocoEnv`` draws its model.
      autoreset: "same_step", as brax's wrappers; or "disabled" for trainers with resets of their
        own, such as rejax.
      engine: as of ``make_vec``.

    Raises:
      ValueError: an argument makes no sense, the environment is none, or its actions are discrete.

    Examples:
      >>> import jax
      >>> from mjx_reinforce import envs
      >>> env = envs.for_brax("InvertedPendulum-v5")
      >>> state = env.reset(jax.random.split(jax.random.key(0), 8))
      >>> env.step(state, jax.numpy.zeros((8, 1))).reward.shape
      (8,)
    """
    if action_repeat != 1:
        raise ValueError(f"action_repeat must be 1, got {action_repeat!r}; set frame_skip instead")
    if randomization_fn is not None:
        raise ValueError("randomization_fn must be None: randomize of a MujocoEnv draws its model")
    from mjx_reinforce.engine.vector.for_brax import BraxVectorWrapper  # loads JAX

    if isinstance(env, str):
        env = make(env)
    return BraxVectorWrapper(env, episode_length, autoreset, engine)


def _import(id: str, entry: str | Callable[..., Any]) -> Callable[..., Any]:
    """Returns the class or function of an entry of the table, or of an id with a colon."""
    if id.startswith(_PLAYGROUND):
        from mjx_reinforce.envs import playground

        return playground.builder(id.removeprefix(_PLAYGROUND))
    if ":" in id:
        return load_own("environment", id, form="module:Class")
    return load_definition(entry)


def check_id(id: str) -> None:
    """Raises ValueError for an id that ``make`` does not know; imports nothing."""
    # Before the form is checked, which would not say what is wrong with own_model.py:Crane.
    if re.search(r"\.py\b", id):
        raise ValueError(
            f"{id!r} is a file: write module:Class, such as own_model:Crane for the class Crane in "
            "own_model.py"
        )
    if ":" not in id:
        try:
            checks.check_name("environment", id, _TABLE)
        except ValueError as error:
            raise ValueError(f"{error} Your own is named module:Class.") from None
    elif not id.startswith(_PLAYGROUND) and not re.fullmatch(r"\w+(\.\w+)*:\w+", id):
        raise ValueError(
            f"the environment {id!r} is not of the form module:Class, such as own_model:Crane for "
            "the class Crane in own_model.py"
        )


def is_ours(id: str) -> bool:
    """Returns whether an environment's code is this package's; imports nothing."""
    return id in _TABLE and isinstance(_TABLE[id][0], str)


def register(id: str, entry: Callable[..., Any], /, **kwargs: object) -> None:
    """Adds an environment to ``make`` and ``names``.

    Args:
      id: a new id.
      entry: a class or function that returns an environment.
      **kwargs: arguments for it, which ``make`` may override.

    Raises:
      ValueError: the id is taken or has other characters than letters, digits, "_", "." and "-",
        or the entry is not a class or function.

    Examples:
      >>> from mjx_reinforce import envs
      >>> from mjx_reinforce.envs.tasks.cart_pole import CartPole
      >>> envs.register("LongCartPole-v0", CartPole, max_episode_steps=5000)
      >>> envs.make("LongCartPole-v0").max_episode_steps
      5000
    """
    if not re.fullmatch(r"[\w.-]+", id):
        raise ValueError(f"an environment's id has letters, digits, _, . and - only, got {id!r}")
    if not callable(entry):
        raise ValueError(f"the entry of {id!r} must be a class or function, got {entry!r}")
    if id in _TABLE:
        raise ValueError(f"environment {id!r} is already registered; choose another id")
    _TABLE[id] = (entry, kwargs)

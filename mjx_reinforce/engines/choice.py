"""The choice of an engine: the same episodes, from the same noise, at different speeds.

``vmap`` maps the environment's step with ``jax.vmap``. ``native`` writes out the whole step, policy
included, in scalars (``mjx_reinforce.fused``), and repeats it in machine code for a CPU or in a
kernel for an NVIDIA GPU (``mjx_reinforce.engines.native``). Trajectories agree up to rounding.
"""

import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax

from mjx_reinforce.engines.episode import Act
from mjx_reinforce.engines.native import rollout as native
from mjx_reinforce.engines.rollouts import rollout
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.registry import check_name
from mjx_reinforce.types import Environment, PyTree, Trajectory

#: This JAX multiplies wrongly on CPUs, in some functions that are mapped over some 16,000 rows and
#: more, and says nothing (JAX's issue 39103). Where we looked, with 33,000 to 65,000 rows, no
#: step, policy or gradient of ours was wrong.
_WRONG_JAX = "0.10.2"


#: What an engine plays with: a rollout, or a function of many environments.
Made = TypeVar("Made")
Rollout: TypeAlias = Callable[..., Trajectory]


class ActingPolicy(NamedTuple):
    """The policy that all episodes share.

    act: (actor, observation [..., O]) -> outputs [..., K] of the distribution
    actor: what ``act`` reads, or its shapes
    distribution: the family whose parameters the outputs are
    """

    act: Callable[[Any, jax.Array], jax.Array]
    actor: Any
    distribution: Distribution


class Engine(NamedTuple):
    """A way to play episodes.

    name: "vmap" or "native"
    why: the reason it was chosen, for people
    rollout: as ``mjx_reinforce.engines.rollouts.rollout``
    seconds: wall time that making it took, most of it for machine code
    """

    name: str
    why: str
    rollout: Rollout
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"Engine({self.name})"


ENGINES = ("auto", "vmap", "native")


def choose(
    name: str, env: Environment, player: ActingPolicy | None = None, horizon: int | None = None
) -> Engine:
    """Returns an engine by name; "auto" is the fastest that supports the environment.

    Args:
      name: one of ``ENGINES``.
      env: what is played.
      player: who plays it; None where every episode has parameters of its own, which
      machine code cannot hold.
      horizon: T, the time limit in steps, for machine code.

    Raises:
      ValueError: the name is unknown, or the engine does not support the environment.
    """
    began = time.perf_counter()
    engine = _choose_engine(name, env, player, horizon)
    return engine._replace(seconds=time.perf_counter() - began)


def _choose_engine(
    name: str, env: Environment, player: ActingPolicy | None, horizon: int | None
) -> Engine:
    def in_machine_code() -> Rollout | str:
        if player is None or horizon is None:
            return "every episode has a policy of its own"
        play = _from_any_key if name == "auto" else native.rollout
        return native.unsupported(env, *player, horizon) or play

    return Engine(*pick(name, in_machine_code, rollout))


def pick(
    name: str, in_machine_code: Callable[[], Made | str], by_vmap: Made
) -> tuple[str, str, Made]:
    """Returns an engine's name, the reason it was chosen, and what it made.

    Args:
      name: one of ``ENGINES``.
      in_machine_code: returns what plays, or why machine code cannot.
      by_vmap: what plays with ``vmap``.

    Raises:
      ValueError: the name is unknown, or the engine cannot play this.
    """
    check_name("engine", name, dict.fromkeys(ENGINES))
    why = "chosen by name"
    if name != "vmap":
        made = in_machine_code()
        if not isinstance(made, str):
            device = "CPU" if jax.default_backend() == "cpu" else "GPU"
            return "native", f"machine code for this {device}" if name == "auto" else why, made
        if name == "native":
            raise ValueError(f"the native engine cannot play this: {made}; choose auto")
        why = f"machine code cannot play this: {made}"
    if (jax.default_backend(), jax.__version__) == ("cpu", _WRONG_JAX):
        warnings.warn(
            f"JAX {_WRONG_JAX} computes some products of many rows wrongly on CPUs, and the engine "
            "is vmap, which leaves all to it; with Python 3.12 or newer take a newer JAX "
            "(docs/troubleshooting.md)",
            stacklevel=2,
        )
    return "vmap", why, by_vmap


def _from_any_key(
    env: Environment,
    act: Act,
    actor: PyTree,
    distribution: Distribution,
    key: jax.Array,
    **options: Any,
) -> Trajectory:
    """Plays in machine code, or as ``vmap`` where that cannot draw the noise of the key."""
    against = native.against_key(key)
    if against:
        warnings.warn(f"machine code cannot play this: {against}; vmap plays it", stacklevel=2)
    play = rollout if against else native.rollout
    return play(env, act, actor, distribution, key, **options)

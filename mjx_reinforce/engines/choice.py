"""The choice of an engine: the same episodes, from the same noise, at different speeds.

``vmap`` maps the environment's step with ``jax.vmap``. ``fused`` writes it out in
scalars and lets XLA fuse what is left (``mjx_reinforce.fused``). ``native`` writes out the whole
step, policy included, and repeats it in machine code for a CPU or in a kernel for an NVIDIA GPU
(``mjx_reinforce.engines.native``). Trajectories agree up to rounding.
"""

import functools
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax

from mjx_reinforce import fused
from mjx_reinforce.engines.episode import Act
from mjx_reinforce.engines.native import rollout as native
from mjx_reinforce.engines.rollouts import rollout
from mjx_reinforce.fused.vmap import MAX_OPERATIONS, Mapped
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.registry import check_name
from mjx_reinforce.types import Environment, PyTree, Trajectory, null_action

#: Each entry of an observation is an array of its own; XLA takes longer and longer for more.
MAX_ENTRIES = 200
#: On a CPU, branches of more operations are skipped where no episode needs them.
_CPU_BRANCH_COST = 32


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

    name: "vmap", "fused" or "native"
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


ENGINES = ("auto", "vmap", "fused", "native")


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

    def in_scalars() -> Rollout | str:
        step = fused.vmap(env.step, in_axes=-1, out_axes=-1, branch_cost=branch_cost())
        return unsupported_by_fused(env, step) or functools.partial(rollout, env_step=step)

    return Engine(*pick(name, env, in_machine_code, in_scalars, rollout))


def pick(
    name: str,
    env: Environment,
    in_machine_code: Callable[[], Made | str],
    in_scalars: Callable[[], Made | str],
    by_vmap: Made,
) -> tuple[str, str, Made]:
    """Returns an engine's name, the reason it was chosen, and what it made.

    Args:
      name: one of ``ENGINES``.
      env: what is played.
      in_machine_code: returns what plays, or why machine code cannot.
      in_scalars: the same of ``fused``.
      by_vmap: what plays with ``vmap``.

    Raises:
      ValueError: the name is unknown, or the engine cannot play this.
    """
    made = _pick(name, env, in_machine_code, in_scalars, by_vmap)
    if (made[0], jax.default_backend(), jax.__version__) == ("vmap", "cpu", _WRONG_JAX):
        warnings.warn(
            f"JAX {_WRONG_JAX} computes some products of many rows wrongly on CPUs, and the engine "
            "is vmap, which leaves all to it; take another JAX (docs/troubleshooting.md)",
            stacklevel=2,
        )
    return made


def _pick(
    name: str,
    env: Environment,
    in_machine_code: Callable[[], Made | str],
    in_scalars: Callable[[], Made | str],
    by_vmap: Made,
) -> tuple[str, str, Made]:
    """Returns what ``pick`` returns."""
    check_name("engine", name, dict.fromkeys(ENGINES))
    why, instead = "chosen by name", ""
    if name == "vmap":
        return name, why, by_vmap
    if name in ("auto", "native"):
        made = in_machine_code()
        if not isinstance(made, str):
            device = "CPU" if jax.default_backend() == "cpu" else "GPU"
            return "native", f"machine code for this {device}" if name == "auto" else why, made
        if name == "native":
            raise ValueError(f"the native engine cannot play this: {made}; choose auto")
        instead = f"; machine code cannot play this: {made}"
    contacts = getattr(env, "num_contacts", 0)
    if name == "auto" and contacts:
        why = f"the fastest of the others for models with contacts, here up to {contacts}"
        return "vmap", why + instead, by_vmap
    made = in_scalars()
    if not isinstance(made, str):
        why = "the env step is small enough to write out" if name == "auto" else why
        return "fused", why + instead, made
    if name == "fused":
        raise ValueError(f"the fused engine does not support this environment: {made}")
    return "vmap", f"fused does not support this environment: {made}{instead}", by_vmap


def branch_cost() -> int:
    """Returns from how many operations on ``fused`` skips a branch here.

    On a GPU a real branch makes the host wait for its predicate; computing both sides is cheap.
    """
    return _CPU_BRANCH_COST if jax.default_backend() == "cpu" else MAX_OPERATIONS


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


def unsupported_by_fused(env: Environment, step: Mapped) -> str | None:
    """Returns why an environment does not run, or not well, on the fused engine; None if it does.

    Nothing is compiled: the step is traced and written out, about a second.

    Args:
      env: the environment.
      step: ``fused.vmap`` of its step, over the last axis.
    """

    def one():
        states = jax.vmap(env.reset, out_axes=-1)(jax.random.split(jax.random.key(0), 1))
        return states, null_action(env)[..., None]

    entries = jax.eval_shape(env.reset, jax.random.key(0)).obs.size
    return against_writing(step, entries, *jax.eval_shape(one))


def against_writing(mapped: Mapped, entries: int, *batch: PyTree) -> str | None:
    """Returns why a mapped function does not run, or not well, on ``fused``; None if it does.

    Args:
      mapped: ``fused.vmap`` of it.
      entries: of an observation.
      *batch: its arguments, or their shapes.
    """
    if entries > MAX_ENTRIES:
        return f"its observation has {entries:,} entries, more than {MAX_ENTRIES:,}"
    try:
        count = sum(mapped.write(*batch).operations.values())
    except Exception as error:  # whatever it is, another engine may play this
        return fused.refusal(error)
    if count > MAX_OPERATIONS:
        return f"one env step takes {count:,} scalar operations, more than {MAX_OPERATIONS:,}"
    return None

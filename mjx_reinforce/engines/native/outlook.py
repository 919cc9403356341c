"""How long machine code takes to make, found before it is written.

It goes with the number of scalar operations, and with the square of the entries of an
observation, all of which LLVM holds at once. On two quiet cores a training had started after 48 s
with Humanoid-v5 (1.9 million operations), 54 s with dm_control's humanoid (2.7 million), and after
19 s and 116 s with observations of 500 and 2,000 entries, of which some 8 s are XLA's.
"""

from typing import TYPE_CHECKING

import jax

from mjx_reinforce.engines.native import available
from mjx_reinforce.fused import TooLarge, jaxprs, size
from mjx_reinforce.types import Environment, null_action

if TYPE_CHECKING:
    from mjx_reinforce.types import MjModel

#: Nobody waits longer for what ``jax.vmap`` compiles in less.
MAX_SECONDS = 80
#: People are told beforehand of what takes longer.
_WORTH_SAYING = 15
_PER_SCALAR, _PER_PAIR_OF_ENTRIES = 2e-5, 2.7e-5


def check_seconds(env: Environment, traced: jaxprs.Program, entries: int) -> None:
    """Raises TooLarge for a step that takes too long to write and compile.

    Args:
      env: whose step it is.
      traced: the step.
      entries: of an observation.
    """
    expected = _seconds(traced, entries)
    if expected > MAX_SECONDS:
        model = getattr(env, "mj_model", None)
        wide = _PER_PAIR_OF_ENTRIES * entries**2 > expected / 2
        cause = f"of an observation of {entries:,} entries" if wide else "of its size"
        remedy = "" if wide or model is None else _fewer_contacts(model)
        raise TooLarge(
            f"writing it out and compiling it would take about {expected:.0f} s, more than "
            f"{MAX_SECONDS} s, because {cause}{'; ' if remedy else ''}{remedy}"
        )


def _fewer_contacts(model: "MjModel") -> str:
    from mjx_reinforce.physics.pairs import advice  # imports MJX, which takes a second

    return advice(model)


def seconds(env: Environment) -> float:
    """Returns about how long writing and compiling an environment's step takes (s)."""
    start = jax.eval_shape(env.reset, jax.random.key(0))
    traced, _ = jaxprs.trace(env.step, start, null_action(env))
    return _seconds(traced, start.obs.shape[0])


def _seconds(traced: jaxprs.Program, entries: int) -> float:
    return _PER_SCALAR * size.num_scalars(traced) + _PER_PAIR_OF_ENTRIES * entries**2


def announcement(env: Environment) -> str | None:
    """Returns what people must know who wait for machine code; None where nobody waits long."""
    if available.unavailable():
        return None
    expected, contacts = seconds(env), getattr(env, "num_contacts", 0)
    if not _WORTH_SAYING < expected <= MAX_SECONDS:
        return None
    cause = f", with up to {contacts} contacts," if contacts else ""
    return (
        f"writing the simulation out{cause} and compiling it takes about {expected:.0f} s, or much "
        "less if this was compiled before"
    )

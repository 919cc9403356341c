"""One step of one episode as a scalar graph: noise, policy, physics, reward, end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree
from mjx_reinforce.engine.play import episode, units
from mjx_reinforce.engine.play.counter import at_counter, split

#: A branch of more scalar operations is skipped where no lane needs it.
BRANCH_COST = 40
#: What machine code is told of an episode that is not played; see ``plays``.
NOT_PLAYED = 0


class Carried(NamedTuple):
    """What an episode carries from step to step.

    state: the leaves of the environment's state, bools as int32
    keys: [2, 2] uint32: the episode's key, and the key of the noise of its present chunk
    """

    state: list[Any]
    keys: Any


class StepResult(NamedTuple):
    """What a step returns.

    record: observation [O], action [A] or [], reward []
    alive: [] int32, 1 where the episode goes on
    broken: [] int32, 1 where it left the finite numbers
    carried: what the next step reads
    """

    record: list[Any]
    alive: Any
    broken: Any
    carried: Carried


def step_function(
    env: Environment, act: Act, distribution: Acts, length: int
) -> Callable[..., StepResult]:
    """Returns (actor, carried, t, deterministic, alive) -> ``StepResult``, for one episode.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs of the distribution.
      distribution: the family whose parameters the outputs are.
      length: steps whose noise is drawn with one key, as ``chunks.play_chunks`` does.
    """
    shapes = jax.eval_shape(env.reset, jax.random.key(0))
    leaves, tree = jax.tree.flatten(shapes)
    words = _words_per_step(distribution)

    def step(actor, carried, t, deterministic, alive):
        state = [
            (x != 0) if leaf.dtype == bool else x
            for x, leaf in zip(carried.state, leaves, strict=True)
        ]
        state, alive = tree.unflatten(state), alive != 0
        at = t % length
        keys = lax.cond(at == 0, lambda keys: split(keys[0]), lambda keys: keys, carried.keys)
        offset = (at * words).astype(jnp.uint32)
        noise = distribution.noise(at_counter(keys[1], offset), ())
        with units.one_at_a_time():
            played = episode.step(
                env.step, act, distribution, actor, state, noise, alive, deterministic != 0
            )
        after = jax.tree.leaves(episode.hold(alive, played.state, state))
        return StepResult(
            record=[played.observation, played.action, played.reward],
            alive=played.alive.astype(jnp.int32),
            broken=played.broken.astype(jnp.int32),
            carried=Carried([stored(x) for x in after], keys),
        )

    return step


def stored(x: jax.Array) -> jax.Array:
    """Returns a leaf of the state as it is kept between steps: bools as int32."""
    return x.astype(jnp.int32) if x.dtype == bool else x


def examples(env: Environment, actor: PyTree) -> tuple[Any, ...]:
    """Returns the shapes of the arguments of a step."""
    shape = jax.ShapeDtypeStruct
    state = jax.eval_shape(
        lambda: [stored(x) for x in jax.tree.leaves(env.reset(jax.random.key(0)))]
    )
    flag = shape((), jnp.int32)
    actor = jax.tree.map(lambda x: shape(x.shape, x.dtype), actor)
    return actor, Carried(state, shape((2, 2), jnp.uint32)), flag, flag, flag


def _words_per_step(distribution: Acts) -> int:
    """Returns how many random words the noise of a step takes."""
    noise = jax.eval_shape(lambda: distribution.noise(jax.random.key(0), ()))
    return int(np.prod(noise.shape, dtype=int))


def plays(
    active: bool | jax.Array, deterministic: bool | jax.Array, limit: int | jax.Array
) -> jax.Array:
    """Returns what machine code is told of episodes, as int32: their steps and their actions.

    It is n > 0 for at most n steps by samples, -n for at most n steps by the distribution's mode,
    and 0 for an episode that is not played, as one with a limit of 0 is.
    """
    steps = jnp.maximum(jnp.asarray(limit, jnp.int32), 0)
    return jnp.where(active, jnp.where(deterministic, -steps, steps), NOT_PLAYED)

"""What an episode is: how it begins, what one step of it does, and when all are over.

Every engine plays these functions, so that an episode means the same everywhere. Arrays hold one
episode or N. N is the last axis of the environment's state, and the first axis of what the policy
reads and returns.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree
from mjx_reinforce.engine.contract import check_shape
from mjx_reinforce.engine.scalar import any_lane

LoopState = TypeVar("LoopState")
#: Noise is drawn for so many steps at once, and only then is it seen whether all episodes are over.
CHUNK_STEPS = 50
#: What machine code is told of an episode that is not played; see ``signed_limits``.
NOT_PLAYED = 0


class Step(NamedTuple):
    """What one step of an episode did.

    observation: [O] or [O, N] what the policy saw; zero where the episode was over
    action: [A] or [N, A] what it drew; zero where the episode was over
    reward: [] or [N] what that earned; zero where the episode was over or broke
    alive: [] or [N] whether the episode goes on
    broken: [] or [N] whether this step left the finite numbers, which ends the episode
    state: the environment's next state, also where the episode was over: see ``hold``
    terms: [] or [N] each, the reward's terms by name; zero where the reward is
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    alive: jax.Array
    broken: jax.Array
    state: Any
    terms: dict[str, jax.Array]


def check_each(num_episodes: int, **arguments: ArrayLike) -> None:
    """Raises ValueError for an argument that is neither one for all [] nor one an episode [N]."""
    for name, value in arguments.items():
        check_shape(name, value, (), (num_episodes,), remedy="; play several seeds by jax.vmap")


def signed_limits(
    active: bool | jax.Array, deterministic: bool | jax.Array, limit: int | jax.Array
) -> jax.Array:
    """Returns what machine code is told of episodes, as int32: their steps and their actions.

    It is n > 0 for at most n steps by samples, -n for at most n steps by the distribution's mode,
    and 0 for an episode that is not played, as one with a limit of 0 is.
    """
    steps = jnp.maximum(jnp.asarray(limit, jnp.int32), 0)
    return jnp.where(active, jnp.where(deterministic, -steps, steps), NOT_PLAYED)


def episode_keys(key: jax.Array, num_episodes: int) -> jax.Array:
    """Returns the keys [N] of N episodes.

    Args:
      key: [N] these keys, or [], and the key of episode i is this one folded with i.
      num_episodes: N.

    Raises:
      ValueError: the keys are of another number.
    """
    # A key's data has an axis more than the key: its first word has the shape of the keys.
    words = jax.random.key_data(key)[..., 0]
    check_each(num_episodes, key=words)
    if words.ndim:
        return key
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num_episodes))


def begin(env: Environment, key: jax.Array) -> tuple[Any, jax.Array]:
    """Returns the start state of an episode, by its own key, and the key of its noise."""
    reset_key, noise_key = jax.random.split(key)
    return env.reset(reset_key), noise_key


def draw_noise(distribution: Acts, length: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the next key of an episode's noise, and its noise [length, E] for a chunk."""
    key, noise_key = jax.random.split(key)
    return key, distribution.noise(noise_key, (length,))


def step(
    env_step: Callable[[Any, jax.Array], Any],
    act: Act,
    distribution: Acts,
    actor: PyTree,
    state: PyTree,
    noise: jax.Array,
    alive: jax.Array,
    deterministic: jax.Array | None = None,
    terms: Sequence[str] = (),
) -> Step:
    """Plays one step.

    Args:
      env_step: (state, action) -> state of the environment.
      act: (actor, observation [O] or [N, O]) -> outputs of the distribution.
      distribution: the family whose parameters the outputs are.
      actor: what ``act`` reads.
      state: the environment's state before the step.
      noise: [E] or [N, E] what the action is drawn from.
      alive: [] or [N] whether the episode is still running.
      deterministic: [] or [N] whether the action is the mode instead; by default it never is.
      terms: the names of the reward's terms that are returned.
    """
    # N is the last axis of the state and the first of what the policy reads: hence ``.T``, which
    # leaves the vector of one episode as it is.
    observation = jnp.where(alive, state.obs, 0.0)
    outputs = act(actor, observation.T)
    action = distribution.sample(outputs, noise)
    if deterministic is not None:
        action = _choose(deterministic, distribution.mode(outputs), action)
    next_state = env_step(state, action.T)
    # An episode that is over is stepped too, by an action that nobody sees: it cannot break.
    is_finite = jnp.all(jnp.isfinite(next_state.obs), axis=0)
    is_finite &= jnp.isfinite(next_state.reward) & jnp.isfinite(next_state.done)
    is_broken = alive & ~is_finite
    is_paid = alive & ~is_broken
    return Step(
        observation=observation,
        action=_choose(alive, action, jnp.zeros_like(action)),
        reward=jnp.where(is_paid, next_state.reward, 0.0),
        alive=is_paid & (next_state.done == 0),
        broken=is_broken,
        state=next_state,
        terms={x: jnp.where(is_paid, next_state.metrics[x], 0.0) for x in terms},
    )


def hold(is_alive: jax.Array, new_state: PyTree, old_state: PyTree) -> Any:
    """Returns ``new_state`` where an episode is running, and ``old_state`` where it is over.

    So a finished episode keeps its last state. Otherwise its state could run off to infinity,
    where MJX's own constraint solver needs all its iterations.
    """
    return jax.tree.map(lambda x, y: jnp.where(is_alive, x, y), new_state, old_state)


def _choose(mask: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Chooses episode by episode between arrays whose first axis, if any, is that of ``mask``."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim)), x, y)


def while_any(
    cond: Callable[[LoopState], jax.Array], body: Callable[[LoopState], LoopState], init: LoopState
) -> LoopState:
    """``lax.while_loop`` that, vmapped, runs as long as any seed needs it.

    The body also runs for a seed that is done: it must leave the result of a
    finished seed as it is.
    """
    return lax.while_loop(lambda carry: any_lane(cond(carry)), body, init)


def largest_divisor(number: int, limit: int) -> int:
    """Returns the largest divisor of ``number`` that is no greater than ``limit``."""
    return max(d for d in range(1, min(number, limit) + 1) if number % d == 0)


def chunk_length(horizon: int) -> int:
    """Returns how many steps a chunk of an episode of at most ``horizon`` steps has."""
    return largest_divisor(horizon, CHUNK_STEPS)


def play_chunks(
    play: Callable[[jax.Array, Any], tuple[Any, Any]],
    distribution: Acts,
    keys: jax.Array,
    progress: PyTree,
    records: PyTree,
) -> tuple[Any, Any, jax.Array]:
    """Plays chunk after chunk until every episode is over or the time is up.

    Args:
      play: (noise, progress) -> (progress, records of one chunk); the noise is [length, N, E].
      distribution: whose noise is drawn.
      keys: [N] of every episode's noise; consumed.
      progress: where the episodes are; ``progress.alive`` [N] is 0 or False where one is over.
      records: arrays [horizon, ...] of zeros, which the chunks fill.

    Returns:
      The progress at the end, the records, and how many env steps [] were simulated. That counts
      all lanes until the last episode is over, of all seeds that are vmapped together.
    """
    horizon = jax.tree.leaves(records)[0].shape[0]
    length = chunk_length(horizon)
    draw = jax.vmap(functools.partial(draw_noise, distribution, length), out_axes=(0, 1))

    def advance(carry):
        """Plays one chunk, and writes its records where they belong."""
        chunk, keys, progress, records = carry
        # Noise for all lanes and the whole chunk, also of episodes that end in it: an episode's
        # keys depend on nothing but how many chunks were played.
        keys, noise = draw(keys)
        progress, steps = play(noise, progress)
        records = jax.tree.map(
            lambda y, x: lax.dynamic_update_slice_in_dim(y, x, chunk * length, 0), records, steps
        )
        return chunk + 1, keys, progress, records

    def unfinished(carry):
        chunk, _, progress, _ = carry
        return (chunk < horizon // length) & jnp.any(progress.alive != 0)

    # The length divides the horizon, so that no chunk is written over the end of the records.
    init = (jnp.zeros((), jnp.int32), keys, progress, records)
    chunks, _, progress, records = while_any(unfinished, advance, init)
    return progress, records, chunks * length * progress.alive.size

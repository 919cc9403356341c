"""What an episode is: how it begins, what one step of it does, and when it is over.

Every engine plays these functions, so that an episode means the same everywhere. Arrays hold one
episode or N. N is the last axis of the environment's state, and the first axis of what the policy
reads and returns.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.types import Environment, PyTree

Act = Callable[[Any, jax.Array], jax.Array]


class Step(NamedTuple):
    """What one step of an episode did.

    observation: [O] or [O, N] what the policy saw; zero where the episode was over
    action: [A] or [N, A] what it drew; zero where the episode was over
    reward: [] or [N] what that earned; zero where the episode was over or broke
    alive: [] or [N] whether the episode goes on
    broken: [] or [N] whether this step left the finite numbers, which ends the episode
    state: the environment's next state, also where the episode was over: see ``hold``
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    alive: jax.Array
    broken: jax.Array
    state: Any


def check_shapes(*shapes: tuple[int, ...], **arguments: ArrayLike) -> None:
    """Raises ValueError for an argument of a rollout whose shape is none of ``shapes``."""
    for name, value in arguments.items():
        if jnp.shape(value) not in shapes:
            raise ValueError(
                f"{name} must be {' or '.join(str(list(x)) for x in shapes)}, got the shape "
                f"{list(jnp.shape(value))}; play several seeds by jax.vmap"
            )


def episode_keys(key: jax.Array, num_episodes: int) -> jax.Array:
    """Returns the keys [N] of N episodes.

    Args:
      key: [N] these keys, or [], and the key of episode i is this one folded with i.
      num_episodes: N.

    Raises:
      ValueError: the keys are of another number.
    """
    several = jax.random.key_data(key)[..., 0]
    check_shapes((), (num_episodes,), key=several)
    if several.ndim:
        return key
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num_episodes))


def begin(env: Environment, key: jax.Array) -> tuple[Any, jax.Array]:
    """Returns the start state of an episode, by its own key, and the key of its noise."""
    reset_key, noise_key = jax.random.split(key)
    return env.reset(reset_key), noise_key


def draw_noise(
    distribution: Distribution, length: int, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the next key of an episode's noise, and its noise [length, E] for a chunk."""
    key, noise_key = jax.random.split(key)
    return key, distribution.noise(noise_key, (length,))


def step(
    env_step: Callable[[Any, jax.Array], Any],
    act: Act,
    distribution: Distribution,
    actor: PyTree,
    state: PyTree,
    noise: jax.Array,
    alive: jax.Array,
    deterministic: jax.Array | None = None,
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
    """
    observation = jnp.where(alive, state.obs, 0.0)
    outputs = act(actor, observation.T)
    action = distribution.sample(outputs, noise)
    if deterministic is not None:
        action = _choose(deterministic, distribution.mode(outputs), action)
    after = env_step(state, action.T)
    finite = jnp.all(jnp.isfinite(after.obs), axis=0)
    finite &= jnp.isfinite(after.reward) & jnp.isfinite(after.done)
    broken = alive & ~finite
    return Step(
        observation=observation,
        action=_choose(alive, action, jnp.zeros_like(action)),
        reward=jnp.where(alive & ~broken, after.reward, 0.0),
        alive=alive & ~broken & (after.done == 0),
        broken=broken,
        state=after,
    )


def hold(alive: jax.Array, after: PyTree, before: PyTree) -> Any:
    """Returns ``after`` where an episode is running, and ``before`` where it is over.

    So a finished episode keeps its last state. Otherwise its state could run off to infinity,
    where MJX's own constraint solver needs all its iterations.
    """
    return jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, before)


def _choose(mask: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Chooses episode by episode between arrays whose first axis, if any, is that of ``mask``."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim)), x, y)

"""How much an update plays: as many episodes as the gradient's noise asks for, whole or cut.

Noise and signal of a gradient are alike at the simple noise scale B = tr Cov(g) / |E g|^2, with g
of one episode (McCandlish et al. 2018, arXiv:1812.06162, equation 2.9). Far fewer episodes than B
give steps that are mostly noise, and far more cost time that further steps would use better.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from mjx_reinforce.policies.arguments import check_count, check_number

#: The share of an update in the running means. They are over about the last 2 / _SHARE - 1 = 19
#: updates: where B episodes are played, B of one update is known to 0.5 to 0.8 of itself, of 19 to
#: 0.1 to 0.2 (docs/statistics.md), and it takes some ten updates or more to double.
_SHARE = 0.1
#: The number of episodes changes by this factor an update at most.
_FACTOR = 2
#: The arrays of an update have room for the most episodes, or that divided by this number once or
#: more often: whichever is the least that is enough.
_ROOM_SHARE = 4


class AutoEpisodes(NamedTuple):
    """The number of episodes of an update follows the gradient's noise.

    Attributes:
      least: how many an update plays at least, 2 or more
      most: and at most
      ratio: how many it plays for each episode of the noise scale B: at 1, noise equals signal

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=mr.AutoEpisodes(least=8, most=64), horizon=20)
      >>> learner.room
      64
    """

    least: int = 16
    most: int = 2048
    ratio: float = 1.0

    def rooms(self) -> list[int]:
        """Returns the numbers of episodes that the arrays of an update may have room for."""
        rooms = [self.most]
        while rooms[0] >= _ROOM_SHARE * self.least:
            rooms.insert(0, -(-rooms[0] // _ROOM_SHARE))
        return rooms


class Cut(NamedTuple):
    """Episodes of training end after some steps, until a share of the budget is used.

    On a GPU an update of cut episodes is done sooner. A policy that was trained on cut episodes
    alone may fail later in an episode, where it never was.

    Attributes:
      steps: after which an episode ends
      until: the share of the budget, in [0, 1], from which on episodes are whole

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, horizon=100, cut=mr.Cut(steps=20, until=0.5))
      >>> state, metrics = learner.step(learner.init(jax.random.key(0)))
      >>> int(metrics["episode_length"]) <= 20
      True
    """

    steps: int
    until: float

    def limit(self, progress: jax.Array, horizon: int) -> jax.Array:
        """Returns the most steps [] of an episode where this share [] of the budget is used."""
        return jnp.where(progress < self.until, min(self.steps, horizon), horizon)


def check_cut(cut: Cut) -> None:
    """Raises ValueError for numbers that make no sense."""
    check_count("cut.steps", cut.steps)
    check_number("cut.until", cut.until)
    if cut.until > 1:
        raise ValueError(f"cut.until must be a share of the budget in [0, 1], got {cut.until}")


class Noise(NamedTuple):
    """What the gradients of groups of episodes say of the noise, unbiased both.

    signal: [] |E g|^2, of the mean gradient; an estimate, which may be negative
    noise: [] tr Cov(g), of the gradient of one episode
    """

    signal: jax.Array
    noise: jax.Array


class Pace(struct.PyTreeNode, kw_only=True):
    """How many episodes the next update plays, and what that follows from.

    num_episodes: [] int32
    signal: [] running mean of ``Noise.signal``, as of zeros before the first update
    noise: [] running mean of ``Noise.noise``, with the same bias as ``signal``, which cancels
    """

    num_episodes: jax.Array
    signal: jax.Array
    noise: jax.Array


def check_auto(auto: AutoEpisodes, update: object) -> None:
    """Raises ValueError for bounds that make no sense, or an update that measures no noise."""
    check_count("AutoEpisodes.least", auto.least, 2)
    check_count("AutoEpisodes.most", auto.most, auto.least)
    check_number("AutoEpisodes.ratio", auto.ratio, positive=True)
    if not getattr(update, "measures_noise", False):
        raise ValueError(
            "AutoEpisodes needs the update full_batch(), for others do not measure the gradient's "
            "noise; choose that, or a number of episodes"
        )


def first_pace(auto: AutoEpisodes) -> Pace:
    """Returns the pace of the first update, which plays the fewest episodes."""
    zero = jnp.zeros(())
    return Pace(num_episodes=jnp.int32(auto.least), signal=zero, noise=zero)


def next_pace(pace: Pace, auto: AutoEpisodes, measured: Noise) -> Pace:
    """Returns the pace of the next update.

    Where the mean signal is not positive, noise hides it: the number of episodes grows. An update
    in which something was not finite says nothing.
    """
    sound = jnp.isfinite(measured.signal) & jnp.isfinite(measured.noise)

    def mean(old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(sound, old + _SHARE * (new - old), old)

    signal, noise = mean(pace.signal, measured.signal), mean(pace.noise, measured.noise)
    enough = signal * auto.most > auto.ratio * noise
    wanted = jnp.where(enough, auto.ratio * noise / jnp.where(enough, signal, 1.0), auto.most)
    wanted = jnp.clip(jnp.round(wanted), auto.least, auto.most).astype(jnp.int32)
    before = pace.num_episodes
    wanted = jnp.clip(wanted, -(-before // _FACTOR), _FACTOR * before)
    number = jnp.clip(wanted, auto.least, auto.most)
    return Pace(num_episodes=jnp.where(sound, number, before), signal=signal, noise=noise)

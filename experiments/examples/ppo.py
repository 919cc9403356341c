r"""PPO on the engine's pieces: the whole training is one compiled program.

    python experiments/examples/ppo.py              # HalfCheetah, about two minutes
    python experiments/examples/ppo.py --env Hopper-v5 --discount 0.99 --trace 0.95 \
        --learning-rate 3e-4 --env-steps 5000000 --seeds 3

An example of the engine alone: it takes the environments, ``unroll`` and ``rollout``, and nothing
of REINFORCE, which is what this project is about. The algorithm is
that of Schulman et al. 2017 (arXiv 1707.06347): a clipped surrogate loss over several epochs, with
advantages by GAE (arXiv 1506.02438). Observations are normalized by their running mean and
deviation, and rewards by the deviation of the running discounted return, as in Andrychowicz et al.
2021 (arXiv 2006.05990).
"""

import dataclasses
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import tyro
from flax import linen as nn
from jax import lax

from mjx_reinforce import envs
from mjx_reinforce.engine import Segment, VectorEnv, make_vec, rollout, unroll


@dataclasses.dataclass(frozen=True)
class Settings:
    """Trains policies by PPO, one seed after the other, and says what they earn."""

    env: str = "HalfCheetah-v5"
    """The task."""
    seeds: int = 1
    """How many seeds are trained."""
    env_steps: int = 10_000_000
    """Training budget of each seed."""
    num_envs: int = 128
    """Environments that play at once."""
    num_steps: int = 64
    """Steps of each environment between two updates."""
    epochs: int = 5
    """Passes over what was played."""
    minibatches: int = 16
    """Gradient steps of a pass."""
    learning_rate: float = 6e-4
    """Adam's step size at the start; it falls to zero over the training."""
    discount: float = 0.98
    """What a reward one step later counts."""
    trace: float = 0.92
    """GAE's lambda."""
    clip: float = 0.2
    """How far the probability of an action may move in an update before it counts no more."""
    reports: int = 20
    """How often the policy is evaluated."""


class Gaussian(NamedTuple):
    """A Normal in each of A entries of the action; outputs [..., 2A] are means and log deviations.

    size: A
    """

    size: int

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Returns what ``sample`` reads [*shape, A]."""
        return jax.random.normal(key, (*shape, self.size))

    def sample(self, outputs: jax.Array, noise: jax.Array) -> jax.Array:
        """Returns actions [..., A]."""
        return self.mode(outputs) + noise * jnp.exp(outputs[..., self.size :])

    def mode(self, outputs: jax.Array) -> jax.Array:
        """Returns the means [..., A]."""
        return outputs[..., : self.size]

    def log_prob(self, outputs: jax.Array, action: jax.Array) -> jax.Array:
        """Returns the logarithm [...] of the density of actions."""
        std = jnp.exp(outputs[..., self.size :])
        return jax.scipy.stats.norm.logpdf(action, self.mode(outputs), std).sum(-1)


class Networks(nn.Module):
    """A policy's mean, its standard deviation, and a value: two towers of 64-64."""

    action_size: int

    @nn.compact
    def __call__(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the distribution's outputs [2A] and the value [] of an observation [O]."""

        def tower(size: int, scale: float) -> jax.Array:
            h = x
            for width in (64, 64):
                h = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(h))
            return nn.Dense(size, kernel_init=nn.initializers.orthogonal(scale))(h)

        log_std = self.param("log_std", nn.initializers.constant(-0.5), (self.action_size,))
        return jnp.append(tower(self.action_size, 0.01), log_std), tower(1, 1.0)[0]


class Moments(NamedTuple):
    """Mean and variance of what was seen so far."""

    weight: jax.Array
    mean: jax.Array
    variance: jax.Array

    def update(self, x: jax.Array) -> "Moments":
        """Returns the moments with further rows (Chan et al. 1979)."""
        rows = x.reshape(-1, *self.mean.shape)
        total, delta = self.weight + len(rows), rows.mean(0) - self.mean
        mean = self.mean + delta * len(rows) / total
        spread = self.variance * self.weight + rows.var(0) * len(rows)
        return Moments(total, mean, (spread + delta**2 * self.weight * len(rows) / total) / total)

    def normalize(self, x: jax.Array) -> jax.Array:
        """Returns numbers with mean 0 and deviation 1, clipped to 10."""
        return jnp.clip((x - self.mean) / jnp.sqrt(self.variance + 1e-8), -10, 10)


class Training(NamedTuple):
    """What an update changes."""

    params: Any
    optimizer: Any
    seen: Moments
    returns: Moments
    running: jax.Array
    states: Any
    key: jax.Array


def start(settings: Settings, vec: VectorEnv, networks: Networks, optimizer: Any, key: jax.Array):
    """Returns a training before its first update."""
    init_key, reset_key, key = jax.random.split(key, 3)
    size = vec.observation_size
    params = networks.init(init_key, jnp.zeros(size))
    one = jnp.full((), 1e-4)
    seen = Moments(one, jnp.zeros(size), jnp.ones(size))
    returns = Moments(one, jnp.zeros(()), jnp.ones(()))
    states = vec.reset(reset_key)
    zeros = jnp.zeros(settings.num_envs)
    return Training(params, optimizer.init(params), seen, returns, zeros, states, key)


def advantages(settings: Settings, value: Any, seen: Moments, played: Segment, reward: jax.Array):
    """Returns the advantages and the values' targets [T, N], by GAE."""
    now = value(seen.normalize(played.observation))
    then = value(seen.normalize(played.next_observation))
    error = reward + settings.discount * jnp.where(played.terminated, 0, then) - now

    def back(trace, row):
        error, done = row
        trace = error + settings.discount * settings.trace * jnp.where(done, 0, trace)
        return trace, trace

    found = lax.scan(back, jnp.zeros_like(error[0]), (error, played.done), reverse=True)[1]
    return found, found + now


def update(settings: Settings, vec: VectorEnv, networks: Networks, optimizer: Any, t: Training):
    """Returns a training after one more update: play, then learn from it."""
    play_key, shuffle_key, key = jax.random.split(t.key, 3)
    family = Gaussian(vec.action_size)

    def act(params, observation):
        return networks.apply(params, t.seen.normalize(observation))[0]

    states, played = unroll(vec, act, t.params, family, t.states, play_key, settings.num_steps)

    def discounted(running, row):
        reward, done = row
        running = running * settings.discount + reward
        return jnp.where(done, 0, running), running

    running, sums = lax.scan(discounted, t.running, (played.reward, played.done))
    returns = t.returns.update(sums)
    reward = played.reward / jnp.sqrt(returns.variance + 1e-8)

    value = jax.vmap(jax.vmap(lambda x: networks.apply(t.params, x)[1]))
    advantage, target = advantages(settings, value, t.seen, played, reward)
    data = t.seen.normalize(played.observation), played.action, played.log_prob, advantage, target
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)

    def loss(params, batch):
        x, action, log_prob, advantage, target = batch
        outputs, value = jax.vmap(networks.apply, (None, 0))(params, x)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        ratio = jnp.exp(family.log_prob(outputs, action) - log_prob)
        clipped = jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip)
        gain = jnp.minimum(ratio * advantage, clipped * advantage).mean()
        return 0.5 * jnp.mean((value - target) ** 2) - gain

    def learn(carry, batch):
        params, state = carry
        change, state = optimizer.update(jax.grad(loss)(params, batch), state, params)
        return (optax.apply_updates(params, change), state), None

    def epoch(carry, key):
        order = jax.random.permutation(key, len(rows[0]))
        shape = (settings.minibatches, -1)
        batches = jax.tree.map(lambda x: x[order].reshape(*shape, *x.shape[1:]), rows)
        return lax.scan(learn, carry, batches)

    keys = jax.random.split(shuffle_key, settings.epochs)
    (params, state), _ = lax.scan(epoch, (t.params, t.optimizer), keys)
    return Training(params, state, t.seen.update(played.observation), returns, running, states, key)


def evaluate(vec: VectorEnv, networks: Networks, t: Training, family: Gaussian, key: jax.Array):
    """Returns the returns [16] of episodes without noise."""

    def act(params, observation):
        params, seen = params
        return networks.apply(params, seen.normalize(observation))[0]

    sizes = {"num_episodes": 16, "horizon": vec.max_episode_steps, "deterministic": True}
    return rollout(vec.env, act, (t.params, t.seen), family, key, **sizes).reward.sum(0)


def main(settings: Settings) -> None:
    """Trains, and prints a line an evaluation."""
    vec = make_vec(envs.make(settings.env), settings.num_envs, autoreset="same_step")
    networks = Networks(vec.action_size)
    updates = -(-settings.env_steps // (settings.num_envs * settings.num_steps))
    block = -(-updates // settings.reports)
    steps = block * settings.reports * settings.epochs * settings.minibatches
    schedule = optax.linear_schedule(settings.learning_rate, 0, steps)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))
    family = Gaussian(vec.action_size)

    @jax.jit
    def train(t: Training):
        step = lambda _, t: update(settings, vec, networks, optimizer, t)  # noqa: E731
        t = lax.fori_loop(0, block, step, t)
        return t, evaluate(vec, networks, t, family, jax.random.key(1))

    for seed in range(settings.seeds):
        begin = jax.jit(lambda key: start(settings, vec, networks, optimizer, key))
        t, seconds = begin(jax.random.key(seed)), 0.0
        train.lower(t).compile()
        for report in range(1, settings.reports + 1):
            began = time.perf_counter()
            t, returns = jax.block_until_ready(train(t))
            seconds += time.perf_counter() - began
            played = report * block * settings.num_envs * settings.num_steps
            earned = float(returns.mean())
            print(f"seed {seed}  {played:>11,} steps  {seconds:6.1f} s  return {earned:8.1f}")


if __name__ == "__main__":
    main(tyro.cli(Settings))

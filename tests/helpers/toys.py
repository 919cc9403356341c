"""Environments small enough to know everything about, and a categorical distribution."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax

from mjx_reinforce import Box, Discrete, Distribution, Policy


@struct.dataclass
class ToyState:
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    info: Any = None


class Toy:
    """One step, one observation, one action; subclasses say what it earns."""

    max_episode_steps = 1
    action_size = 1
    action_space = Box(np.array([-1.0]), np.array([1.0]))
    reward_threshold = None

    def observe(self, key):
        del key
        return jnp.zeros(1)

    def earn(self, obs, action):
        del obs, action
        return jnp.ones(())

    def reset(self, rng):
        return ToyState(self.observe(rng), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return state.replace(reward=self.earn(state.obs, action), done=jnp.ones(()))


class Signed(Toy):
    """The observation is -1 or 1, and so is the reward."""

    def observe(self, key):
        return jax.random.rademacher(key, (1,)).astype(jnp.float32)

    def earn(self, obs, action):
        return obs[0]


class Target(Toy):
    """The best action is 0.5."""

    def earn(self, obs, action):
        return -((action[0] - 0.5) ** 2)


class SignedTarget(Signed):
    """The best action is half the observation."""

    def earn(self, obs, action):
        return -((action[0] - 0.5 * obs[0]) ** 2)


class Survive(Toy):
    """Up to 20 steps, ended by an action beyond the threshold; one reward a step."""

    max_episode_steps = 20
    reward_threshold = 15.0

    def step(self, state, action):
        fell = jnp.abs(action[0]) > 0.5
        return state.replace(reward=jnp.ones(()), done=fell.astype(jnp.float32))


class Drift(Survive):
    """Up to 20 steps; starts, returns and lengths vary, and one action in a hundred breaks it."""

    def observe(self, key):
        return jax.random.uniform(key, (1,), minval=-1.0)

    def step(self, state, action):
        obs = state.obs + 0.3 * action
        reward = 1.0 - obs[0] ** 2
        broken = (action[0] > 1.1) & (action[0] < 1.15)
        done = (jnp.abs(obs[0]) > 1.2).astype(jnp.float32)
        return state.replace(obs=jnp.where(broken, jnp.nan, obs), reward=reward, done=done)


class Tempting(Toy):
    """Three steps that cost 1 to 2 each, the least at -0.5; an action beyond 0.5 breaks it."""

    max_episode_steps = 3

    def step(self, state, action):
        obs = jnp.where(action > 0.5, jnp.nan, state.obs)
        return state.replace(obs=obs, reward=-1.0 - jnp.minimum((action[0] + 0.5) ** 2, 1.0))


class Chain:
    """Two arms, up to three pulls; arm 0 may end the episode. Rewards depend on pull and arm."""

    max_episode_steps = 3
    action_size = 2
    action_space = Discrete(2)
    rewards = np.array([[1.0, -0.5], [2.0, 0.7], [-1.0, 3.0]])

    def reset(self, rng):
        del rng
        return ToyState(jnp.eye(3)[0], jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        t = jnp.argmax(state.obs)
        reward = jnp.asarray(self.rewards, state.obs.dtype)[t, action]
        done = (t == 2) | ((t == 1) & (action == 0))
        obs = jnp.roll(state.obs, 1)
        return state.replace(obs=obs, reward=reward, done=done.astype(state.obs.dtype))


def categorical(num_actions):
    """A softmax over arms; the noise is Gumbel."""

    def log_prob(outputs, action):
        chosen = jnp.take_along_axis(jax.nn.log_softmax(outputs), action[..., None], axis=-1)
        return chosen[..., 0]

    def entropy(outputs):
        log_probs = jax.nn.log_softmax(outputs)
        return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)

    return Distribution(
        num_outputs=num_actions,
        constants=(),
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, num_actions)),
        sample=lambda outputs, noise: jnp.argmax(outputs + noise, axis=-1),
        mode=lambda outputs: jnp.argmax(outputs, axis=-1),
        log_prob=log_prob,
        entropy=entropy,
    )


def tabular_policy():
    """One row of logits for each pull of Chain."""

    def init(key):
        del key
        return jnp.array([[0.2, -0.1], [0.5, 0.3], [-0.4, 0.1]])

    return Policy(init, lambda params, observation: observation @ params, categorical(2))


class Drifting(Survive):
    """Ends by chance and by what it does; its state has a counter, a flag and a limit besides."""

    max_episode_steps = 120

    def __init__(self, space=None, length=40.0):
        self.length = length
        if space is not None:
            self.action_space = space
            discrete = isinstance(space, Discrete)
            self.action_size = space.num_actions if discrete else len(space.low)

    def reset(self, rng):
        *obs, part = jax.random.uniform(rng, (3,))
        info = (jnp.int32(0), jnp.bool_(False), self.length * (0.1 + 2 * part))
        return ToyState(2 * jnp.stack(obs) - 1, jnp.zeros(()), jnp.zeros(()), info)

    def step(self, state, action):
        count, flag, limit = state.info
        moved = 0.9 * state.obs + 0.1 * jnp.sum(action)
        done = (count + moved[1] >= limit) & ~flag
        info = (count + 1, count % 7 == 3, limit)
        earned = jnp.mean(jnp.asarray(action, moved.dtype))
        return state.replace(obs=moved, reward=earned, done=done.astype(moved.dtype), info=info)


class Busy(Drifting):
    """Its step has loops that keep and read arrays, one that ends by its lane, and a branch."""

    def step(self, state, action):
        after = super().step(state, action)
        x, y = after.obs
        kept = lax.scan(lambda c, w: (jnp.sin(c + w), c * w), x, jnp.linspace(0.1, 1, 9))[1]
        total = lax.scan(lambda c, row: (0.9 * c + row, None), y, kept[::-1])[0]
        grown = lax.while_loop(lambda z: z < 1.5, lambda z: z + 0.1 + y**2, jnp.abs(total))
        often = lambda: lax.fori_loop(0, 9, lambda _, z: jnp.cos(z) + jnp.sin(z * x), y)  # noqa: E731
        extra = lax.cond(x > 0.2, often, lambda: 0.0)
        return after.replace(reward=after.reward + total + grown + extra)


class Bytes(Drifting):
    """Its state has a number of 8 bits, which overflows."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(info=(*state.info, jnp.int8(1)))

    def step(self, state, action):
        *info, number = state.info
        after = super().step(state.replace(info=tuple(info)), action)
        number = number + jnp.int8(50)
        reward = after.reward + number.astype(after.reward.dtype)
        return after.replace(info=(*after.info, number), reward=reward)


@struct.dataclass
class PaidState(ToyState):
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)


class Paid(Drifting):
    """Pays for two things, tells a third, and breaks far out."""

    names = ("reward_speed", "reward_effort", "height")
    breaks_at = 0.3

    def reset(self, rng):
        state = super().reset(rng)
        metrics = dict.fromkeys(self.names, jnp.zeros(()))
        return PaidState(state.obs, state.reward, state.done, state.info, metrics)

    def step(self, state, action):
        after = super().step(state, action)
        broken = jnp.where(after.obs[0] > self.breaks_at, jnp.nan, 0.0)
        values = after.obs[0] + broken, -0.1 * jnp.sum((action - 0.5) ** 2), after.obs[1]
        metrics = dict(zip(self.names, values, strict=False))
        return after.replace(reward=values[0] + values[1], metrics=metrics)

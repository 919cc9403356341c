# %% [markdown]
# # PPO on the engine
#
# The simulator is not tied to REINFORCE. `make_vec` gives many environments, `unroll` plays a segment of each in one
# call of machine code, and the rest is yours. This is PPO (Schulman et al. 2017) with its whole training in one
# compiled program. `experiments/examples/ppo.py` in the repository is a larger program, with normalized observations
# and rewards.

# %%
import time
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from flax import linen as nn

import mjx_reinforce as mr

ENVS, STEPS, UPDATES, EPOCHS, MINIBATCHES = 64, 64, 60, 4, 4
DISCOUNT, TRACE, CLIP = 0.99, 0.95, 0.2

vec = mr.make_vec("InvertedPendulum-v5", ENVS, autoreset="same_step")
family = mr.normal(vec.action_space)


class Networks(nn.Module):
    """The mean of the actions, the logarithm of their deviation, and the value."""

    @nn.compact
    def __call__(self, x):
        """Returns the outputs [2A] of the distribution and the value [] of an observation [O]."""

        def tower(size, scale):
            h = nn.tanh(nn.Dense(32)(nn.tanh(nn.Dense(32)(x))))
            return nn.Dense(size, kernel_init=nn.initializers.orthogonal(scale))(h)

        log_std = self.param("log_std", nn.initializers.constant(-0.7), (vec.action_size,))
        return jnp.append(tower(vec.action_size, 0.01), log_std), tower(1, 1.0)[0]


networks = Networks()
both = jax.vmap(networks.apply, in_axes=(None, 0))  # of a batch of observations


def act(params, observation):
    """Returns what the distribution of an action is made from, as `unroll` asks for."""
    return networks.apply(params, observation)[0]


# %% [markdown]
# ## Advantages
#
# GAE (Schulman et al. 2016) adds up errors of the value, backward in time. If the task ended the episode, nothing
# follows. If the time limit ended the episode, the value of the next observation still counts.


# %%
def advantages(params, played):
    """Returns advantages and the targets of values, [T, N]."""
    value = jax.vmap(both, in_axes=(None, 0))
    now, then = value(params, played.observation)[1], value(params, played.next_observation)[1]
    error = played.reward + DISCOUNT * jnp.where(played.terminated, 0, then) - now

    def back(trace, row):
        error, done = row
        trace = error + DISCOUNT * TRACE * jnp.where(done, 0, trace)
        return trace, trace

    found = jax.lax.scan(back, jnp.zeros(ENVS), (error, played.done), reverse=True)[1]
    return found, found + now


def loss(params, batch):
    """Returns the clipped surrogate and the squared error of the value."""
    observation, action, old_log_prob, advantage, target = batch
    outputs, value = both(params, observation)
    ratio = jnp.exp(family.log_prob(outputs, action) - old_log_prob)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    return -surrogate.mean() + 0.5 * jnp.mean((value - target) ** 2)


# %% [markdown]
# ## The loop

# %%
optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))


def update(carry, key):
    """Plays a segment and learns from it; returns the mean return of episodes that ended."""
    params, opt_state, state = carry
    play_key, key = jax.random.split(key)
    state, played = mr.unroll(vec, act, params, family, state, play_key, num_steps=STEPS)
    batch = (played.observation, played.action, played.log_prob, *advantages(params, played))
    rows = jax.tree.map(lambda x: x.reshape(STEPS * ENVS, *x.shape[2:]), batch)

    def learn(carry, chosen):
        params, opt_state = carry
        slope = jax.grad(loss)(params, jax.tree.map(lambda x: x[chosen], rows))
        step, opt_state = optimizer.update(slope, opt_state)
        return (optax.apply_updates(params, step), opt_state), None

    shuffle = partial(jax.random.permutation, x=STEPS * ENVS)
    order = jax.vmap(shuffle)(jax.random.split(key, EPOCHS)).reshape(EPOCHS * MINIBATCHES, -1)
    (params, opt_state), _ = jax.lax.scan(learn, (params, opt_state), order)
    ended = jnp.where(played.done, played.episode_return, 0).sum() / played.done.sum()
    return (params, opt_state, state), ended


@jax.jit
def train(key):
    """Returns the mean returns [UPDATES] of a training."""
    init_key, reset_key, key = jax.random.split(key, 3)
    params = networks.init(init_key, jnp.zeros(vec.observation_size))
    start = params, optimizer.init(params), vec.reset(reset_key)
    return jax.lax.scan(update, start, jax.random.split(key, UPDATES))[1]


begin = time.perf_counter()
returns = [np.asarray(train(jax.random.key(seed))) for seed in range(3)]
steps = len(returns) * UPDATES * STEPS * ENVS
print(f"{steps:,} env steps in {time.perf_counter() - begin:.1f} s, compiling included")

# %%
fig, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
for seed, each in enumerate(returns):
    axes.plot(np.arange(UPDATES) * STEPS * ENVS / 1e3, each, label=f"seed {seed}")
axes.set(xlabel="thousand env steps", ylabel="return of episodes that ended")
axes.legend()
fig.savefig("ppo.png", dpi=90)

# %% [markdown]
# ## To try
#
# 1. `make_vec("Hopper-v5", 128)`, with more steps. Normalize observations, as the larger program does.
# 2. Train the seeds side by side: `jax.vmap(train)(keys)`.
# 3. Remove the value, and play whole episodes (`rollout`) instead of segments. What is left is REINFORCE.
#
# [The engine as an environment](../vector.md) has all details.

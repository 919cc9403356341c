"""brax's PPO on our environments: as brax maps and resets them, and through ``make_vec``."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import train as ppo

from experiments.kit.rows import words
from experiments.speed.peers import brax as peers_brax
from experiments.speed.peers.settings import BRAX
from experiments.speed.trainers.sides import LAST, Trained
from mjx_reinforce import envs
from mjx_reinforce.vector import for_brax
from mjx_reinforce.vector.for_brax import BraxVectorEnv

#: Updates at the start that are not timed, since they compile.
_FIRST = 2
_MINIBATCHES = 8


def train(
    side: str, task: str, num_envs: int, seed: int, env_steps: int, *, rollout: int
) -> Trained:
    """Trains with brax's settings for the task, except the numbers that fit a small machine.

    The return is of episodes of the last policy without noise.

    Args:
      side: "brax" for its own wrappers, "mjx_reinforce" for ``make_vec``.
      task: an id of ours that brax has settings for.
      num_envs: N.
      seed: of all that is random.
      env_steps: of the training.
      rollout: env steps between updates, of all environments together.
    """
    peers_brax.mend_jax()
    began = time.perf_counter()
    ours, single = side == "mjx_reinforce", envs.make(task)
    env = for_brax.make(single, num_envs) if ours else peers_brax.Rescaled(single)
    arguments = dict(BRAX[task].arguments)
    batch = rollout // _MINIBATCHES // arguments["unroll_length"]
    arguments |= {"num_envs": num_envs, "num_minibatches": _MINIBATCHES, "batch_size": batch}
    update = batch * _MINIBATCHES * arguments["unroll_length"]
    updates = -(-env_steps // update)
    times: list[tuple[float, float]] = []
    make_policy, params, _ = ppo.train(
        env,
        num_timesteps=updates * update,
        num_evals=updates + 1,  # one update between two calls of policy_params_fn
        run_evals=False,
        num_eval_envs=num_envs,  # they are made nevertheless
        wrap_env=not ours,
        policy_params_fn=lambda *_: times.append((time.perf_counter(), time.process_time())),
        episode_length=single.max_episode_steps,
        seed=seed,
        max_devices_per_host=1,
        **arguments,
    )
    timed = times[-updates:]
    (wall, cpu), (last_wall, last_cpu) = timed[_FIRST - 1], timed[-1]
    returns = play(for_brax.make(task, LAST), make_policy(params, deterministic=True), seed)
    start_seconds, settings = wall - began, words(arguments)
    return Trained(
        returns, start_seconds, last_wall - wall, last_cpu - cpu, updates * update, settings
    )


def play(env: BraxVectorEnv, policy: Any, seed: int) -> list[float]:
    """Returns the returns of an episode of each environment under a policy of brax's."""
    vec = env.vec

    def step(carry: Any, _: Any) -> tuple[Any, None]:
        state, total, running = carry
        state = env.step(state, policy(state.obs, jax.random.key(0))[0])
        total += jnp.where(running, state.reward, 0)
        return (state, total, running & (state.done == 0)), None

    start = env.reset(jax.random.split(jax.random.key(seed), vec.num_envs))
    carry = start, jnp.zeros(vec.num_envs), jnp.ones(vec.num_envs, bool)
    played = jax.jit(lambda x: jax.lax.scan(step, x, length=vec.max_episode_steps)[0][1])
    return [float(x) for x in np.asarray(played(carry))]

"""rejax's PPO on our environments: under rejax's own wrapper of brax's, and through ``make_vec``.

rejax maps the step of one environment by ``jax.vmap``. ``make_vec(task, 1)``, mapped, is one call
for all of them, so nothing of rejax is changed.
"""

import time
from typing import Any

import jax
import numpy as np
from brax.envs.wrappers.training import EpisodeWrapper
from rejax import PPO  # pyright: ignore[reportMissingImports]
from rejax.compat.brax2gymnax import Brax2GymnaxEnv  # pyright: ignore[reportMissingImports]
from rejax.evaluate import evaluate  # pyright: ignore[reportMissingImports]

from experiments.kit.rows import words
from experiments.speed.peers import brax as peers_brax
from experiments.speed.trainers.sides import LAST, Trained
from mjx_reinforce import envs
from mjx_reinforce.vector import for_brax

#: github.com/keraJLi/rejax, configs/brax: halfcheetah.yaml and hopper.yaml, tuned there for brax's.
_SHARED = {"clip_eps": 0.2, "ent_coef": 0.01, "vf_coef": 0.5, "normalize_observations": True}
SETTINGS: dict[str, dict[str, Any]] = {
    "HalfCheetah-v5": _SHARED
    | {"num_epochs": 2, "num_minibatches": 2, "learning_rate": 0.0017203361125365498}
    | {"max_grad_norm": 5, "gamma": 0.99, "gae_lambda": 0.8},
    "Hopper-v5": _SHARED
    | {"num_epochs": 9, "num_minibatches": 2, "learning_rate": 0.00025674088686342003}
    | {"max_grad_norm": 1, "gamma": 0.995, "gae_lambda": 0.95},
}


class OneOfMany(Brax2GymnaxEnv):
    """One environment as rejax takes it; mapped over N, its step is one call for all N."""

    def __init__(self, task: str):
        """Takes an id of ours whose actions have bounds."""
        self.env = for_brax.make(task, 1)
        self.max_steps_in_episode = self.env.vec.max_episode_steps

    def reset(self, key: jax.Array, params: Any = None) -> tuple[jax.Array, Any]:
        """Begins an episode; returns its observation [O] and state."""
        state: Any = self.env.reset(key)
        return state.obs[0], state

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any = None
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, dict[str, Any]]:
        """Plays a step with an action [A] from -1 to 1; one that ends an episode resets."""
        state = self.env.step(state, action[None])
        return state.obs[0], state, state.reward[0], state.done[0] != 0, {}


def train(
    side: str, task: str, num_envs: int, seed: int, env_steps: int, *, rollout: int
) -> Trained:
    """Trains with rejax's settings for the task.

    The return is of episodes of the last policy, with its noise.

    Args:
      side: "rejax" for its own wrapper of brax's, "mjx_reinforce" for ``make_vec``.
      task: a key of ``SETTINGS``.
      num_envs: N.
      seed: of all that is random.
      env_steps: of the training.
      rollout: env steps between updates, of all environments together.
    """
    began = time.perf_counter()
    ours, single = OneOfMany(task), envs.make(task)
    theirs = EpisodeWrapper(peers_brax.Rescaled(single), single.max_episode_steps, 1)
    updates = -(-env_steps // rollout)
    settings = SETTINGS[task] | {"num_steps": rollout // num_envs}
    program = PPO.create(
        env=ours if side == "mjx_reinforce" else Brax2GymnaxEnv(theirs),
        num_envs=num_envs,
        total_timesteps=updates * rollout,
        eval_freq=updates * rollout,
        skip_initial_evaluation=True,
        agent_kwargs={"activation": "tanh"},
        **settings,
    ).replace(eval_callback=lambda *_: ())
    key = jax.random.PRNGKey(seed)
    compiled = jax.jit(program.train).lower(key).compile()
    start, cpu = time.perf_counter(), time.process_time()
    trained, _ = jax.block_until_ready(compiled(key))
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    act, params = program.make_act(trained), ours.default_params
    _, returns = evaluate(act, key, ours, params, LAST, params.max_steps_in_episode)
    found = [float(x) for x in np.asarray(returns)]
    told = words(settings)
    return Trained(found, start - began, seconds, cpu, int(trained.global_step), told)

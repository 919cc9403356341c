"""A trained policy for programs without JAX: NumPy observations in, NumPy actions out."""

import functools
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from mjx_reinforce.engine.checks import check_type
from mjx_reinforce.export.policy_files import SavedPolicy, read_policy
from mjx_reinforce.export.run_files import (
    Run,
    SeedChoice,
    Which,
    choose_seed,
    policy_folder,
    read_run,
)
from mjx_reinforce.learning.policy import Actor, Policy, act


class Player(NamedTuple):
    """The trained policy of one seed of a run.

    Attributes:
      env: the id of the environment that it was trained on
      seed: the number of the seed
      policy: the network and its distribution
      actor: the seed's parameters and observation statistics

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> player = mr.load("HalfCheetah-v5")  # it comes with the package
      >>> player.env, player.act(np.zeros(17)).shape, player.act(np.zeros((5, 17))).shape
      ('HalfCheetah-v5', (6,), (5, 6))
    """

    env: str
    seed: int
    policy: Policy
    actor: Actor

    def __repr__(self) -> str:
        return f"Player({self.env}, seed {self.seed}, {self.policy!r})"

    @property
    def observation_size(self) -> int:
        """The number O of entries of an observation."""
        return self.actor.normalizer.mean.shape[0]

    def act(
        self, observation: np.ndarray, rng: np.random.Generator | None = None
    ) -> np.ndarray | int:
        """Returns what ``env.step`` of Gymnasium takes.

        Args:
          observation: [O], or [N, O] for N environments, as the environment gave it.
          rng: draws the action, as in training; without it the action is the policy's mode.

        Returns:
          The action [A], or [N, A]; discrete: an int, or [N].

        Raises:
          ValueError: the observation is not of this environment.
        """
        mean = self.actor.normalizer.mean
        observation = np.asarray(observation, mean.dtype)
        if observation.ndim not in (1, 2) or observation.shape[-1:] != mean.shape:
            raise ValueError(
                f"the policy for {self.env} takes observations [{mean.size}] or "
                f"[N, {mean.size}], got one of shape {list(observation.shape)}"
            )
        if rng is None:
            action = _mode(self.policy, self.actor, observation)
        else:
            key = jax.random.key(int(rng.integers(2**32)))
            action = _sample(self.policy, self.actor, observation, key)
        return np.array(action) if action.ndim else int(action)


def load(
    run: str | Path, seed: SeedChoice = "best", *, which: Which = "last", policy: str | None = None
) -> Player:
    """Loads a trained policy to play, in Gymnasium or elsewhere.

    Args:
      run: the run directory that training left, or the id of a task whose trained policy comes with
        the package, such as "HalfCheetah-v5"; ``pretrained()`` lists them. A directory of that name
        goes first.
      seed: "best", "worst" or "median" in the run's final evaluation, or a number.
      which: "last" for the policy at the end of training, "best" for the one that did best on
        the way, where the run kept it.
      policy: "module:name" where the distribution of the run is of that code, which is imported
        then.

    Raises:
      ValueError: there is no such run, task or seed, the run has not ended, or a file is damaged.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> player = mr.load("HalfCheetah-v5")  # it comes with the package
      >>> player.env, player.act(np.zeros(17)).shape, player.act(np.zeros((5, 17))).shape
      ('HalfCheetah-v5', (6,), (5, 6))
    """
    check_type("run", run, str | Path)
    return load_seed(read_run(run), seed, which, policy)[0]


def load_seed(
    run: Run, seed: SeedChoice, which: Which = "last", policy: str | None = None
) -> tuple[Player, SavedPolicy]:
    """Loads one seed, as ``load``, with what its files say."""
    folder, number = policy_folder(run, which), choose_seed(run, seed, which)
    saved = read_policy(folder, run.place(number), policy)
    if saved.settings.get("env", run.env) != run.env:
        raise ValueError(
            f"{folder / 'policy.json'} is for {saved.settings['env']}, "
            f"{run.directory / 'config.json'} for {run.env}: they are of different runs"
        )
    return Player(run.env, number, saved.policy, saved.actor), saved


@functools.partial(jax.jit, static_argnums=0)
def _mode(policy: Policy, actor: Actor, observation: jax.Array) -> jax.Array:
    return policy.distribution.mode(act(policy, actor, observation))


@functools.partial(jax.jit, static_argnums=0)
def _sample(policy: Policy, actor: Actor, observation: jax.Array, key: jax.Array) -> jax.Array:
    outputs = act(policy, actor, observation)
    noise = policy.distribution.noise(key, outputs.shape[:-1])
    return policy.distribution.sample(outputs, noise)

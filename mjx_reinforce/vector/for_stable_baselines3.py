"""The environments as Stable-Baselines3's ``VecEnv``.

    from stable_baselines3 import PPO
    from mjx_reinforce.vector import for_stable_baselines3
    PPO("MlpPolicy", for_stable_baselines3.make("Hopper-v5", 64)).learn(1_000_000)

``pip install stable-baselines3`` installs that library, which this package does not need.
"""

import time
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from mjx_reinforce.types import Environment
from mjx_reinforce.vector import for_gymnasium
from mjx_reinforce.vector.episodes import VectorState
from mjx_reinforce.vector.for_gymnasium import GymnasiumVectorEnv


class StableBaselinesVecEnv(VecEnv):
    """N environments under Stable-Baselines3's interface; what ``make`` returns.

    Each begins its next episode in the step that ends one. The info of a step that ends an episode
    has what ``Monitor`` and ``DummyVecEnv`` tell: "episode" {"r": return, "l": steps, "t": seconds
    since the environments were made}, "terminal_observation" [O] and "TimeLimit.truncated"; the
    infos of other steps are empty.

    envs: the same environments under Gymnasium's interface
    """

    def __init__(self, envs: GymnasiumVectorEnv):
        """Takes environments with ``autoreset="same_step"`` and NumPy arrays."""
        self.envs = envs
        self._began = time.time()
        self._actions: Any = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Begins new episodes, from the seeds that ``seed`` has set; returns observations [N, O].

        Seeds are for one reset. Without them the environments go on drawing.
        """
        seeds = None if self._seeds[0] is None else self._seeds
        self._reset_seeds()
        return self.envs.reset(seed=seeds)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions of the next step: [N, A], or [N] if discrete."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Plays the step.

        Returns:
          The observations [N, O], the rewards [N], whether episodes ended [N], and N infos.

        Raises:
          ValueError: the actions have another shape or kind, or are not finite numbers.
        """
        state = self.envs.advance(self._actions)
        # Copies: the next step writes into the state's memory.
        obs, reward, done = np.array(state.obs), np.array(state.reward), np.array(state.terminated)
        done |= np.asarray(state.truncated)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            self._tell(state, done, infos)
        return obs, reward, done, infos

    def close(self) -> None:
        """Forgets the environments."""
        self.envs.close()

    def get_images(self) -> tuple[np.ndarray, ...]:
        """Returns a picture of the first environment, where ``render_mode`` is "rgb_array"."""
        return self.envs.render() or ()

    def get_attr(self, attr_name: str, indices: object = None) -> list[Any]:
        """Returns an attribute, once for each environment: of Gymnasium's, or of the task's own."""
        owner = self.envs if hasattr(self.envs, attr_name) else self.envs.vec.env
        return self._each(getattr(owner, attr_name), indices)

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        """Raises NotImplementedError: the environments are compiled as they were made."""
        raise NotImplementedError(
            f"{attr_name} cannot be set: the environments are compiled; make others"
        )

    def env_method(
        self,
        method_name: str,
        *method_args: object,
        indices: object = None,
        **method_kwargs: object,
    ) -> list[Any]:
        """Calls a method of the task once; returns what it returned, once for each environment."""
        found = getattr(self.envs.vec.env, method_name)(*method_args, **method_kwargs)
        return self._each(found, indices)

    def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
        """Returns, for each environment, whether it tells what a wrapper would: ``Monitor`` alone.

        Therefore ``evaluate_policy`` reads the returns of whole episodes.
        """
        return self._each(wrapper_class is Monitor, indices)

    def _each(self, value: object, indices: object) -> list[Any]:
        return [value for _ in self._get_indices(indices)]

    def _tell(self, state: VectorState, done: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Fills the infos of the environments whose episodes have ended."""
        ended = np.flatnonzero(done)
        # Where the simulation broke, a learner that stores it as the next one gets numbers.
        final = np.nan_to_num(np.asarray(state.final_obs)[ended], posinf=0, neginf=0)
        cut = np.asarray(state.truncated) & ~np.asarray(state.terminated)
        returns, lengths = np.asarray(state.episode_return), np.asarray(state.episode_length)
        seconds = round(time.time() - self._began, 6)
        for i, observation in zip(ended, final, strict=True):
            infos[i] = {
                "episode": {"r": round(float(returns[i]), 6), "l": int(lengths[i]), "t": seconds},
                "terminal_observation": observation,
                "TimeLimit.truncated": bool(cut[i]),
            }


def make(env: str | Environment, num_envs: int = 1, **options: Any) -> StableBaselinesVecEnv:
    """Makes N environments for Stable-Baselines3.

    Args:
      env: as of ``make_vec``.
      num_envs: N.
      **options: ``render_mode`` ("rgb_array"), further arguments of ``make_vec`` except
        ``autoreset``, and of the task.

    Raises:
      ValueError: as of ``make_vec``.
    """
    fixed = {"arrays": "numpy", "autoreset": "same_step"}
    return StableBaselinesVecEnv(for_gymnasium.make(env, num_envs, **fixed, **options))

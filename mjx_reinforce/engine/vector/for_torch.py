"""The environments with torch's tensors, as the trainers of RSL-RL take them: its ``VecEnv``."""

import functools
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.engine.vector.environment import VectorEnv, VectorState

try:
    import torch  # pyright: ignore[reportMissingImports]
    from tensordict import TensorDict  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ValueError(
        f"framework='torch' needs torch and tensordict, which RSL-RL brings ({error}): "
        "pip install 'mjx-reinforce[rsl-rl]'"
    ) from error

#: A tensor of torch, which type checkers do not see here.
Tensor: TypeAlias = Any


class TorchVectorEnv:
    """N environments with the attributes and methods of RSL-RL's ``VecEnv``.

    Tensors share their memory with JAX's arrays, which nobody may write into. All are on JAX's
    device. The observations are a ``TensorDict`` whose only entry is "policy" [N, O].

    num_envs: N
    num_actions: A
    max_episode_length: the time limit in steps
    device: where the tensors are
    cfg: what is logged of the environments
    vec: the same environments in JAX
    state: theirs, as of the last ``reset`` or ``step``
    """

    def __init__(self, vec: VectorEnv):
        """Begins episodes, of seed 0.

        Args:
          vec: the environments in JAX, with autoreset "same_step".

        Raises:
          ValueError: their actions are discrete, or they have another autoreset or no time limit.
        """
        name = type(vec.env).__name__
        if isinstance(vec.action_space, Discrete):
            raise ValueError(
                f"the actions of framework='torch' are continuous, as RSL-RL's, and {name} has "
                "discrete ones; mjx_reinforce.gym.make(..., arrays='torch') has both"
            )
        if vec.autoreset != "same_step":
            raise ValueError(
                f"with framework='torch', autoreset must be same_step, got {vec.autoreset}"
            )
        if vec.max_episode_steps is None:
            raise ValueError(f"{name} has no time limit, which RSL-RL asks for: max_episode_steps=")
        self.vec = vec
        self.num_envs = vec.num_envs
        self.num_actions = vec.action_size
        self.max_episode_length = vec.max_episode_steps
        self.cfg = {"env": repr(vec.env), "num_envs": vec.num_envs, "engine": vec.engine.name}
        self._reset = jax.jit(vec.reset)
        # Its state is not donated: what is handed out must outlive the next step.
        self._step = jax.jit(functools.partial(_advance, vec))
        self.state: VectorState = self._reset(jax.random.key(0))
        self.device = torch.from_dlpack(self.state.obs).device

    def reset(self, seed: int = 0) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes; returns the observations and an empty dict."""
        self.state = self._reset(jax.random.key(seed))
        return self.get_observations(), {}

    def get_observations(self) -> Any:
        """Returns what the next actions are chosen by."""
        observation = torch.from_dlpack(self.state.obs)
        return TensorDict({"policy": observation}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Plays one step; where an episode ends, the next begins.

        Args:
          actions: [N, A] of the observations' dtype, not clipped.

        Returns:
          The observations; the rewards [N]; whether episodes ended [N] bool; and a dict with
          "time_outs" [N] bool, whether only the time limit ended them, and "log", the terms of the
          reward and what else the task tells [N], and whether the simulation broke.

        Raises:
          ValueError: the actions have another shape, dtype, or device, or are not finite.
        """
        self._check(actions)
        action = jnp.from_dlpack(actions.detach().contiguous())
        self.state, flags = self._step(self.state, action)
        log = self.state.metrics | {"nonfinite": flags["nonfinite"]}
        outcome = self.state.reward, flags["done"], flags["time_outs"], log
        reward, done, time_outs, log = jax.tree.map(torch.from_dlpack, outcome)
        extras = {"time_outs": time_outs, "log": {f"/{name}": x for name, x in log.items()}}
        return self.get_observations(), reward, done, extras

    @property
    def episode_length_buf(self) -> Tensor:
        """The steps of the running episodes [N]; RSL-RL sets them, so that ends spread out."""
        return torch.from_dlpack(jnp.where(self.state.done, 0, self.state.episode_length))

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: Tensor) -> None:
        """Sets the steps of the running episodes, integers [N]."""
        if tuple(lengths.shape) != (self.num_envs,) or lengths.is_floating_point():
            raise ValueError(
                f"episode_length_buf must be integers [{self.num_envs}], got {_in_words(lengths)}"
            )
        length = jnp.from_dlpack(lengths.to(torch.int32).clone())
        # An episode that has just ended would begin to count at 0.
        ended = jnp.zeros(self.num_envs, bool)
        self.state = self.state.replace(episode_length=length, terminated=ended, truncated=ended)

    def _check(self, actions: Tensor) -> None:
        """Raises ValueError for what are no actions."""
        if not isinstance(actions, torch.Tensor):
            raise ValueError(f"actions must be a torch.Tensor, got a {type(actions).__name__}")
        dtype = torch.from_dlpack(self.state.reward).dtype
        shape = self.num_envs, self.num_actions
        if (tuple(actions.shape), actions.dtype, actions.device) != (shape, dtype, self.device):
            raise ValueError(
                f"actions must be {dtype} {list(shape)} on {self.device}, got {_in_words(actions)}"
            )
        is_bad = ~torch.isfinite(actions)
        if is_bad.any():
            index = tuple(torch.nonzero(is_bad)[0].tolist())
            raise ValueError(f"actions must be finite numbers, got {actions[index]} at {index}")


def _advance(
    vec: VectorEnv, state: VectorState, action: jax.Array
) -> tuple[VectorState, dict[str, jax.Array]]:
    """Returns the environments one step later, and flags [N] that their state does not have."""
    state = vec.step(state, action)
    return state, {
        "done": state.done,
        "time_outs": state.truncated & ~state.terminated,
        "nonfinite": state.nonfinite.astype(state.reward.dtype),  # the share of them is logged
    }


def _in_words(tensor: Tensor) -> str:
    """Returns what a tensor is, for a message."""
    return f"{tensor.dtype} {list(tensor.shape)} on {tensor.device}"

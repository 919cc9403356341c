"""The environments as Gymnasium's ``VectorEnv``, with NumPy arrays, JAX's or torch's."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from mjx_reinforce.engine.base import Discrete, PyTree
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.engine.play.available import GENERATOR
from mjx_reinforce.engine.vector.environment import VectorEnv, VectorState
from mjx_reinforce.engine.vector.pictures import Renderer, check_drawing

#: Width and height of a picture, in pixels: those of MuJoCo's own renderer.
_PICTURE = (320, 240)
#: A seed of all environments, or one for each.
Seeds: TypeAlias = int | Sequence[int | None] | None


def _to_torch(x: jax.Array) -> Any:
    import torch  # pyright: ignore[reportMissingImports] (whoever asks for it has it)

    return torch.from_dlpack(x)


#: How arrays are handed out, by name: copied, for the next step writes into the state's memory, or
#: as they are on the device.
_CONVERTERS: dict[str, Callable[[jax.Array], Any]] = {
    "numpy": np.array,
    "jax": lambda x: x,
    "torch": _to_torch,
}


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """N environments under Gymnasium's interface; what ``mjx_reinforce.gym.make`` returns.

    vec: the same environments in JAX
    state: theirs, as of the last ``reset`` or ``step``
    """

    def __init__(self, vec: VectorEnv, arrays: str = "numpy", render_mode: str | None = None):
        """Compiles the reset and the step on their first call.

        Args:
          vec: the environments in JAX.
          arrays: "numpy", or "jax" or "torch", which stay on the device and are not copied.
          render_mode: "rgb_array", or None for no pictures.

        Raises:
          ValueError: an argument has no such value, there is nothing to render, or MuJoCo cannot
            draw here.
        """
        check_name("arrays", arrays, _CONVERTERS)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, got {render_mode!r}")
        if render_mode and not hasattr(vec.env, "mj_model"):
            raise ValueError(f"{type(vec.env).__name__} has no MuJoCo model to render")
        if render_mode:
            check_drawing()
        self.vec = vec
        self.num_envs = vec.num_envs
        self.render_mode = render_mode
        self.state: VectorState | None = None
        self.metadata = {
            "autoreset_mode": AutoresetMode[vec.autoreset.upper()],
            "render_modes": ["rgb_array"],
        }
        # A task whose steps have no duration, such as one without physics, has no rate of pictures.
        if dt := getattr(vec.env, "dt", None):
            self.metadata["render_fps"] = round(1 / dt)
        self.single_observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (vec.observation_size,), np.float32
        )
        self.single_action_space = _space(vec)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)
        self._arrays = arrays
        self._out = _CONVERTERS[arrays]
        self._reset = jax.jit(vec.reset)
        self._restart = jax.jit(vec.restart)
        # What is handed out without a copy must outlive the next step.
        self._step = jax.jit(vec.step, donate_argnums=0 if arrays == "numpy" else ())
        self._renderer: Renderer | None = None

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes.

        Args:
          seed: one for each environment, or one number: the seed of environment i is that and i.
            Without one the environments go on drawing from their keys; the first time it is drawn
            at random.
          options: {"reset_mask": bool [N]} resets some of the environments and lets others be.

        Returns:
          The observations [N, O] and an empty dict.
        """
        self._check_open()
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if options:
            raise ValueError(f"unknown option {', '.join(map(repr, options))}; known: 'reset_mask'")
        # Only the first reset and one with a seed draw keys anew: the environments have their own.
        if mask is not None:
            state = self._reset_masked(seed, np.asarray(mask))
        elif seed is None and self.state is not None:
            state = self._restart(self.state, np.ones(self.num_envs, bool))
        else:
            state = self._reset(self._keys(seed))
        self.state = state
        return self._out(state.obs), {}

    def step(self, actions: PyTree) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Plays one step.

        Args:
          actions: [N, A], or [N] if discrete; of NumPy, JAX or torch.

        Returns:
          The observations [N, O], the rewards [N], whether episodes terminated [N] and were
          truncated [N], and what else is known: the reward's terms [N] by name, "final_obs" and
          "final_info" where ``same_step`` has reset, and "nonfinite" [N] where the simulation left
          the finite numbers.

        Raises:
          ValueError: the actions have another shape or kind, or are not finite numbers; or with
            ``autoreset="disabled"`` an episode has ended and nobody has reset its environment.
        """
        state = self.advance(actions)
        return (
            self._out(state.obs),
            self._out(state.reward),
            self._out(state.terminated),
            self._out(state.truncated),
            self._info(state),
        )

    def advance(self, actions: PyTree) -> VectorState:
        """Plays one step as ``step`` does, and returns the environments in JAX.

        Where ``arrays`` is "numpy", the next step writes into their memory.
        """
        self._check_open()
        if self.state is None:
            raise ValueError("call reset before step")
        if self.vec.autoreset == "disabled" and (envs := np.flatnonzero(self.state.done)).size:
            raise ValueError(
                f"{envs.size} of {self.num_envs} environments have ended, such as {envs[0]}; with "
                "autoreset='disabled' reset them before the next step: "
                "reset(options={'reset_mask': terminated | truncated})"
            )
        state = self.state = self._step(self.state, self._actions(actions))
        return state

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a picture [height, width, 3] uint8 of the first environment; None without a mode.

        A picture of each of thousands would take minutes.
        """
        if self.render_mode is None or self.state is None:
            return None
        if self._renderer is None:
            model = self.vec.env.mj_model  # pyright: ignore[reportAttributeAccessIssue]
            self._renderer = Renderer(model, *_PICTURE)
        return (self._renderer.draw(self.state.simulation.pipeline_state.qpos[0]),)

    def close_extras(self, **kwargs: object) -> None:
        """Forgets the environments and the renderer."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self.state = None

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError("it holds compiled code, which cannot be pickled; make it where it is used")

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("it was closed; make another")

    def _keys(self, seed: Seeds) -> jax.Array:
        """Returns a key for each environment [N]."""
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
        if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
            # Gymnasium's class seeds its own generator, ``np_random``.
            super().reset(seed=int(seed))
            return _keys_of(range(int(seed), int(seed) + self.num_envs))
        if not isinstance(seed, list | tuple | np.ndarray) or len(seed) != self.num_envs:
            raise ValueError(
                f"seed must be a whole number, or a list of {self.num_envs}, one each, got {seed!r}"
            )
        # None in the list draws a seed of that environment at random.
        random_seeds = np.random.SeedSequence().generate_state(self.num_envs)
        pairs = zip(seed, random_seeds, strict=True)
        return _keys_of([int(draw if choice is None else choice) for choice, draw in pairs])

    def _reset_masked(self, seed: Seeds, mask: np.ndarray) -> VectorState:
        """Returns the environments with new episodes where a mask [N] says so, of seeds if any."""
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"options['reset_mask'] must be a bool array [{self.num_envs}], got {mask!r}"
            )
        if self.state is None:
            raise ValueError("the first reset must be of all environments: leave reset_mask out")
        state = self.state
        # ``restart`` draws from the keys in the state: those of a seed take their place.
        if seed is not None:
            keys = jax.random.key_data(self._keys(seed))
            state = state.replace(keys=jnp.where(mask[:, None], keys, state.keys))  # pyright: ignore
        return self._restart(state, mask)

    def _actions(self, actions: PyTree) -> Any:
        """Returns actions as JAX takes them, or raises ValueError where they are none."""
        if type(actions).__module__.partition(".")[0] == "torch":
            actions = jnp.from_dlpack(actions.detach().contiguous())
        # Arrays on the device are not looked at: that would wait for the step which makes them.
        if isinstance(actions, jax.Array):
            return actions
        actions = np.asarray(actions)
        if actions.dtype.kind not in "biuf":
            raise ValueError(
                f"actions must be numbers {list(self.action_space.shape or ())}, they are of "
                f"{actions.dtype}"
            )
        space = self.single_action_space
        if isinstance(space, gymnasium.spaces.Discrete):
            is_bad = (actions < 0) | (actions >= space.n)
            if actions.dtype.kind in "iu" and np.any(is_bad):
                raise ValueError(f"actions must be 0 to {space.n - 1}, got {actions[is_bad][0]}")
        elif actions.dtype.kind == "f" and not np.all(np.isfinite(actions)):
            index = tuple(int(x) for x in np.argwhere(~np.isfinite(actions))[0])
            raise ValueError(f"actions must be finite numbers, got {actions[index]} at {index}")
        # The action space is float32, and NumPy's numbers are float64 unless one says otherwise.
        if actions.dtype == np.float64:
            return actions.astype(np.float32)
        return actions

    def _info(self, state: VectorState) -> dict[str, Any]:
        """Returns what Gymnasium keeps apart: entries by name, each with a mask behind "_"."""
        terms = {name: self._out(x) for name, x in state.metrics.items()}
        # With ``same_step`` the observation is a new start's where an episode has ended. What that
        # one left is in "final_info" then, and masked out beside it.
        is_ended = np.asarray(state.done) & (self.vec.autoreset == "same_step")
        info: dict[str, Any] = terms | {f"_{name}": ~is_ended for name in terms}
        if is_ended.any():
            info["final_info"] = terms | {f"_{name}": is_ended for name in terms}
            info["_final_info"] = is_ended
            info["final_obs"] = self._final_observations(state, is_ended)
            info["_final_obs"] = is_ended
        nonfinite = np.asarray(state.nonfinite)
        if nonfinite.any():
            info["nonfinite"] = nonfinite
            info["_nonfinite"] = np.ones(self.num_envs, bool)
        return info

    def _final_observations(self, state: VectorState, is_ended: np.ndarray) -> Any:
        """Returns the last observations; in NumPy an array of arrays and None, as Gymnasium has."""
        if self._arrays != "numpy":
            return self._out(state.final_obs)
        rows = np.asarray(state.final_obs)
        observations = np.full(self.num_envs, None, object)
        # One by one: NumPy would take an array of arrays for a matrix.
        for i in np.flatnonzero(is_ended):
            observations[i] = rows[i]
        return observations


def _keys_of(seeds: Sequence[int]) -> jax.Array:
    """Returns the keys [N] of seeds, of up to 64 bits each."""
    words = np.array([((s >> 32) & 0xFFFFFFFF, s & 0xFFFFFFFF) for s in seeds], np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl=GENERATOR)


def _space(vec: VectorEnv) -> gymnasium.Space:
    """Returns the actions of one environment as Gymnasium's space."""
    space = vec.action_space
    if isinstance(space, Discrete):
        return gymnasium.spaces.Discrete(space.num_actions)
    low = np.asarray(space.low, np.float32)
    high = np.asarray(space.high, np.float32)
    return gymnasium.spaces.Box(low, high, dtype=np.float32)

"""The data that flows through the library, and the environments it accepts.

Axes are named throughout: S seeds, T time steps, N episodes, O observation
entries, A action entries.
"""

import contextlib
import dataclasses
import typing
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self, TypeAlias

import jax
import numpy as np

#: A tree of arrays, as ``jax.tree`` sees it: dataclasses, tuples, lists and dicts, nested at will.
#: Type checkers have no name for that.
PyTree: TypeAlias = Any
#: A ``mujoco.MjModel`` or ``mujoco.MjSpec``; MuJoCo's extension module comes without stubs.
MjModel: TypeAlias = Any
MjSpec: TypeAlias = Any
#: A policy: (params, observation [O]) -> outputs [K], the parameters of a distribution.
Act: TypeAlias = Callable[[Any, jax.Array], jax.Array]


@typing.dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
class Arrays:
    """A frozen dataclass of arrays, or of pytrees of them, that is a pytree in field order."""

    def __init_subclass__(cls) -> None:
        # In place: the decorator returns the class itself, of which a type checker sees no fields.
        dataclass: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
        fields = dataclasses.fields(dataclass)
        jax.tree_util.register_dataclass(cls, [field.name for field in fields], [])

    def replace(self, **changes: Any) -> Self:
        """Returns the same with other values in some fields."""
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType]


class Box(NamedTuple):
    """The actions a continuous environment accepts, entry by entry.

    Attributes:
      low: [A] the least value of each entry, -inf where unbounded
      high: [A] the greatest value of each entry, inf where unbounded

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.envs.make("ContinuousCartPole-v0").action_space
      Box(low=array([-1.]), high=array([1.]))
    """

    low: np.ndarray
    high: np.ndarray


class Discrete(NamedTuple):
    """The actions a discrete environment accepts: one integer [], 0 to ``num_actions`` - 1.

    Examples:
      >>> import jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> family = mr.categorical(mr.Discrete(2))
      >>> family.mode(jnp.asarray([0.0, 1.0])).item()
      1
    """

    num_actions: int


@typing.runtime_checkable
class Environment(Protocol):
    """What the trainer reads of an environment; brax and Playground environments satisfy it.

    ``reset`` and ``step`` are pure functions on one environment. The state they
    return has at least ``obs`` [O], ``reward`` [] and ``done`` [], which is not 0 where the episode
    ends. An episode has at least one step: ``done`` and ``reward`` of ``reset`` are not read.

    Examples:
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> env.observation_size, env.action_size, env.max_episode_steps
      (4, 2, 500)
    """

    def reset(self, rng: jax.Array) -> Any:
        """Returns the state at the start of an episode; consumes the key."""
        ...

    def step(self, state: Any, action: jax.Array) -> Any:
        """Returns the state one time step later under ``action``: [A], or [] if discrete."""
        ...

    @property
    def action_size(self) -> int:
        """The number A of entries of an action; of a discrete one, of actions to choose from."""
        ...


@typing.runtime_checkable
class Acts(Protocol):
    """A family of distributions over actions: all that is asked of one to play.

    The noise depends on the key alone, so it can be drawn before the outputs are known, and every
    engine gets the same actions from the same key. A family may say how long its outputs are by
    ``num_outputs`` and ``constants``, as ``mjx_reinforce.Distribution`` does.

    Examples:
      >>> import mjx_reinforce as mr
      >>> isinstance(mr.categorical(mr.Discrete(2)), mr.engine.Acts)
      True
    """

    @property
    def noise(self) -> Callable[..., jax.Array]:
        """(key, shape) -> [*shape, E], what ``sample`` reads; consumes the key."""
        ...

    @property
    def sample(self) -> Callable[..., jax.Array]:
        """(outputs [..., K], noise [..., E]) -> actions [..., A], or int32 [...] if discrete."""
        ...

    @property
    def mode(self) -> Callable[..., jax.Array]:
        """(outputs [..., K]) -> actions like ``sample``, of a policy without noise."""
        ...


#: The fields of a trajectory that have an entry for each step, [T, N, ...].
_STEP_FIELDS = ("observation", "action", "reward", "mask", "terms")


class Trajectory(Arrays):
    """N complete episodes, time first.

    Attributes:
      observation: [T, N, O] what the policy saw; zero where the episode is over
      action: [T, N, A], or [T, N] if discrete: what the policy drew; zero where the episode is over
      reward: [T, N] what the action earned; zero where the episode is over
      mask: [T, N] True while the episode runs, its last step included
      nonfinite: [N] True where the simulation left the finite numbers
      simulated: [] int32, env steps that were simulated for these episodes, those in which an
        episode was over already included
      terms: [T, N] each, the terms of the reward by their names, see ``term_names``; zero where
        the episode is over

    Examples:
      >>> import jax, jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> ones = jnp.ones((3, 2))  # two episodes of three steps
      >>> played = mr.Trajectory(
      ...     observation=ones[..., None], action=ones[..., None], reward=ones, mask=ones > 0,
      ...     nonfinite=jnp.zeros(2, bool), simulated=jnp.asarray(6),
      ... )
      >>> played.reward.sum(0).tolist()  # the return of each episode
      [3.0, 3.0]
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array
    nonfinite: jax.Array
    simulated: jax.Array
    terms: dict[str, jax.Array] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        # Shapes say what it is; the arrays would be pages of numbers.
        leaves = {"observation": self.observation, "action": self.action, "mask": self.mask}
        shapes = (f"{name} {x.dtype}{list(x.shape)}" for name, x in leaves.items())
        return f"Trajectory({', '.join(shapes)})"

    def first(self, steps: int) -> "Trajectory":
        """Returns the first so many steps of every episode."""
        return self._of_steps(lambda x: x[:steps])

    def episodes(self, part: slice) -> "Trajectory":
        """Returns a part of the episodes; ``simulated`` remains that of all."""
        # Time is the first axis of these, episodes the second.
        return self._of_steps(lambda x: x[:, part]).replace(nonfinite=self.nonfinite[part])

    def _of_steps(self, change: Callable[[jax.Array], jax.Array]) -> "Trajectory":
        """Returns the same with a change of all arrays [T, N, ...]."""
        step_fields = {name: getattr(self, name) for name in _STEP_FIELDS}
        return self.replace(**jax.tree.map(change, step_fields))


def action_space(env: Environment) -> Box | Discrete:
    """Returns the actions an environment declares, or brax's convention of [-1, 1]."""
    space = getattr(env, "action_space", None)
    if isinstance(space, Box | Discrete):
        return space
    return Box(np.full(env.action_size, -1.0), np.full(env.action_size, 1.0))


def null_action(env: Environment) -> np.ndarray:
    """Returns an action of zeros: float [A], or int32 [] if discrete."""
    if isinstance(action_space(env), Discrete):
        return np.zeros((), np.int32)
    return np.zeros(env.action_size, np.float32)


class PhysicsModel(NamedTuple):
    """What an env step simulates, for an engine that computes the physics by itself.

    An environment may offer it by a method ``physics_model``. Within ``keeping_whole`` its physics
    is then one operation, ``scalar.whole``, which carries the digest: so an engine knows which
    model it is to compute, whatever else is traced with it.

    mj_model: the model
    frame_skip: physics steps an env step, all under the same control
    digest: the name of all else, the same in every process
    random: the names of the model's fields that differ from episode to episode
    """

    mj_model: MjModel
    frame_skip: int
    digest: str
    random: tuple[str, ...] = ()


#: JAX keeps what it traced with one value of this apart from what it traced with another.
_WHOLE_CONTEXT = jax.make_user_context(False)
_SHAPES_CONTEXT = jax.make_user_context(False)


def keeping_whole() -> contextlib.AbstractContextManager[None]:
    """Has an environment that is traced within call ``scalar.whole`` for its physics."""
    return _WHOLE_CONTEXT(True)


def is_kept_whole() -> bool:
    """Returns whether an operation that a backend may know is to stay whole."""
    return _WHOLE_CONTEXT.value


def is_for_shapes() -> bool:
    """Returns whether nothing but shapes is asked for: what no backend knows may stay whole."""
    return _SHAPES_CONTEXT.value


def shapes(function: Callable[..., Any], *args: PyTree) -> Any:
    """Returns ``jax.eval_shape`` of what calls an environment, whose physics is not traced."""
    try:
        with keeping_whole(), _SHAPES_CONTEXT(True):
            return jax.eval_shape(function, *args)
    except Exception:  # it differentiates its physics, say; or it is wrong, which this says
        return jax.eval_shape(function, *args)


def observation_size(env: Environment) -> int:
    """Returns O, from the shapes alone: nothing is simulated.

    Raises:
      ValueError: the observation is not one vector.
    """
    obs = shapes(env.reset, jax.random.key(0)).obs
    if not hasattr(obs, "shape") or len(obs.shape) != 1:
        raise ValueError(
            f"the observation must be one vector, this environment's is {obs}; "
            "flatten it in a wrapper"
        )
    return obs.shape[0]


#: The metrics of an environment that are terms of its reward: Gymnasium's ``reward_forward``, and
#: MuJoCo Playground's ``reward/forward``.
_TERM_PREFIXES = ("reward_", "reward/")


def term_names(env: Environment) -> tuple[str, ...]:
    """Returns the names of the reward's terms, in the order of the task; none of a single one.

    They are the numbers [] among the ``metrics`` of the state, of brax's interface, that begin with
    "reward_" or "reward/". One term alone would be the reward again.
    """
    names: list[str] = []

    def reset(rng: jax.Array) -> Any:
        """Resets the environment, and keeps the names."""
        state = env.reset(rng)
        # JAX sorts the names in what a function returns: the order is seen here alone.
        metrics = getattr(state, "metrics", None)
        if isinstance(metrics, dict):  # what a state of the user's own calls so may be anything
            terms = {x: y for x, y in metrics.items() if str(x).startswith(_TERM_PREFIXES)}
            names[:] = [x for x, term in terms.items() if getattr(term, "shape", None) == ()]
        return state

    shapes(reset, jax.random.key(0))
    return tuple(names) if len(names) > 1 else ()


def is_key(leaf: Any) -> bool:
    """Returns whether a leaf, or its shape, is of random keys."""
    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def plain(tree: PyTree) -> Any:
    """Returns a pytree with the data of its keys in their place."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)


def with_keys(tree: PyTree, template: PyTree) -> Any:
    """Returns a pytree from ``plain`` with keys where ``template`` has them."""
    return jax.tree.map(
        lambda x, y: jax.random.wrap_key_data(x) if is_key(y) else x, tree, template
    )

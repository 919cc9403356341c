"""Do the parts of a learner fit together? Found from shapes: nothing is compiled."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from numpy.typing import DTypeLike

from mjx_reinforce.checks import check_kind, explain
from mjx_reinforce.learners import updates
from mjx_reinforce.learners.estimators import Estimator
from mjx_reinforce.learners.learner import Learner
from mjx_reinforce.learners.natural_gradient import natural_gradient
from mjx_reinforce.types import Environment, PyTree, Trajectory, null_action

#: Steps and episodes of the trajectory that an estimator is tried on: no two axes have one size.
_NUM_STEPS = 5
#: Metrics without which no run can be recorded.
_METRICS = (
    *("episodes", "episode_return", "episode_length", "env_steps", "simulated_steps"),
    *("nonfinite_episodes", "skipped_update"),
)


def check_optimizer(name: str, value: optax.GradientTransformation) -> None:
    """Raises ValueError for what is no optimiser."""
    check_kind(name, value, optax.GradientTransformation, "optax.adam(1e-2)")


def check_update(update: updates.Update) -> None:
    """Raises ValueError for what is no update, or a function that makes one."""
    makers = updates.full_batch, updates.minibatches, updates.each_step, natural_gradient
    if update in makers or not callable(update):
        got = f"{update.__name__}, which is to be called" if update in makers else repr(update)
        raise ValueError(f"update must be such as mjx_reinforce.full_batch(), got {got}")


def check_estimator(
    estimator: Estimator, env: Environment, observation_size: int, num_episodes: int
) -> None:
    """Raises ValueError for an estimator whose weights are not [T, N], in one line that says why.

    Args:
      estimator: what a user gave. Its functions are traced.
      env: whose actions a trajectory holds.
      observation_size: O.
      num_episodes: N.
    """
    check_kind("estimator", estimator, Estimator, "mjx_reinforce.reward_to_go(0.99)")
    if num_episodes < estimator.min_episodes:
        raise ValueError(
            f"this estimator needs at least {estimator.min_episodes} episodes an update, "
            f"got num_episodes={num_episodes}"
        )
    shape, action = (_NUM_STEPS, num_episodes), null_action(env)
    number = jnp.result_type(float)
    trajectory = Trajectory(
        observation=_shaped((*shape, observation_size), number),
        action=_shaped((*shape, *action.shape), action.dtype),
        reward=_shaped(shape, number),
        mask=_shaped(shape, bool),
        nonfinite=_shaped((num_episodes,), bool),
        simulated=_shaped((), jnp.int32),
    )

    def update(key, trajectory):
        return estimator.update(estimator.init(key, observation_size), trajectory)

    try:
        returned = jax.eval_shape(update, jax.random.key(0), trajectory)
    except Exception as error:  # it is the user's code, which may raise anything
        raise ValueError(f"estimator.init or update fails: {explain(error)}") from error
    if not (isinstance(returned, tuple) and len(returned) == 3):
        raise ValueError(
            "estimator.update must return three things, (weight [T, N], next state, metrics), "
            f"got {type(returned).__name__}"
        )
    weight = returned[0]
    if getattr(weight, "shape", None) != shape or not jnp.issubdtype(weight.dtype, jnp.floating):
        got = f"{weight.dtype}{list(weight.shape)}" if hasattr(weight, "shape") else type(weight)
        raise ValueError(
            f"estimator.update must return a weight for every action, float [T, N], here "
            f"{list(shape)}; got {got}"
        )
    if not isinstance(returned[2], dict):
        raise ValueError(
            f"estimator.update must return its metrics as a dict, got {type(returned[2]).__name__}"
        )


def check_learner(name: str, learner: Learner) -> None:
    """Raises ValueError for a learner that a run cannot train, in one line that says why.

    Args:
      name: of the function that returned it.
      learner: what it returned. Its functions are traced.
    """
    check_kind(f"what {name} returns", learner, Learner, "mjx_reinforce.reinforce(env)")
    try:
        state = jax.eval_shape(learner.init, jax.random.key(0))
        after, metrics = jax.eval_shape(learner.step, state)
    except Exception as error:  # it is the user's code, which may raise anything
        raise ValueError(f"the learner of {name} fails: {explain(error)}") from error
    if _shapes(after) != _shapes(state):
        raise ValueError(
            f"learn of the learner of {name} must return a state of the structure, shapes and "
            "dtypes of the one that it gets"
        )
    if missing := [each for each in _METRICS if each not in metrics]:
        raise ValueError(
            f"learn of the learner of {name} must also return the metrics {', '.join(missing)}: "
            "see mjx_reinforce.train_step"
        )


def _shapes(tree: PyTree) -> Any:
    """Returns the structure of a tree, and the shape and dtype of each leaf."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(x.shape, x.dtype) for x in leaves]


def _shaped(shape: tuple[int, ...], dtype: DTypeLike) -> Any:
    return jax.ShapeDtypeStruct(shape, dtype)

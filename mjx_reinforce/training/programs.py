"""The programs that move runs on side by side; ``slots`` compiles them.

They make a block of updates, and evaluate policies.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine import counts
from mjx_reinforce.engine.base import Environment, Trajectory, plain
from mjx_reinforce.engine.checks import check_count
from mjx_reinforce.engine.episode import episode_keys
from mjx_reinforce.engine.play.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learning.learner import Learner, TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training.division import ALONE, Division
from mjx_reinforce.training.state import (
    Budget,
    RunState,
    Seed,
    StateRows,
    eval_keys,
    last_test_keys,
    seed_keys,
)
from mjx_reinforce.training.wrappers import EvaluationEpisodes, SharedLaunch, step_with

#: Returns the learner of settings that may be traced, of one run each.
BuildLearner = Callable[[dict[str, jax.Array]], Learner]


class Block(NamedTuple):
    """What a block of updates measured.

    num_updates: [] how many were made
    metrics: [length, R] each; the rows after the last update are zero
    eval_metrics: [R] each, what ``evaluation_metrics`` returns of the policies before the first
      update; empty where ``advance`` does not evaluate
    """

    num_updates: jax.Array
    metrics: dict[str, jax.Array]
    eval_metrics: dict[str, jax.Array]


def block_of_updates(
    build_learner: BuildLearner,
    block_length: int,
    make_evaluation: Callable[..., EvaluationEpisodes] | None,
) -> Callable[..., tuple[RunState, Block]]:
    """Returns a function that makes ``block_length`` updates of all runs, or fewer at the end.

    It takes a ``RunState``, a ``Budget``, and whether to evaluate the policies before the first
    update, [] or [R]. Its result is the state, and a ``Block``.

    Args:
      build_learner: called while the settings of one run are traced.
      block_length: rows of the metrics.
      make_evaluation: (key of an evaluation [], active=whether it is made []) -> its episodes,
        which are played in one launch with those of the first update; None where learners cannot.
    """
    update = _update_of_runs(build_learner, make_evaluation)

    def advance(
        state: RunState, budget: Budget, evaluation_due: jax.Array
    ) -> tuple[RunState, Block]:
        """Makes the updates, and evaluates before the first; see ``block_of_updates``."""

        def unfinished(carry: tuple[RunState, Block]) -> jax.Array:
            state, block = carry
            return (block.num_updates < block_length) & jnp.any(_active(state, budget))

        def body(carry: tuple[RunState, Block]) -> tuple[RunState, Block]:
            """Makes one update, and writes its metrics as a row."""
            state, (num_updates, rows, eval_metrics) = carry
            state, row, measured = update(state, budget, evaluation_due & (num_updates == 0))
            store = functools.partial(lax.dynamic_update_index_in_dim, index=num_updates, axis=0)
            # The first update alone evaluates; what the others return as measured is void.
            eval_metrics = jax.tree.map(
                lambda x, old: jnp.where(num_updates == 0, x, old), measured, eval_metrics
            )
            return state, Block(num_updates + 1, jax.tree.map(store, rows, row), eval_metrics)

        # The loop writes into arrays of a fixed length: XLA knows no others. Rows after the last
        # update stay zero, so that "active" is False there.
        _, row, eval_metrics = jax.eval_shape(update, state, budget, evaluation_due)
        zeros = functools.partial(jax.tree.map, lambda x: jnp.zeros(x.shape, x.dtype))
        rows = jax.tree.map(lambda x: jnp.zeros((block_length, *x.shape), x.dtype), row)
        return lax.while_loop(
            unfinished, body, (state, Block(jnp.int32(0), rows, zeros(eval_metrics)))
        )

    return advance


def _update_of_runs(
    build_learner: BuildLearner, make_evaluation: Callable[..., EvaluationEpisodes] | None
) -> Callable[[RunState, Budget, jax.Array], Any]:
    """Returns a function that makes one update of all runs; arguments of both as of a block."""

    def step(
        state: TrainState,
        settings: dict[str, jax.Array],
        active: jax.Array,
        eval_key: jax.Array,
        evaluation_due: jax.Array,
    ) -> Any:
        """Makes one update of one run, and evaluates the policy before it.

        Returns its state, its metrics, and what the evaluation measured; nothing without one.
        """
        evaluation = None
        if make_evaluation is not None:
            evaluation = make_evaluation(eval_key, active=evaluation_due)
        state, metrics, trajectory = step_with(build_learner(settings), state, active, evaluation)
        eval_metrics = {}
        # Without a shared launch there are no episodes of the evaluation.
        if evaluation is not None and trajectory is not None:
            eval_metrics = evaluation_metrics(trajectory, evaluation)
        return state, metrics | {"active": active}, eval_metrics

    @functools.partial(jax.jit, inline=True)  # traced once, for its shapes and for the loop
    def update(state: RunState, budget: Budget, evaluation_due: jax.Array) -> Any:
        """Makes one update of all runs [R] that have budget left; results as of ``step``."""
        # Schedules, such as the learning rate's, go by a share that learners do not know.
        old_states = dataclasses.replace(state.train_states, progress=_progress(state, budget))
        active = _active(state, budget)
        evaluation_due = jnp.broadcast_to(evaluation_due, len(state.eval_keys))
        train_states, metrics, eval_metrics = jax.vmap(step)(
            old_states, state.settings, active, state.eval_keys, evaluation_due
        )
        return dataclasses.replace(state, train_states=train_states), metrics, eval_metrics

    return update


def _active(state: RunState, budget: Budget) -> jax.Array:
    """Returns which runs [R] have not used their budget."""
    is_out_of_steps = counts.reached(state.train_states.env_steps, budget.env_steps)
    return ~(is_out_of_steps | counts.reached(state.train_states.num_updates, budget.updates))


def _progress(state: RunState, budget: Budget) -> jax.Array:
    """Returns the share [R] of its budget that each run has used."""
    env_steps = counts.as_float(state.train_states.env_steps)
    updates = counts.as_float(state.train_states.num_updates)
    # A budget of 0 would divide by 0. No run with such a budget goes on, so any share will do.
    max_env_steps = jnp.maximum(counts.as_float(budget.env_steps), 1.0)
    max_updates = jnp.maximum(counts.as_float(budget.updates), 1.0)
    return jnp.minimum(jnp.maximum(env_steps / max_env_steps, updates / max_updates), 1.0)


def _stop_empty(state: RunState, occupied: jax.Array) -> RunState:
    """Returns states [R] in which those without a run, not ``occupied`` [R], stand still."""
    # They count as runs whose budget is used, for which a block of updates does not wait.
    env_steps = state.train_states.env_steps
    env_steps = jnp.where(occupied[:, None], env_steps, counts.from_int(MAX_COUNT))
    train_states = dataclasses.replace(state.train_states, env_steps=env_steps)
    return dataclasses.replace(state, train_states=train_states)


def evaluation_episodes(
    key: jax.Array, *, num_episodes: int, active: bool | jax.Array = True, sampled: bool = True
) -> EvaluationEpisodes:
    """Returns the episodes of an evaluation: N with the policy's mode, and N with its samples.

    Args:
      key: consumed; pass the same one each time to see the same start states, and each seed one of
        its own: else the choice of the starts is a chance that no interval over seeds covers.
      num_episodes: N, of each kind.
      active: [] where False nothing is played, and what was measured says nothing.
      sampled: whether the second N are played; the first are the same without them.
    """
    keys = episode_keys(key, (1 + sampled) * num_episodes)
    return EvaluationEpisodes(keys, num_episodes, jnp.asarray(active))


def evaluate(
    env: Environment,
    learner: Learner,
    actor: Actor,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    active: bool | jax.Array = True,
    sampled: bool = True,
) -> dict[str, jax.Array]:
    """Plays the episodes of an evaluation alone; returns what ``evaluation_metrics`` does.

    Args:
      env: what is played.
      learner: whose policy and engine it is.
      actor: the parameters and observation statistics.
      key: as for ``evaluation_episodes``, with the other arguments that are not named here.
      num_episodes: N, of each kind.
      horizon: T, the time limit in steps.
      active: [] where False nothing is played, and what is returned says nothing.
      sampled: whether the second N are played.

    Raises:
      ValueError: N or T is not from 1 to 2^31 - 1.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> actor = learner.init(jax.random.key(0)).actor
      >>> metrics = mr.evaluate(env, learner, actor, jax.random.key(1), num_episodes=4, horizon=20)
      >>> 1 <= metrics["eval_return"].item() <= 20
      True
    """
    check_count("num_episodes", num_episodes)
    check_count("horizon", horizon)
    evaluation = evaluation_episodes(key, num_episodes=num_episodes, active=active, sampled=sampled)
    trajectory = learner.engine.rollout(
        env,
        learner.act,
        actor,
        learner.policy.distribution,
        evaluation.keys,
        num_episodes=len(evaluation.keys),
        horizon=horizon,
        deterministic=evaluation.deterministic(),
        active=evaluation.active,
    )
    return evaluation_metrics(trajectory, evaluation) | {"simulated_steps": trajectory.simulated}


def evaluation_metrics(
    trajectory: Trajectory, evaluation: EvaluationEpisodes
) -> dict[str, jax.Array]:
    """Returns what the episodes of an evaluation show.

    ``eval_return`` and ``eval_length`` [], means over the deterministic episodes,
    ``eval_return_stochastic`` [], over the sampled ones if there are any, and then for each
    term of the reward, as "eval_reward_forward" [], the mean of its sums over a deterministic
    episode; ``eval_steps`` [], the steps of all episodes, and ``simulated_steps`` [], those that
    were simulated for them alone: none where they shared the launch of others. A return is NaN if
    one of its episodes left the finite numbers: what that earned until then says nothing.
    """
    returns = episode_returns(trajectory)
    lengths = episode_lengths(trajectory)
    # A return that overflowed says nothing, either.
    returns = jnp.where(trajectory.nonfinite | ~jnp.isfinite(returns), jnp.nan, returns)
    modes = evaluation.num_modes
    sampled_metrics = {}
    if len(evaluation.keys) > modes:
        sampled_metrics["eval_return_stochastic"] = jnp.mean(returns[modes:])
        # Not where modes alone are played, in a sweep: it records no more than returns.
        for name, rewards in trajectory.terms.items():
            sums = jnp.where(trajectory.nonfinite, jnp.nan, jnp.sum(rewards, axis=0))
            sampled_metrics[f"eval_{name}"] = jnp.mean(sums[:modes])
    return sampled_metrics | {
        "eval_return": jnp.mean(returns[:modes]),
        "eval_length": jnp.mean(lengths[:modes]),
        "eval_steps": jnp.sum(lengths),
        "simulated_steps": jnp.zeros((), jnp.int32),
    }


class Programs(NamedTuple):
    """The programs of R runs before they are compiled. States are rows [R, B], see ``StateRows``.

    What differs from sweep to sweep without another program is their input: seeds, budgets, and
    the settings that are traced.

    begin: (seed, the numbers [R] of the runs' seeds, settings [R] each) -> the first states, and
      the data of the keys [K, R] of the last test, which plays the episodes of K evaluations
    advance: (states, the fields of a ``Budget``, which rows have a run [R], whether to evaluate [])
      -> (states, metrics [K, R] each, what was evaluated [R] each), as in ``Block``
    evaluate: (states, whether to [R]) -> what ``evaluate`` returns, [R] each
    advance_evaluates: whether ``advance`` evaluates; else ``evaluate`` does, before it
    like: the shapes of a ``RunState``
    division: among which devices the runs are divided; R are those of one device
    calls_c: whether C MuJoCo computes the physics
    keep: (name, program) -> the program as it is kept on disk, which traces it; see ``kept``
    """

    begin: Callable[..., tuple[jax.Array, jax.Array]]
    advance: Callable[..., tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]]
    evaluate: Callable[..., dict[str, jax.Array]]
    advance_evaluates: bool
    like: RunState
    division: Division = ALONE
    calls_c: bool = False
    keep: Callable[[str, Callable[..., Any]], Callable[..., Any]] = lambda _, program: program

    def kept(self, name: str) -> Callable[..., Any]:
        """Returns a program as it is compiled: traced and written to disk now, if it is kept."""
        return self.keep(name, getattr(self, name))

    @property
    def state_bytes(self) -> int:
        """How many bytes the state of a run takes."""
        return StateRows(self.like).size


#: The metrics that say how far a run is, and which of its updates broke.
_PROGRESS_METRICS = ("active", "env_steps", "nonfinite_episodes", "skipped_update")


def _states_of_runs(build_learner: BuildLearner) -> Callable[..., RunState]:
    """Returns a function of a root, the seeds' numbers [R] and the settings [R] of runs."""

    def first_state(key: jax.Array, settings: dict[str, jax.Array]) -> TrainState:
        return build_learner(settings).init(key)

    # One program, whatever the seeds are: a program for each operation on keys takes longer.
    def states(seed: Seed, seed_numbers: jax.Array, settings: dict[str, jax.Array]) -> RunState:
        """Returns the states of R runs before their first update."""
        keys = seed_keys(seed, seed_numbers)
        return RunState(
            train_states=jax.vmap(first_state)(keys, settings),
            eval_keys=eval_keys(seed_numbers),
            settings=settings,
        )

    return states


def programs_of(
    env: Environment,
    build_learner: BuildLearner,
    horizon: int,
    training_horizon: int,
    config: Config,
    num_runs: int,
    traced: Collection[str] = (),
    *,
    all_metrics: bool = True,
    division: Division = ALONE,
) -> Programs:
    """Returns the programs of runs.

    Args:
      env: what is trained on.
      build_learner: called while the settings of one run are traced, and without any.
      horizon: T, the time limit of an episode in steps.
      training_horizon: that of a training episode.
      config: the settings, in which those that are traced stand for any value.
      num_runs: R, of the shapes; those of one device.
      traced: the names of the settings that differ from run to run.
      all_metrics: whether all is measured that ``metrics.csv`` has. Else evaluations play the
        policy's mode alone, and of the metrics those of ``_PROGRESS_METRICS`` are returned.
      division: among which devices the runs are divided.
    """
    learner = build_learner({})  # policies and engines are those of any
    # A launch has one horizon, and an evaluation plays to that of the environment.
    advance_evaluates = isinstance(learner.play, SharedLaunch) and training_horizon == horizon

    states = _states_of_runs(build_learner)

    def begin(seed: Seed, seed_numbers: jax.Array, settings: dict[str, jax.Array]) -> Any:
        rows = state_rows.traced_rows(states(seed, seed_numbers, settings))
        return rows, plain(last_test_keys(seed_numbers, config))

    evaluation_options: Any = {"num_episodes": config.eval_episodes, "sampled": all_metrics}
    make_evaluation = functools.partial(evaluation_episodes, **evaluation_options)
    play = functools.partial(evaluate, env, learner, horizon=horizon, **evaluation_options)

    def evaluate_rows(rows: jax.Array, is_evaluated: jax.Array) -> dict[str, jax.Array]:
        state = state_rows.traced_states(rows)
        return jax.vmap(play)(state.train_states.actor, state.eval_keys, active=is_evaluated)

    updates = block_of_updates(
        build_learner, config.block_length, make_evaluation if advance_evaluates else None
    )

    def advance(
        rows: jax.Array, budget: Sequence[jax.Array], occupied: jax.Array, evaluation_due: jax.Array
    ) -> Any:
        """Makes a block of updates of rows; those without a run are not ``occupied`` [R]."""
        old_states = _stop_empty(state_rows.traced_states(rows), occupied)
        new_states, (_, metrics, eval_metrics) = updates(
            old_states, Budget(*budget), occupied & evaluation_due
        )
        # A sweep records no more, and what is returned is fetched of each of its runs.
        if not all_metrics:
            metrics = {name: metrics[name] for name in _PROGRESS_METRICS}
        return state_rows.traced_rows(new_states), metrics, eval_metrics

    # The functions above read ``state_rows`` when they are traced, which is later.
    numbers = jax.ShapeDtypeStruct((num_runs,), np.uint32)
    settings = {name: jax.ShapeDtypeStruct((num_runs,), jnp.result_type(float)) for name in traced}
    state_shapes = jax.eval_shape(states, np.uint32(0), numbers, settings)
    state_rows = StateRows(state_shapes)
    calls_c = learner.engine.name == "mujoco"
    return Programs(
        begin, advance, evaluate_rows, advance_evaluates, state_shapes, division, calls_c
    )

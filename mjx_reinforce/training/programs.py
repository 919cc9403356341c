"""The programs that move runs on side by side: the seeds of a run, or what a sweep has in a slot.

``programs_of`` writes them once for both. ``compile_run`` compiles those of a run; a sweep compiles
them for slots, see ``sweeps.programs``.
"""

import functools
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Environment
from mjx_reinforce.engine.devices import NONE, RUNS, SECOND
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.settings.config import Config
from mjx_reinforce.training import state
from mjx_reinforce.training.block import (
    Block,
    BuildLearner,
    block_of_updates,
    evaluate,
    evaluation_episodes,
)
from mjx_reinforce.training.division import ALONE, Division
from mjx_reinforce.training.state import Budget, RunState, Seed
from mjx_reinforce.training.wrappers import EvaluationEpisodes, SharedLaunch


class Programs(NamedTuple):
    """The programs of R runs before they are compiled.

    What differs from sweep to sweep without another program is their input: seeds, budgets, and
    the settings that are traced.

    begin: (seed, the numbers [R] of the runs' seeds, settings [R] each) -> the first
      ``RunState``, and the keys [K, R] of the last test, which plays the episodes of K evaluations
    advance: (RunState, ``Budget``, whether to evaluate, [] or [R]) -> as ``block_of_updates``
    evaluate: (Actor [R, ...], keys [R], whether to, [R], all by default) -> what
      ``block.evaluate`` returns, [R] each
    rides: whether ``advance`` evaluates; else ``evaluate`` does, before it
    like: the shapes of a ``RunState``
    division: among which devices the runs are divided; R are those of one device
    """

    begin: Callable[..., tuple[RunState, jax.Array]]
    advance: Callable[[RunState, Budget, jax.Array], tuple[RunState, Block]]
    evaluate: Callable[..., dict[str, jax.Array]]
    rides: bool
    like: RunState
    division: Division = ALONE


class Looked(NamedTuple):
    """An evaluation of the policies of all seeds.

    actor: [S, ...] the policies
    num_updates: [S, 2] how many updates had made them
    measured: [S] each, what ``block.evaluate`` returns
    """

    actor: Actor
    num_updates: Any
    measured: Arrays


class RunPrograms(NamedTuple):
    """The compiled programs of a run, over all seeds at once.

    advance: (RunState, whether to evaluate it, ``Budget``) -> (RunState, metrics [K, S], ``Looked``
      or None), ``eval_every`` updates later, or where all budgets are used. The evaluation is that
      of the policies before these updates, and costs next to nothing where it rides with them. A
      seed whose budget is used earlier stands still. The memory of the argument is used again. To
      the metrics of ``Learner.step`` it adds ``active``, False for a seed that stood still
    evaluate: (RunState) -> ``Looked``, of its policies
    test: (Actor [S, ...]) -> the same on ``test_episodes`` start states (rounded up to whole
      evaluations) that nothing else is played on
    """

    advance: Callable[[RunState, bool, Budget], tuple[RunState, Arrays, Looked | None]]
    evaluate: Callable[[RunState], Looked]
    test: Callable[[Actor], Arrays]


def programs_of(
    env: Environment,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    num_runs: int,
    traced: Collection[str] = (),
    *,
    sampled: bool = True,
    division: Division = ALONE,
) -> Programs:
    """Returns the programs of runs.

    Args:
      env: what is trained on.
      build_learner: called while the settings of one run are traced, and without any.
      horizon: T, the time limit of an episode in steps.
      config: the settings, in which those that are traced stand for any value.
      num_runs: R, of the shapes; those of one device.
      traced: the names of the settings that differ from run to run.
      sampled: as for ``block.evaluate``.
      division: among which devices the runs are divided.
    """
    learner = build_learner({})  # policies and engines are those of any
    rides = isinstance(learner.play, SharedLaunch) and config.training_horizon(horizon) == horizon

    def first(key: jax.Array, settings: dict[str, jax.Array]) -> TrainState:
        return build_learner(settings).init(key)

    # One program, whatever the seeds are: a program for each operation on keys takes longer.
    def begin(
        seed: Seed, numbers: jax.Array, settings: dict[str, jax.Array]
    ) -> tuple[RunState, jax.Array]:
        keys = state.seed_keys(seed, numbers)
        states = RunState(
            train_states=jax.vmap(first)(keys, settings),
            eval_keys=state.eval_keys(numbers),
            settings=settings,
        )
        return states, state.last_test_keys(numbers, config)

    def visit(key: jax.Array, active: jax.Array) -> EvaluationEpisodes:
        return evaluation_episodes(
            key, num_episodes=config.eval_episodes, active=active, sampled=sampled
        )

    def look(actor: Actor, key: jax.Array, active: bool | jax.Array = True) -> dict[str, jax.Array]:
        size = {"num_episodes": config.eval_episodes, "horizon": horizon}
        return evaluate(env, learner, actor, key, **size, active=active, sampled=sampled)

    numbers = jax.ShapeDtypeStruct((num_runs,), np.uint32)
    settings = {name: jax.ShapeDtypeStruct((num_runs,), jnp.result_type(float)) for name in traced}
    return Programs(
        begin=begin,
        advance=block_of_updates(build_learner, config.block_length, visit if rides else None),
        evaluate=jax.vmap(look),
        rides=rides,
        like=jax.eval_shape(begin, np.uint32(0), numbers, settings)[0],
        division=division,
    )


def compiling(pool: ThreadPoolExecutor, *programs: tuple[Any, Sequence[Any]]) -> list[Future]:
    """Traces functions of ``jax.jit`` on their arguments; each is compiled while the next is."""
    return [pool.submit(program.lower(*given).compile) for program, given in programs]


def compile_run(
    programs: Programs,
    config: Config,
    meanwhile: Callable[[], object] = lambda: None,
) -> tuple[RunState, RunPrograms]:
    """Returns the state before the first update, and the compiled programs of a run.

    Args:
      programs: of the run.
      config: its settings.
      meanwhile: begins other work in Python; called once the rest of the time is XLA's.
    """
    division, num_seeds = programs.division, config.num_seeds
    numbers = config.first_seed + np.arange(num_seeds, dtype=np.uint32)
    place, view = division.place, functools.partial(division.view, num_seeds=num_seeds)
    like = division.shapes(programs.like, num_seeds)

    def advance(before: RunState, budget: Budget, look: jax.Array) -> Any:
        after, block = programs.advance(before, budget, look)
        return after, block.made[None], block.metrics, (_present(before), block.looked)

    beginning = division.jit(programs.begin, (NONE, RUNS, NONE), (RUNS, SECOND))
    evaluating = division.jit(programs.evaluate, (RUNS, RUNS), RUNS)
    results = RUNS, RUNS, SECOND, RUNS
    advancing = division.jit(
        advance, (RUNS, NONE, NONE), results, by_episodes=True, donate_argnums=0
    )
    seed = place(np.uint32(config.seed), NONE)
    nothing = place((Budget.of(0, 0), np.bool_(False)), NONE)
    with ThreadPoolExecutor() as pool:
        begun = pool.submit(beginning, seed, place(numbers), {})
        evaluating, advancing = compiling(
            pool,
            (evaluating, (like.train_states.actor, like.eval_keys)),
            (advancing, (like, *nothing)),
        )
        meanwhile()
        advancing, evaluating = advancing.result(), evaluating.result()
        first, test_keys = begun.result()
    # No update: a GPU's driver translates a program's kernel, also the evaluation's, at first use.
    first = view(jax.block_until_ready(advancing(first, *nothing)[0]))

    def advanced(
        before: RunState, look: bool, budget: Budget
    ) -> tuple[RunState, Arrays, Looked | None]:
        before = place(before)
        looked = evaluated(before) if look and not programs.rides else None
        after, made, metrics, seen = advancing(before, *place((budget, np.bool_(look)), NONE))
        made, metrics = jax.device_get((made, metrics))
        metrics = {name: x[: made.max(), :num_seeds] for name, x in metrics.items()}
        if look and programs.rides:
            looked = _on_host(num_seeds, *seen)
        return view(after), metrics, looked

    def evaluated(states: RunState) -> Looked:
        states = place(states)
        measured = evaluating(states.train_states.actor, states.eval_keys)
        return _on_host(num_seeds, _present(states), measured)

    def tested(actor: Actor) -> Arrays:
        placed = place(actor)
        keys = map(jax.random.wrap_key_data, jax.device_get(jax.random.key_data(test_keys)))
        every = jax.device_get([evaluating(placed, place(each)) for each in keys])
        return {name: x[:num_seeds] for name, x in _joined(every).items()}

    return first, RunPrograms(advanced, evaluated, tested)


def _joined(evaluations: Sequence[Arrays]) -> Arrays:
    """Returns what an evaluation of all episodes of several would have returned, [S] each."""
    return {
        name: (np.sum if name.endswith("steps") else np.mean)(
            [x[name] for x in evaluations], axis=0
        )
        for name in evaluations[0]
    }


def _present(states: RunState) -> tuple[Actor, jax.Array]:
    """Returns the present policies, and how many updates made them."""
    return states.train_states.actor, states.train_states.num_updates


def _on_host(
    num_seeds: int, policies: tuple[Actor, jax.Array], measured: dict[str, jax.Array]
) -> Looked:
    """Returns an evaluation without what stands where there is no seed."""
    seen = jax.tree.map(lambda x: x[:num_seeds], jax.device_get((*policies, measured)))
    return Looked(*seen)

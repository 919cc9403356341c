"""A run in progress: the state of all its seeds, and the compiled programs that move it on."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax

from mjx_reinforce.files import Arrays
from mjx_reinforce.learners import counts
from mjx_reinforce.learners.learner import Guests, Host, Learner, TrainState
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training.evaluation import evaluate, guests_of, measure
from mjx_reinforce.types import Environment, PyTree, plain, with_keys

#: A root of randomness; traced inside of programs.
Seed = int | np.uint32 | jax.Array
#: Returns the learner of settings that may be traced, of one seed each.
BuildLearner = Callable[[dict[str, jax.Array]], Learner]


@struct.dataclass(kw_only=True)
class RunState:
    """All that a run needs to go on.

    train_states: [S, ...] the ``TrainState`` of every seed
    eval_keys: [S] the key of each seed's evaluations, from which its start states are drawn
    settings: [S] each, settings that differ from seed to seed; none where all seeds have the same
    """

    train_states: TrainState
    eval_keys: jax.Array
    settings: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


class Budget(NamedTuple):
    """What each seed may use. It is an input of the programs: another budget compiles nothing.

    env_steps: [2] a count, see ``counts``; a seed stops after the update that reaches it
    updates: [2] a count, how many updates it makes at most
    all_env_steps: [2] how long schedules last; more than ``env_steps`` where a run goes on later
    all_updates: [2] the same in updates
    """

    env_steps: counts.Count
    updates: counts.Count
    all_env_steps: counts.Count
    all_updates: counts.Count

    @classmethod
    def of(cls, env_steps: int | None, updates: int | None) -> "Budget":
        """Returns a budget, of which what has no limit has the greatest count."""
        limits = [counts.from_int(MAX_COUNT if x is None else x) for x in (env_steps, updates)]
        return cls(*limits, *limits)


class Parts(NamedTuple):
    """The programs of a run before they are compiled, on lists of the leaves of states.

    Keys are data in them, so that they may be kept on disk, see ``kept``. Each part is a function
    without arguments that returns its program: tracing takes time, and is done when it is needed.

    like: the shapes of a ``RunState``
    start: (seed, eval_seed) -> the first state's leaves, and the data of the keys [K, S] of the
      last test, which plays the episodes of K evaluations
    advance: (leaves, what ``Budget`` has, whether to evaluate []) -> as
      ``block_of_updates``, with the leaves of states and of actors
    look: (leaves of the actors, data of the keys [S]) -> as ``evaluation``
    rides: whether ``advance`` evaluates; else ``look`` does, before it
    """

    like: RunState
    start: Callable[[], Callable[..., Any]]
    advance: Callable[[], Callable[..., Any]]
    look: Callable[[], Callable[..., Any]]
    rides: bool


class Looked(NamedTuple):
    """An evaluation of the policies of all seeds.

    actor: [S, ...] the policies
    num_updates: [S, 2] how many updates had made them
    measured: [S] each, what ``evaluation.evaluate`` returns
    """

    actor: Actor
    num_updates: Any
    measured: Arrays


class Programs(NamedTuple):
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


def seed_keys(config: Config) -> jax.Array:
    """Returns the keys [S] that the seeds of a run begin with."""
    return _seed_keys(config.seed, config.num_seeds)


def _seed_keys(seed: Seed, num_seeds: int) -> jax.Array:
    return jax.random.split(_key(seed, domain=0), num_seeds)


def beginning(build_learner: BuildLearner) -> Callable[..., RunState]:
    """Returns a function to the state before the first update.

    It takes the keys [S] of the seeds, those of their evaluations [S], and the settings [S] that
    differ between the seeds.

    Args:
      build_learner: called while the settings of one seed are traced.
    """

    def init(key: jax.Array, settings: dict[str, jax.Array]) -> TrainState:
        return build_learner(settings).init(key)

    def begin(keys: jax.Array, eval_keys: jax.Array, settings: dict[str, jax.Array]) -> RunState:
        return RunState(
            train_states=jax.vmap(init)(keys, settings),
            eval_keys=eval_keys,
            settings=settings,
        )

    return begin


def parts_of(
    env: Environment,
    learner: Learner,
    horizon: int,
    config: Config,
    share: slice = slice(None),
) -> Parts:
    """Returns the programs of a run.

    Args:
      env: what is trained on.
      learner: how.
      horizon: T, the time limit of an episode in steps.
      config: the settings of the run.
      share: which of its seeds the programs are for; all by default.
    """

    # One program, whatever the seeds are: a program for each operation on keys takes longer.
    def first(seed: Seed, eval_seed: Seed) -> tuple[RunState, jax.Array]:
        roots = _seed_keys(seed, config.num_seeds), _eval_keys(eval_seed, config.num_seeds)
        state = beginning(lambda _: learner)(*(keys[share] for keys in roots), {})
        return state, _test_keys(eval_seed, config)[:, share]

    rides = isinstance(learner.play, Host)
    visit = evaluation_guests(config) if rides else None
    updates = block_of_updates(lambda _: learner, config.block_length, visit)
    evaluate = evaluation(env, learner, horizon, config)
    like = jax.eval_shape(first, np.uint32(0), np.uint32(0))[0]

    def start(seed: Seed, eval_seed: Seed) -> Any:
        state, test_keys = plain(first(seed, eval_seed))
        return jax.tree.leaves(state), test_keys

    def advance(leaves: list[jax.Array], budget: Sequence[jax.Array], look: jax.Array) -> Any:
        before = restored(leaves, like)
        state, block = updates(before, Budget(*budget), look)
        present = before.train_states.actor, before.train_states.num_updates
        return jax.tree.leaves(plain(state)), tuple(block), jax.tree.leaves(present)

    def look(leaves: list[jax.Array], keys: jax.Array) -> dict[str, jax.Array]:
        actor = restored(leaves, like.train_states.actor)
        return evaluate(actor, jax.random.wrap_key_data(keys))

    return Parts(like, lambda: start, lambda: advance, lambda: look, rides)


def compile_parts(
    parts: Parts, config: Config, meanwhile: Callable[[], object] = lambda: None
) -> tuple[RunState, Programs]:
    """Returns the state before the first update, and the compiled programs of a run.

    Args:
      parts: of the run.
      config: its settings.
      meanwhile: begins other work in Python; called once the rest of the time is XLA's.
    """
    like, budget = parts.like, budget_of(config)

    def start(*seeds: Seed) -> tuple[RunState, jax.Array]:
        leaves, test_keys = parts.start()(*seeds)
        return restored(leaves, like), test_keys

    def advance(state: RunState, budget: Budget, look: jax.Array) -> Any:
        leaves, block, present = parts.advance()(jax.tree.leaves(plain(state)), tuple(budget), look)
        return restored(leaves, like), Block(*block), present

    def look(actor: Actor, keys: jax.Array) -> dict[str, jax.Array]:
        return parts.look()(jax.tree.leaves(actor), keys)

    seeds, keys = (np.uint32(config.seed), np.uint32(config.eval_seed)), eval_keys_shape(like)
    with ThreadPoolExecutor() as pool:  # one compiles while the next is traced
        starting = pool.submit(jax.jit(start), *seeds)
        looking = pool.submit(jax.jit(look).lower(like.train_states.actor, keys).compile)
        traced = jax.jit(advance, donate_argnums=0).lower(like, budget, np.bool_(False))
        meanwhile()
        advancing = traced.compile()
        compiled, (first, test_keys) = looking.result(), starting.result()
    # No update: a GPU's driver translates a program's kernel, also the evaluation's, at first use.
    nothing = Budget.of(0, 0)
    first = jax.block_until_ready(advancing(first, nothing, np.bool_(False))[0])

    def advanced(
        state: RunState, look: bool, budget: Budget
    ) -> tuple[RunState, Arrays, Looked | None]:
        before = evaluated(state) if look and not parts.rides else None
        state, block, present = advancing(state, budget, np.bool_(look))
        metrics = {name: x[: int(block.made)] for name, x in to_numpy(block.metrics).items()}
        if look and parts.rides:
            *actor, num_updates = jax.device_get(present)
            actor = jax.tree.unflatten(jax.tree.structure(like.train_states.actor), actor)
            before = Looked(actor, num_updates, to_numpy(block.looked))
        return state, metrics, before

    def evaluated(state: RunState) -> Looked:
        measured = compiled(state.train_states.actor, jax.random.key_data(state.eval_keys))
        present = state.train_states.actor, state.train_states.num_updates
        actor, num_updates = jax.device_get(present)
        return Looked(actor, num_updates, to_numpy(measured))

    def tested(actor: Actor) -> Arrays:
        return joined_evaluations(
            [to_numpy(compiled(actor, keys)) for keys in np.asarray(test_keys)]
        )

    return first, Programs(advanced, evaluated, tested)


def restored(leaves: Sequence[jax.Array | np.ndarray], like: PyTree) -> Any:
    """Returns a pytree like another of plain leaves; its keys are keys again."""
    return with_keys(jax.tree.unflatten(jax.tree.structure(like), leaves), like)


def _key(seed: Seed, domain: int) -> jax.Array:
    """Returns the root of the keys of training (domain 0), evaluation (1), or the last test (2).

    The domains share no key, whatever seeds the user chooses.
    """
    return jax.random.fold_in(jax.random.key(seed), domain)


def eval_keys_shape(like: RunState) -> jax.ShapeDtypeStruct:
    """Returns the shape of the data of the keys of evaluations."""
    return jax.eval_shape(plain, like.eval_keys)


def eval_keys(config: Config) -> jax.Array:
    """Returns the keys [S] of every evaluation but the last test."""
    return _eval_keys(config.eval_seed, config.num_seeds)


def _eval_keys(eval_seed: Seed, num_seeds: int) -> jax.Array:
    return _for_each_seed(_key(eval_seed, domain=1), num_seeds)


def _test_keys(eval_seed: Seed, config: Config) -> jax.Array:
    """Returns the keys [K, S] of the last test, which plays the episodes of K evaluations."""
    rounds = -(-(config.test_episodes or config.eval_episodes) // config.eval_episodes)
    keys = jax.random.split(_key(eval_seed, domain=2), rounds)
    return jax.vmap(lambda key: _for_each_seed(key, config.num_seeds))(keys)


def _for_each_seed(key: jax.Array, num_seeds: int) -> jax.Array:
    """Returns keys [S], each by the seed's number alone, however many seeds there are.

    Start states shared by all seeds would be a chance that no interval over seeds knows of.
    """
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(num_seeds))


def budget_of(config: Config) -> Budget:
    """Returns the budget; what has no limit has the greatest count."""
    return Budget.of(config.env_steps, config.max_updates)


class Block(NamedTuple):
    """What a block of updates measured.

    made: [] how many updates were made
    metrics: [length, S] each; the rows after the last update are zero
    looked: [S] each, what ``evaluation.measure`` returns of the policies before the first update;
      empty where the evaluation does not ride with it
    """

    made: jax.Array
    metrics: dict[str, jax.Array]
    looked: dict[str, jax.Array]


def block_of_updates(
    build_learner: BuildLearner, length: int, visit: Callable[..., Guests] | None
) -> Callable[..., tuple[RunState, Block]]:
    """Returns a function that makes ``length`` updates of all seeds, or fewer if that is the end.

    It takes a ``RunState``, a ``Budget``, and whether to evaluate the policies before the first
    update, [] or [S]. Its result is the state, and a ``Block``.

    Args:
      build_learner: called while the settings of one seed are traced.
      length: rows of the metrics.
      visit: (key of an evaluation [], whether it is made []) -> its episodes, which are played in
        one go with those of the first update; None where learners cannot.
    """

    def active(state: RunState, budget: Budget) -> jax.Array:
        used = counts.reached(state.train_states.env_steps, budget.env_steps)
        return ~(used | counts.reached(state.train_states.num_updates, budget.updates))

    def progress(state: RunState, budget: Budget) -> jax.Array:
        """Returns the share [S] of its whole budget that each seed has used."""
        env_steps = counts.as_float(state.train_states.env_steps)
        updates = counts.as_float(state.train_states.num_updates)
        # No seed goes on whose budget is nothing.
        limits = (counts.as_float(x) for x in (budget.all_env_steps, budget.all_updates))
        one, other = (jnp.maximum(limit, 1.0) for limit in limits)
        return jnp.minimum(jnp.maximum(env_steps / one, updates / other), 1.0)

    def step(
        state: TrainState,
        settings: dict[str, jax.Array],
        going: jax.Array,
        eval_key: jax.Array,
        look: jax.Array,
    ) -> Any:
        guests = None if visit is None else visit(eval_key, look)
        state, metrics, played = build_learner(settings).step_with(state, going, guests)
        looked = {} if guests is None or played is None else measure(played, guests)
        return state, metrics | {"active": going}, looked

    @functools.partial(jax.jit, inline=True)  # traced once, for its shapes and for the loop
    def update(state: RunState, budget: Budget, look: jax.Array) -> Any:
        before = dataclasses.replace(state.train_states, progress=progress(state, budget))
        going, looks = active(state, budget), jnp.broadcast_to(look, len(state.eval_keys))
        train_states, metrics, looked = jax.vmap(step)(
            before, state.settings, going, state.eval_keys, looks
        )
        return dataclasses.replace(state, train_states=train_states), metrics, looked

    def advance(state: RunState, budget: Budget, look: jax.Array) -> tuple[RunState, Block]:
        def unfinished(carry: tuple[RunState, Block]) -> jax.Array:
            state, block = carry
            return (block.made < length) & jnp.any(active(state, budget))

        def body(carry: tuple[RunState, Block]) -> tuple[RunState, Block]:
            state, (made, rows, looked) = carry
            state, row, now = update(state, budget, look & (made == 0))
            write = functools.partial(lax.dynamic_update_index_in_dim, index=made, axis=0)
            looked = jax.tree.map(lambda x, old: jnp.where(made == 0, x, old), now, looked)
            return state, Block(made + 1, jax.tree.map(write, rows, row), looked)

        _, row, looked = jax.eval_shape(update, state, budget, look)
        zeros = functools.partial(jax.tree.map, lambda x: jnp.zeros(x.shape, x.dtype))
        rows = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), row)
        return lax.while_loop(unfinished, body, (state, Block(jnp.int32(0), rows, zeros(looked))))

    return advance


def evaluation_guests(config: Config, *, sampled: bool = True) -> Callable[..., Guests]:
    """Returns (key [], whether it is made []) -> the episodes of an evaluation."""

    def visit(key: jax.Array, active: jax.Array) -> Guests:
        return guests_of(key, num_episodes=config.eval_episodes, active=active, sampled=sampled)

    return visit


def evaluation(
    env: Environment, learner: Learner, horizon: int, config: Config, *, sampled: bool = True
) -> Any:
    """Returns a function that evaluates actors [S, ...] with keys [S].

    It also takes which of them are evaluated [S]; all by default. ``sampled`` is that of
    ``evaluation.evaluate``.
    """

    def one(actor: Actor, key: jax.Array, active: bool | jax.Array = True) -> dict[str, jax.Array]:
        size = {"num_episodes": config.eval_episodes, "horizon": horizon}
        return evaluate(env, learner, actor, key, **size, active=active, sampled=sampled)

    return jax.vmap(one)


def joined_evaluations(evaluations: Sequence[Arrays]) -> Arrays:
    """Returns what an evaluation of all episodes of several would have returned, [S] each."""
    return {
        name: (np.sum if name.endswith("steps") else np.mean)(
            [x[name] for x in evaluations], axis=0
        )
        for name in evaluations[0]
    }


def to_numpy(tree: dict[str, jax.Array]) -> Arrays:
    """Returns arrays on the host; waits for them."""
    return {name: np.asarray(value) for name, value in jax.device_get(tree).items()}

"""The compiled programs of a group: those of a run, for slots of runs on all devices."""

import functools
import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.runs.blocks import block_length
from mjx_reinforce.runs.config import Config
from mjx_reinforce.runs.keys import plain, with_keys
from mjx_reinforce.runs.memory import num_cores
from mjx_reinforce.runs.packing import join, pack, put_back, spread, take, training
from mjx_reinforce.runs.record import COUNTED
from mjx_reinforce.runs.state import (
    Arrays,
    Budget,
    BuildLearner,
    RunState,
    beginning,
    block_of_updates,
    budget_of,
    evaluation,
    evaluation_key,
    seed_keys,
)
from mjx_reinforce.sweeps.ahead import started
from mjx_reinforce.sweeps.devices import NONE, RUNS, SECOND, Devices


class Movers(NamedTuple):
    """What moves the runs of one slot on. States have the data of keys in their place.

    block: (states [W], budget) -> (states [W], ``record.COUNTED`` metrics [K, W], whether each run
      made an update [W]), as ``state.block_of_updates``
    look: (states [W], which [W]) -> evaluation [W] of the present policies of these runs
    """

    block: Callable[[RunState, Budget], tuple[RunState, dict[str, jax.Array], jax.Array]]
    look: Callable[[RunState, jax.Array], dict[str, jax.Array]]


class Programs(NamedTuple):
    """The compiled programs of a group. States of runs [R] are on the host between them.

    begin: (data of keys [R, 2], settings [R] each) -> the first states
    movers: by the width of a slot; the narrower ones may still be compiling
    keys: [S, 2], the data of those that the seeds begin with
    budget: of each run
    limits: the budget on all devices
    devices: among which a slot is divided
    shape_of: the shapes of the states of so many runs
    """

    begin: Callable[..., RunState]
    movers: dict[int, "Future[Movers]"]
    keys: np.ndarray
    budget: Budget
    limits: Budget
    devices: Devices
    shape_of: Callable[[int], RunState]

    def of(self, config: Config) -> "Programs":
        """Returns the same programs for settings with another budget or another seed."""
        return self._replace(**_inputs(config, self.devices))

    def advance(
        self, states: RunState, lengths: np.ndarray
    ) -> tuple[RunState, Arrays, Arrays, np.ndarray]:
        """Makes a block of updates of the runs that still train, and evaluates them.

        Args:
          states: [R] of all runs, at least one of which still trains.
          lengths: [R] about how long their episodes are, see ``packing.pack``.

        Returns:
          The states, the ``record.COUNTED`` metrics [K, R] as ``state.Programs.advance`` returns
          them, the evaluation [R], and which runs were evaluated [R]: those that made an update.
        """
        chosen = training(states, self.budget)
        lanes, movers = self._pack(chosen, lengths)

        def move(runs: np.ndarray) -> Any:
            slot, metrics, moved = movers.block(self._put(take(states, runs)), self.limits)
            looked = movers.look(slot, moved)  # begun before the host waits for the block
            return jax.device_get((slot, metrics, looked))

        slots, rows, looked = zip(*_side_by_side(move, lanes), strict=True)
        metrics = spread(len(chosen), lanes, rows)
        states = put_back(states, lanes, slots)
        counts = {"updates_total": states.train_states.num_updates}
        counts["env_steps_total"] = states.env_steps
        for name, count in counts.items():  # of a run that stands still too
            metrics[name] = np.where(metrics["active"], metrics[name], count)
        made = int(metrics["active"].any(axis=1).sum())
        metrics = {name: x[:made] for name, x in metrics.items()}
        return states, metrics, spread(len(chosen), lanes, looked), chosen

    def evaluate(self, states: RunState) -> Arrays:
        """Evaluates the present policies of all runs [R]."""
        every = np.ones(len(states.env_steps), bool)
        lanes, movers = self._pack(every, np.zeros(len(every)))

        def look(runs: np.ndarray) -> Any:
            slot = self._put(take(states, runs))
            return jax.device_get(movers.look(slot, self._put(runs >= 0)))

        return spread(len(every), lanes, _side_by_side(look, lanes))

    def _pack(self, chosen: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, Movers]:
        """Returns the runs of each slot, and what moves them."""
        lanes = pack(chosen, lengths, list(self.movers), self.devices.count)
        return lanes, self.movers[lanes.shape[1]].result()

    def _put(self, slot: Any) -> Any:
        return self.devices.put(slot, RUNS)


def _side_by_side(move: Callable[[np.ndarray], Any], lanes: np.ndarray) -> list[Any]:
    """Returns the results for all slots [slots, width], as many at once as there are cores.

    A slot alone leaves a part of the cores waiting for each other, and its results are fetched
    while the next one is moved.
    """
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(pool.map(move, lanes))


def compile_programs(
    env: Any,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    traced: Collection[str],
    widths: Sequence[int],
    devices: Devices,
) -> Programs:
    """Compiles the programs of a group for the widest slot, and begins with the narrower ones.

    These are traced while the widest are compiled: a sweep of some seconds soon needs them.

    Args:
      env: what is trained on.
      build_learner: from the traced settings of a run to its learner.
      horizon: T, the time limit of an episode in steps.
      config: the settings, in which those that are traced stand for any value.
      traced: the names of those that are.
      widths: how many runs a slot may have, the most first; multiples of the number of devices.
      devices: where.
    """
    compile_for = functools.partial(_movers, env, build_learner, horizon, config, traced, devices)
    compile_for = functools.partial(compile_for, threading.Lock())
    movers = {width: started(functools.partial(compile_for, width)) for width in widths}
    begin = started(functools.partial(_begin, build_learner, traced, widths[0], devices))
    inputs = started(functools.partial(_inputs, config, devices))
    movers[widths[0]].result()
    return Programs(
        begin=begin.result(),
        movers=movers,
        devices=devices,
        shape_of=functools.partial(shape_of_states, build_learner, traced),
        **inputs.result(),
    )


def _inputs(config: Config, devices: Devices) -> dict[str, Any]:
    """Returns what is no part of a program, as ``Programs`` has it."""
    keys, budget = jax.random.key_data(seed_keys(config)), budget_of(config)
    keys, limits = jax.device_get(keys), devices.put(budget, NONE)
    return {"keys": keys, "budget": jax.device_get(budget), "limits": limits}


def shape_of_states(
    build_learner: BuildLearner, traced: Collection[str], num_runs: int
) -> RunState:
    """Returns the shapes of the states of so many runs, with the data of keys in their place."""
    return jax.eval_shape(
        lambda *arguments: plain(beginning(build_learner)(*arguments)),
        *_arguments(traced, num_runs),
    )


def _arguments(traced: Collection[str], width: int) -> tuple[Any, dict[str, jax.Array]]:
    """Returns the shapes of the arguments of ``beginning``."""
    zeros = {name: jnp.zeros(width) for name in traced}
    return jax.eval_shape(lambda: (jax.random.split(jax.random.key(0), width), zeros))


def _begin(
    build_learner: BuildLearner, traced: Collection[str], width: int, devices: Devices
) -> Callable[..., RunState]:
    """Compiles ``Programs.begin``, which begins ``width`` runs at once."""

    def first(keys: jax.Array, settings: Any) -> RunState:
        return plain(beginning(build_learner)(jax.random.wrap_key_data(keys), settings))

    shapes = devices.shapes(jax.eval_shape(plain, _arguments(traced, width)), RUNS)
    compiled = devices.jit(first, (RUNS, RUNS), RUNS).lower(*shapes).compile()

    def begin(keys: np.ndarray, settings: Arrays) -> RunState:
        count = len(keys)
        slots = []
        for start in range(0, count, width):
            index = np.minimum(np.arange(start, start + width), count - 1)
            values = {
                name: np.asarray(x[index], shapes[1][name].dtype) for name, x in settings.items()
            }
            slots.append(compiled(*devices.put((keys[index], values), RUNS)))
        return join(jax.device_get(slots), count)

    return begin


def _movers(
    env: Any,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    traced: Collection[str],
    devices: Devices,
    tracing: threading.Lock,
    width: int,
) -> Movers:
    """Compiles what moves slots of ``width`` runs; the arguments are ``compile_programs``'.

    Programs are traced one after the other, by whoever holds ``tracing``.
    """
    with ThreadPoolExecutor() as pool, tracing:  # the first compiles while the second is traced
        like = jax.eval_shape(beginning(build_learner), *_arguments(traced, width))
        updates = block_of_updates(build_learner, block_length(config))

        def block(states: RunState, budget: Budget) -> Any:
            before = states.train_states.num_updates
            after, (_, metrics) = updates(with_keys(states, like), budget)
            counted = {name: metrics[name] for name in COUNTED}
            return plain(after), counted, after.train_states.num_updates > before

        # Policies and engines are those of any of its learners.
        look = evaluation(env, build_learner({}), horizon, config, sampled=False)
        key, budget = devices.put((evaluation_key(config), budget_of(config)), NONE)
        shapes = devices.shapes(jax.eval_shape(plain, like), RUNS)
        which = devices.shapes(jax.ShapeDtypeStruct((width,), bool), RUNS)
        advance = devices.jit(block, (RUNS, NONE), (RUNS, SECOND, RUNS))
        look = devices.jit(look, (RUNS, NONE, RUNS), RUNS)
        looking = pool.submit(look.lower(shapes.train_states.actor, key, which).compile)
        advancing = pool.submit(advance.lower(shapes, budget).compile)
    looked, advanced = looking.result(), advancing.result()
    return Movers(advanced, lambda states, which: looked(states.train_states.actor, key, which))

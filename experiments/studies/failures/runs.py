"""Trains many seeds of one setting, and measures after every update what may make a seed fail."""

import dataclasses
import math
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjx_reinforce import envs
from mjx_reinforce.learners.diagnostics import Visited, visited_steps
from mjx_reinforce.learners.estimators import leave_one_out, standardize
from mjx_reinforce.learners.learner import Learner, TrainState
from mjx_reinforce.learners.reinforce import reinforce
from mjx_reinforce.learners.schedules import decay_rate
from mjx_reinforce.learners.updates import clip_by_norm
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.distributions.normal import normal
from mjx_reinforce.policies.policy import mlp_policy
from mjx_reinforce.training.evaluation import evaluate
from mjx_reinforce.types import Trajectory, action_space

#: Root of all randomness; no figure elsewhere in this repository uses it.
SEED = 20_261_123
#: Return at which the task is solved, and the greatest one.
SOLVED, TOP = 950.0, 1000.0
#: A seed ends with its env steps, or after so many updates, if its episodes stay short.
ENV_STEPS, MAX_UPDATES = 120_000, 120
#: A tanh unit beyond this is saturated: its slope is below 2 % of that at 0.
_SATURATED = 0.99
#: The rail ends at 1 m; a fall with the cart beyond this is one at the end of the rail (m).
_RAIL_END = 0.9
#: Forces are cut to this, in the action's unit.
_MAX_FORCE = 3.0
#: Episodes without noise after every update, and with and without noise at the end.
_EPISODES, _LAST_EPISODES = 4, 32
#: Where so small a part of the seeds still trains, they go on in a smaller program.
_FEW = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What differs between the arms; numbers in the units of ``--help``, inf where there is none.

    ``momentum`` is Adam's b1, the share of the mean gradient that stays from update to update;
    ``clip`` bounds scaled observations; ``least_position_scale`` (m) bounds from below what the
    cart's position is divided by.
    """

    learning_rate: float = 1e-2
    final_learning_rate: float = 1e-3
    decay_updates: float = 100
    decay_steps: float = math.inf
    momentum: float = 0.9
    max_kl: float = math.inf
    max_grad_norm: float = 1.0
    discount: float = 0.99
    standardize_floor: float = 10.0
    initial_std: float = 0.5
    normalize_steps: float = 1000
    least_position_scale: float = 0.0
    clip: float = normalize.CLIP
    num_episodes: int = 16
    hidden_sizes: tuple[int, ...] = (32, 32)
    env_steps: int = ENV_STEPS
    max_updates: int = MAX_UPDATES


#: What a program is compiled for; all else is an input of it.
_COMPILED = ("num_episodes", "hidden_sizes", "clip", "env_steps", "max_updates")


class Measured(NamedTuple):
    """What S seeds did.

    updates: [U, S] each, NaN from where a seed had used its budget on
    final_return: [S] mean return without noise, of the last policies
    final_sampled: [S] the same with noise
    """

    updates: dict[str, np.ndarray]
    final_return: np.ndarray
    final_sampled: np.ndarray


def train(setting: Setting, seeds: range) -> Measured:
    """Trains seeds of a setting.

    Args:
      setting: of all of them.
      seeds: their numbers.
    """
    with mock.patch.object(normalize, "CLIP", setting.clip):
        return _train(setting, seeds)


def _train(setting: Setting, seeds: range) -> Measured:
    env = envs.make("InvertedPendulum-v5")
    compiled = {name: getattr(setting, name) for name in _COMPILED}
    values = {k: float(v) for k, v in dataclasses.asdict(setting).items() if k not in compiled}
    plain = _learner(env, Setting(**compiled), len(seeds))

    def learner_of(values: dict[str, Any]) -> Learner:
        traced = _learner(env, Setting(**compiled, **values), len(seeds), engine="vmap")
        learner = plain._replace(init=traced.init, learn=traced.learn)
        return learner._replace(learn=_watched(learner, values["least_position_scale"]))

    def step(state: TrainState, going: jax.Array, values: Any, key: jax.Array) -> Any:
        learner = learner_of(values)
        state, metrics = learner.step(state, going)
        size = {"num_episodes": _EPISODES, "horizon": env.max_episode_steps}
        played = evaluate(env, learner, state.actor, key, **size, active=going, sampled=False)
        return state, metrics | {"eval_return": played["eval_return"]}

    def last(actor: Any, key: jax.Array) -> Any:
        horizon = env.max_episode_steps
        return evaluate(env, plain, actor, key, num_episodes=_LAST_EPISODES, horizon=horizon)

    root = jax.random.key(SEED)
    keys = jax.random.split(jax.random.fold_in(root, 0), seeds.stop)[seeds.start :]
    eval_key, last_key = jax.random.split(jax.random.fold_in(root, 1))
    begin = jax.jit(jax.vmap(lambda key, values: learner_of(values).init(key), in_axes=(0, None)))
    advance = jax.jit(jax.vmap(step, in_axes=(0, 0, None, None)))
    rows, actors = _until_done(
        setting,
        begin(keys, values),
        lambda states, going: advance(states, going, values, eval_key),
    )
    ended = jax.device_get(jax.jit(jax.vmap(last, in_axes=(0, None)))(actors, last_key))
    return Measured(rows, ended["eval_return"], ended["eval_return_stochastic"])


def _until_done(
    setting: Setting, states: TrainState, advance: Any
) -> tuple[dict[str, np.ndarray], Any]:
    """Returns the metrics [U, S] of all updates, and the last actors [S]."""
    actors = jax.tree.map(np.array, jax.device_get(states.actor))
    num_seeds = len(actors.normalizer.count)
    who, steps, rows = np.arange(num_seeds), np.zeros(num_seeds), []

    def keep(states):
        for kept, new in zip(
            jax.tree.leaves(actors), jax.tree.leaves(jax.device_get(states.actor)), strict=True
        ):
            kept[who] = new

    while len(rows) < setting.max_updates and (steps < setting.env_steps).any():
        if len(who) == num_seeds and (steps < setting.env_steps).sum() <= num_seeds // _FEW:
            keep(states)
            who = np.argsort(steps, kind="stable")[: num_seeds // _FEW]
            states = jax.tree.map(lambda x, few=who: x[few], states)
        going = steps[who] < setting.env_steps
        states, metrics = advance(states, going)
        metrics = jax.device_get(metrics)
        row = {name: np.full(num_seeds, np.nan, np.float32) for name in metrics}
        for name, values in metrics.items():
            row[name][who[going]] = values[going]
        rows.append(row)
        steps[who[going]] += metrics["env_steps"][going]
    keep(states)
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}, actors


def _learner(env: Any, setting: Setting, num_seeds: int, engine: str = "auto") -> Learner:
    """Returns REINFORCE with these settings, numbers of which may be traced."""
    rate, final = setting.learning_rate, setting.final_learning_rate

    def schedule(count):
        return final + (rate - final) * jnp.maximum(1 - count / setting.decay_updates, 0)

    distribution = normal(action_space(env), initial_std=setting.initial_std)
    return reinforce(
        env,
        policy=mlp_policy(env.observation_size, distribution, setting.hidden_sizes),
        estimator=standardize(leave_one_out(setting.discount), floor=setting.standardize_floor),
        optimizer=optax.chain(
            clip_by_norm(setting.max_grad_norm),
            optax.adam(schedule, b1=setting.momentum),
            decay_rate(final / rate, setting.decay_steps),
        ),
        num_episodes=setting.num_episodes,
        max_kl=setting.max_kl,
        normalize_steps=setting.normalize_steps,
        num_seeds=num_seeds,
        engine=engine,
    )


def _watched(learner: Learner, least_position_scale: Any) -> Any:
    """Returns ``learner.learn`` that measures the policy which played, and bounds the scale."""

    def learn(state: TrainState, trajectory: Trajectory, key: jax.Array) -> Any:
        learned, metrics = learner.learn(state, trajectory, key)
        statistics = learned.actor.normalizer
        least = jnp.array([least_position_scale**2, 0, 0, 0]) * statistics.count
        statistics = dataclasses.replace(statistics, m2=jnp.maximum(statistics.m2, least))
        actor = dataclasses.replace(learned.actor, normalizer=statistics)
        learned = dataclasses.replace(learned, actor=actor)
        return learned, metrics | _measures(learner, state, trajectory)

    return learn


def _measures(learner: Learner, state: TrainState, trajectory: Trajectory) -> dict[str, jax.Array]:
    """Returns shares [] of the visited steps, and where the cart was."""
    visited: Visited = visited_steps(trajectory)
    actor, observation = state.actor, visited.observation
    scaled = normalize.apply(actor.normalizer, observation)
    mean = learner.policy.distribution.mode(learner.act(actor, observation))[..., 0]
    clipped = jnp.abs(scaled) >= normalize.CLIP
    position = jnp.abs(trajectory.observation[..., 0])
    length = jnp.sum(trajectory.mask, axis=0)
    fell = length < len(position)
    end = jnp.take_along_axis(position, length[None] - 1, axis=0)[0]
    return {
        "saturated_units": visited.mean(_saturated(actor.params, scaled)),
        "clipped_position": visited.mean(clipped[..., 0].astype(float)),
        "force_out_of_range": visited.mean((jnp.abs(mean) > _MAX_FORCE).astype(float)),
        "falls": jnp.sum(fell),
        "falls_at_rail_end": jnp.sum(fell & (end > _RAIL_END)),
        "scale_position": normalize.standard_deviation(actor.normalizer)[0],
    }


def _saturated(params: Any, x: jax.Array) -> jax.Array:
    """Returns the share [...] of the hidden units that are saturated at scaled observations."""
    layers = params["network"]["params"]
    shares = []
    for i in range(len(layers) - 1):
        layer = layers[f"Dense_{i}"]
        x = jnp.tanh(x @ layer["kernel"] + layer["bias"])
        shares.append(jnp.mean(jnp.abs(x) > _SATURATED, axis=-1))
    return jnp.mean(jnp.stack(shares), axis=0) if shares else jnp.zeros(x.shape[:-1])

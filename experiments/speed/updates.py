"""How long an update learns on a GPU, and what sums in groups and rounded products save of it.

    python -m experiments.speed.updates playground:CartpoleSwingup --num-seeds 8

Episodes are played once, with the task's default settings for a minute and a policy that has
learned nothing. The update is timed as it is, then without groups of samples, then also with exact
products of the learned baseline.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax

from experiments.speed.benchmark.robots import make
from mjx_reinforce.engine.devices import executable
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.learning import samples
from mjx_reinforce.learning.learner import Learner
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.setup import build

#: Updates that are timed, of which the fastest counts.
REPEATS = 5


def learning_seconds(learner: Learner, states: Any, episodes: Any, keys: jax.Array) -> float:
    """Returns how long ``learner.learn`` takes for all seeds together (s)."""
    learn = executable(jax.jit(jax.vmap(learner.learn)).lower(states, episodes, keys))
    jax.block_until_ready(learn(states, episodes, keys))
    return min(_seconds(learn, states, episodes, keys) for _ in range(REPEATS))


def _seconds(program: Callable[..., Any], *arguments: Any) -> float:
    start = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    return time.perf_counter() - start


def measure(task: str, config: Config) -> dict[str, float]:
    """Returns the seconds of an update's learning, by what is different.

    Args:
      task: its name.
      config: the settings, of ``num_seeds`` seeds.
    """
    env = make(task)
    policy = build_policy(build.policy_settings(env, config))
    horizon = config.training_horizon(env.max_episode_steps)

    def learner() -> Learner:
        return build.build_reinforce(env, config, policy=policy, horizon=horizon)

    keys = jax.random.split(jax.random.key(config.seed), config.num_seeds)
    states = jax.vmap(learner().init)(keys)
    play = jax.vmap(lambda state, key: learner().play(state, key, True))
    episodes = executable(jax.jit(play).lower(states, keys))(states, keys)
    one_group = mock.patch.object(samples, "_MAX_GROUPS", 1)
    exact = mock.patch.object(build, "value_network", lambda sizes: MLP(sizes, 1))
    seconds = {"as it is": learning_seconds(learner(), states, episodes, keys)}
    with one_group:
        seconds["one group"] = learning_seconds(learner(), states, episodes, keys)
        with exact:
            label = "one group, exact baseline"
            seconds[label] = learning_seconds(learner(), states, episodes, keys)
    return seconds


def main() -> None:
    """Reads the command line, and prints what was measured."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.speed.updates",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("task")
    parser.add_argument("--num-seeds", type=int, default=8)
    arguments = parser.parse_args()
    if jax.default_backend() != "gpu":
        parser.error("sums are in groups on a GPU alone, and JAX finds none here")
    config = of_task(arguments.task, num_seeds=arguments.num_seeds, minutes=1.0)
    print(f"{arguments.task} on {jax.local_devices()[0].device_kind}:")
    for label, seconds in measure(arguments.task, config).items():
        print(f"  {label}: {seconds * 1e3:.1f} ms")


if __name__ == "__main__":
    main()

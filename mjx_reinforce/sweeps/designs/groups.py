"""Configurations that share one compiled program: they differ in numbers that may be traced."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.registry import is_own
from mjx_reinforce.settings.config import Config, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.types import Environment


class Group(NamedTuple):
    """C configurations that share their programs.

    config: the settings of the first
    members: [C] their numbers in the sweep
    settings: [C] each, the numbers that are traced
    """

    config: Config
    members: np.ndarray
    settings: dict[str, np.ndarray]


def make_groups(configs: Sequence[Config], swept: Collection[str], *, exact: bool) -> list[Group]:
    """Returns the configurations of a sweep in groups, in the order of their first members.

    Args:
      configs: of the sweep.
      swept: the settings in which they differ.
      exact: trace every number that may be, so that what is swept beside it changes no program.
    """
    members: dict[Any, list[int]] = {}
    traced = [_traced(config, swept, exact) for config in configs]
    for number, (config, settings) in enumerate(zip(configs, traced, strict=True)):
        compiled = dataclasses.replace(config, **dict.fromkeys(settings, None))
        members.setdefault((dataclasses.astuple(compiled), tuple(settings)), []).append(number)
    return [
        Group(
            configs[numbers[0]],
            np.array(numbers),
            {name: np.array([traced[i][name] for i in numbers]) for name in traced[numbers[0]]},
        )
        for numbers in members.values()
    ]


def _traced(config: Config, swept: Collection[str], exact: bool) -> dict[str, float]:
    """Returns the numbers of a configuration that its programs take as arguments."""
    if is_own(config.algorithm):
        return {}
    other = Reader.ARS if config.algorithm == "reinforce" else Reader.REINFORCE
    names = set(marked(Mark.TRACED)).difference(marked(other))
    if not (Reader.REINFORCE.holds(config) and Reader.FREE_STD.holds(config)):
        # Others have ``initial_std`` in their actions, which an engine may compile.
        names.discard("initial_std")
    settings = {name: getattr(config, name) for name in sorted(names) if exact or name in swept}
    if not Reader.DECAY.holds(config):
        settings.pop("final_learning_rate", None)
    elif "learning_rate" in settings and config.final_learning_rate is None:
        settings["final_learning_rate"] = config.learning_rate / 10
    return {
        name: float(value)
        for name, value in settings.items()
        if not (value is None or isinstance(value, str))
    }


def learner_builder(env: Environment, config: Config) -> Callable[[dict[str, Any]], Any]:
    """Returns the function from the traced settings of a run to its learner.

    Args:
      env: what it learns on.
      config: the other settings.
    """
    from mjx_reinforce.store.build import build

    if config.algorithm != "reinforce":
        return lambda settings: build(env, dataclasses.replace(config, **settings))[0]
    plain = build(env, config)[0]

    def build_learner(settings: dict[str, Any]) -> Any:
        # How REINFORCE plays depends on no traced number, and takes a second to write out.
        traced = build(env, dataclasses.replace(config, engine="vmap", **settings))[0]
        return plain._replace(init=traced.init, learn=traced.learn)

    return build_learner

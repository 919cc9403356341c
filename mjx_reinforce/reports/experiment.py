"""What a report is about: configurations, each trained with many seeds, and what these say."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.statistics.sequential import Verdict


class Configuration(NamedTuple):
    """One choice of settings, trained with S seeds and evaluated E times.

    label: what it is called, "learning rate 0.003, discount 0.99"
    settings: those that were swept, or that differ between the sources
    eval_return: [E, S] the deterministic return, NaN where it is not finite
    env_steps: [E, S] trained until then
    nonfinite: [S] updates that met numbers which are not finite
    seed: [S] each seed's number in its source
    directories: [S] the directory of each
    terms: [E, S] each, sums of the reward's terms over an episode, by their names; of a sweep none
    """

    label: str
    settings: dict[str, Any]
    eval_return: np.ndarray
    env_steps: np.ndarray
    nonfinite: np.ndarray
    seed: np.ndarray
    directories: Sequence[Path] = ()
    terms: Mapping[str, np.ndarray] = MappingProxyType({})


class Source(NamedTuple):
    """A run or a sweep as its directory holds it.

    settings: of all its configurations
    provenance: versions, device, commit, command
    timings: seconds by name, of compiling and running
    status: "running", "interrupted" or "finished"
    decision: of a sweep until the best is decided, see ``statistics.sequential.Verdict``
    """

    directory: Path
    env: str
    threshold: float | None
    configurations: list[Configuration]
    settings: dict[str, Any]
    provenance: dict[str, Any]
    timings: dict[str, float]
    status: str
    decision: Verdict | None = None


class Experiment(NamedTuple):
    """All that a report is drawn from; the fields are named as those of ``Source``.

    decision: that of a sweep that is the only source, about its configurations
    directories: of each configuration, where it was read
    unfinished: the directories whose training goes on or was interrupted
    disagree: names in the provenance of which the sources say different things
    """

    title: str
    env: str
    threshold: float | None
    configurations: list[Configuration]
    settings: dict[str, Any]
    provenance: dict[str, Any]
    timings: dict[str, float]
    directories: list[Path]
    unfinished: list[Path]
    disagree: list[str]
    decision: Verdict | None = None


def settings_in_words(settings: Mapping[str, Any]) -> str:
    """Returns settings in words: "learning rate 0.003, discount 0.99"."""
    return ", ".join(f"{setting_in_words(name)} {say(value)}" for name, value in settings.items())


def race_in_words(settings: Mapping[str, Any]) -> str:
    """Returns what a label says of a race among the settings, ", race 4"; nothing without one."""
    race = settings.get("race") or 1
    return f", race {race}" if race > 1 else ""


def setting_in_words(name: str) -> str:
    """Returns the name of a setting in words."""
    return name.replace("_", " ")


def say(value: object) -> str:
    """Returns the value of a setting in words; sizes of layers as 32-32."""
    if isinstance(value, list | tuple):
        # Words may have hyphens of their own.
        separator = " " if any(isinstance(x, str) for x in value) else "-"
        return separator.join(map(say, value)) or "none"
    if isinstance(value, float):
        return f"{value:.4g}"
    return "none" if value is None else str(value)


def counted(number: int, noun: str) -> str:
    """Returns a number and its noun: "1 seed", "1,024 seeds"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def lengthened(curves: np.ndarray, length: int) -> np.ndarray:
    """Returns curves [E, R] with the last row repeated up to ``length``."""
    return np.concatenate([curves, np.repeat(curves[-1:], length - len(curves), axis=0)])


def ordered(values: Sequence[Any]) -> list[Any]:
    """Returns the different values of a setting: numbers by size, others as they come."""
    # By ``repr``: lists cannot be keys of a dict, and True would be the key 1.
    distinct_values = list({repr(value): value for value in values}.values())
    if all(isinstance(value, int | float) for value in distinct_values):
        return sorted(distinct_values)
    return distinct_values

"""What a report is drawn from: runs and sweeps, read into one experiment."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.reports.directories import read_directory
from mjx_reinforce.reports.experiment import (
    Configuration,
    Experiment,
    Source,
    counted,
    lengthened,
    settings_in_words,
)

#: Settings that say where and how a run was kept, not what was trained.
_HOUSEKEEPING = ("output", "resume", "checkpoint_every", "num_seeds", "seeds")
#: What should be the same of sources that are compared.
_COMPARABLE = ("python", "packages", "git_commit", "device", "x64", "engine")


def read_experiment(sources: Sequence[Path]) -> Experiment:
    """Reads run directories and sweep directories as one experiment.

    The configurations of a sweep are told apart by what it swept; those of several sources by the
    settings in which they differ too, or else by the names of their directories. Shares of a run or
    sweep (--seeds) are joined.

    Raises:
      ValueError: there is no source, one is neither a run nor a sweep or is damaged (which file,
        what is wrong in it), they are of different tasks, or shares do not fit each other.
    """
    if not sources:
        raise ValueError("there is nothing to report on: name a run or a sweep directory")
    found = [read_directory(Path(source)) for source in dict.fromkeys(sources)]
    envs = list(dict.fromkeys(source.env for source in found))
    if len(envs) > 1:
        raise ValueError(
            f"these are of different tasks ({', '.join(envs)}), whose returns cannot be compared; "
            "make a page of each task, and a table and a figure of all with "
            "experiments/examples/all_tasks.py"
        )
    joined = _join_shares(found)
    configurations = _told_apart(joined)
    if any(source.settings.get("seeds") for source in found):
        _check_seeds(configurations)
    thresholds = [source.threshold for source in found if source.threshold is not None]
    provenance, disagree = _merge_provenance(found)
    timings = sum((Counter(source.timings) for source in found), Counter())
    env = found[0].env
    return Experiment(
        title=f"{env}, {counted(len(configurations), 'configuration')}",
        env=env,
        threshold=thresholds[0] if thresholds else None,
        configurations=configurations,
        settings=_in_common([source.settings for source in found]),
        provenance=provenance,
        timings=dict(timings),
        directories=[source.directory for source in joined for _ in source.configurations],
        unfinished=[source.directory for source in found if source.status != "finished"],
        disagree=disagree,
    )


def _join_shares(sources: Sequence[Source]) -> list[Source]:
    """Returns the sources, of which those that are shares of one run or sweep are one.

    Raises:
      ValueError: shares have a seed in common.
    """

    def trained(source: Source) -> Any:
        settings = {k: x for k, x in source.settings.items() if k not in _HOUSEKEEPING}
        return settings, [part.settings for part in source.configurations]

    joined = []
    for source in sources:
        alike = [other for other in sources if trained(other) == trained(source)]
        if not any(other.settings.get("seeds") for other in alike):
            joined.append(source)
        elif source is alike[0]:
            joined.append(_join(alike))
    return joined


def _join(shares: Sequence[Source]) -> Source:
    """Returns shares of one run or sweep as one source."""
    of_seed: dict[int, Path] = {}
    for source in shares:
        for seed in sorted({*np.concatenate([part.seed for part in source.configurations])}):
            other = of_seed.setdefault(int(seed), source.directory)
            if other != source.directory:
                raise ValueError(
                    f"{other} and {source.directory} both have seed {seed}, with equal settings: "
                    "give each share other --seeds, or leave one of them out"
                )
    parts = zip(*(source.configurations for source in shares), strict=True)
    return shares[0]._replace(configurations=[_join_parts(each) for each in parts])


def _join_parts(parts: Sequence[Configuration]) -> Configuration:
    """Returns one configuration of several shares; seeds that ended earlier repeat their last."""
    length = max(len(part.eval_return) for part in parts)

    def together(name: str) -> np.ndarray:
        each = [lengthened(getattr(part, name), length) for part in parts]
        return np.concatenate(each, axis=1)[:, order]

    seed = np.concatenate([part.seed for part in parts])
    order = np.argsort(seed)
    where = [place for part in parts for place in part.where]
    return parts[0]._replace(
        eval_return=together("eval_return"),
        env_steps=together("env_steps"),
        nonfinite=np.concatenate([part.nonfinite for part in parts])[order],
        seed=seed[order],
        where=[where[i] for i in order],
    )


def _check_seeds(configurations: Sequence[Configuration]) -> None:
    """Raises ValueError for shares of which no run can be made, and which cannot be compared."""
    first, *others = configurations
    for other in others:
        if not np.intersect1d(first.seed, other.seed).size:
            one, two = (f"{part.where[0]} ({part.label})" for part in (first, other))
            raise ValueError(
                f"{one} and {two} have no seed in common, so they cannot be compared, and their "
                "settings differ, so they are no shares of one run: give equal --seeds or settings"
            )


def _told_apart(sources: Sequence[Source]) -> list[Configuration]:
    """Returns all configurations, each with a label of its own and the settings that differ."""
    pairs = [(source, part) for source in sources for part in source.configurations]
    # Runs of version 0.1 have no setting env_set.
    full = [{"env_set": []} | source.settings | part.settings for source, part in pairs]
    names = dict.fromkeys(name for settings in full for name in settings)
    differ = [
        name
        for name in names
        if name not in _HOUSEKEEPING and len({repr(each.get(name)) for each in full}) > 1
    ]
    parts = []
    for (source, part), settings in zip(pairs, full, strict=True):
        own = {name: settings.get(name) for name in differ}
        parts.append(
            part._replace(
                settings=own, label=settings_in_words(own) or _path_in_words(source.directory.name)
            )
        )
    repeated = {label for label, times in Counter(p.label for p in parts).items() if times > 1}
    return [
        part._replace(label=f"{part.label} in {_path_in_words(source.directory)}")
        if part.label in repeated
        else part
        for (source, _), part in zip(pairs, parts, strict=True)
    ]


def _in_common(settings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the settings that all sources share."""
    first, *others = settings
    return {
        name: value
        for name, value in first.items()
        if name not in _HOUSEKEEPING and all(name in x and x[name] == value for x in others)
    }


def _merge_provenance(sources: Sequence[Source]) -> tuple[dict[str, Any], list[str]]:
    """Returns what the sources say of their provenance, and where they do not agree.

    An entry in which they differ holds the answer of each directory.
    """
    names = dict.fromkeys(name for source in sources for name in source.provenance)
    merged, disagree = {}, []
    for name in names:
        answers = {str(s.directory): s.provenance.get(name) for s in sources}
        same = len({repr(answer) for answer in answers.values()}) == 1
        merged[name] = next(iter(answers.values())) if same else answers
        if not same and name in _COMPARABLE:
            disagree.append(name)
    return merged, disagree


def _path_in_words(path: Path | str) -> str:
    """Returns a path for people, with escapes for bytes that a locale of ASCII cannot read."""
    return str(path).encode(errors="backslashreplace").decode()

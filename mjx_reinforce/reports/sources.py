"""What a report is drawn from: runs and sweeps, read into one experiment."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_reinforce.reports import run_source, sweep_source
from mjx_reinforce.reports.experiment import (
    Configuration,
    Experiment,
    Source,
    asked,
    counted,
    settings_in_words,
)

#: Settings that say where and how a run was kept, not what was trained.
_HOUSEKEEPING = ("output", "overwrite", "resume", "checkpoint_every", "num_seeds")
#: What should be the same of sources that are compared.
_COMPARABLE = ("python", "packages", "git_commit", "device", "x64", "engine")


def read_experiment(sources: Sequence[Path]) -> Experiment:
    """Reads run directories and sweep directories as one experiment.

    The configurations of a sweep are told apart by what it swept; those of several sources by the
    settings in which they differ too, or else by the names of their directories.

    Raises:
      ValueError: there is no source, one is neither a run nor a sweep or is damaged (which file,
        what is wrong in it), or they are of different tasks.
    """
    if not sources:
        raise ValueError("there is nothing to report on: name a run or a sweep directory")
    found = [_read_source(Path(source)) for source in dict.fromkeys(sources)]
    envs = list(dict.fromkeys(source.env for source in found))
    if len(envs) > 1:
        raise ValueError(
            f"these are of different tasks ({', '.join(envs)}), whose returns cannot be compared; "
            "make a report of each"
        )
    return _experiment(found)


def read_tasks(sources: Sequence[Path]) -> list[Experiment]:
    """Reads run and sweep directories as one experiment for each task, in their order.

    Raises:
      ValueError: as ``read_experiment`` does, but not for different tasks.
    """
    if not sources:
        raise ValueError("there is nothing to report on: name a run or a sweep directory")
    found = [_read_source(Path(source)) for source in dict.fromkeys(sources)]
    envs = dict.fromkeys(source.env for source in found)
    return [_experiment([source for source in found if source.env == env]) for env in envs]


def _experiment(found: Sequence[Source]) -> Experiment:
    """Returns the experiment of sources of one task."""
    configurations = _told_apart(found)
    thresholds = [source.threshold for source in found if source.threshold is not None]
    provenance, disagree = _merge_provenance(found)
    timings = sum((Counter(source.timings) for source in found), Counter())
    env = found[0].env
    return Experiment(
        title=f"{env}, {counted(len(configurations), 'configuration')}",
        env=env,
        threshold=thresholds[0] if thresholds else None,
        asked=asked(env, configurations),
        configurations=configurations,
        settings=_in_common([source.settings for source in found]),
        provenance=provenance,
        timings=dict(timings),
        directories=[source.directory for source in found for _ in source.configurations],
        unfinished=[source.directory for source in found if source.status != "finished"],
        disagree=disagree,
    )


def _read_source(directory: Path) -> Source:
    if (directory / "sweep.json").is_file():
        return sweep_source.read_sweep_source(directory)
    if (directory / "config.json").is_file():
        return run_source.read_run_source(directory)
    if not directory.is_dir():
        raise ValueError(f"there is no directory {directory}; name that of a run or a sweep")
    raise ValueError(
        f"{directory} is neither a run nor a sweep: it has no config.json and no sweep.json"
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

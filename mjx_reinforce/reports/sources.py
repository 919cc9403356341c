"""What a report is drawn from: runs and sweeps, read into one experiment."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.files import Header, read_arrays, read_json
from mjx_reinforce.reports import run_source
from mjx_reinforce.reports.experiment import (
    Configuration,
    Experiment,
    Source,
    asked,
    counted,
    settings_in_words,
)
from mjx_reinforce.reports.run_source import number_entry, read_columns, timings

#: Settings that say where and how a run was kept, not what was trained.
_HOUSEKEEPING = ("output", "overwrite", "resume", "checkpoint_every", "num_seeds", "seeds")
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
    found = [_read_source(Path(source)) for source in dict.fromkeys(sources)]
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
        asked=asked(env, configurations),
        configurations=configurations,
        settings=_in_common([source.settings for source in found]),
        provenance=provenance,
        timings=dict(timings),
        directories=[source.directory for source in joined for _ in source.configurations],
        unfinished=[source.directory for source in found if source.status != "finished"],
        disagree=disagree,
    )


def _read_source(directory: Path) -> Source:
    if (directory / "sweep.json").is_file():
        return read_sweep_source(directory)
    if (directory / "config.json").is_file():
        return run_source.read_run_source(directory)
    if not directory.is_dir():
        raise ValueError(f"there is no directory {directory}; name that of a run or a sweep")
    raise ValueError(
        f"{directory} is neither a run nor a sweep: it has no config.json and no sweep.json"
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
        each = [getattr(part, name) for part in parts]
        each = [np.concatenate([x, np.repeat(x[-1:], length - len(x), axis=0)]) for x in each]
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


#: What sweep.json says of the sweep itself; all else is its provenance.
_OWN = (
    *("status", "env", "threshold", "settings", "configurations"),
    *("compile_seconds", "run_seconds", "statistics_seconds"),
)
_COLUMNS = {"configuration": np.int64, "seed": np.int64, "nonfinite": np.int64}
_ARRAYS = ("configuration", "seed", "eval_return", "env_steps")


def read_sweep_source(directory: Path) -> Source:
    """Reads a sweep, which may go on or have been interrupted.

    Raises:
      ValueError: a file is missing or damaged: which, and what is wrong.
    """
    path = directory / "sweep.json"
    content = read_json(path)
    if not isinstance(content.get("env"), str):
        raise ValueError(f"{path} is damaged: env is {content.get('env')!r}")
    swept = _swept(content, path)
    curves = _read_curves(directory / "curves.npz")
    curves["nonfinite"] = _nonfinite(directory / "results.csv", curves)
    if not len(curves["seed"]):
        raise ValueError(f"{directory} has no results yet; wait for the first, or --resume it")
    parts = []
    for identity in np.unique(curves["configuration"]).tolist():
        if identity not in swept:
            raise ValueError(f"{path} is damaged: it does not name configuration {identity}")
        part = _configuration(swept[identity], curves, identity)
        parts.append(part._replace(where=[directory] * len(part.seed)))
    settings = content.get("settings")
    return Source(
        directory=directory,
        env=content["env"],
        threshold=number_entry(content, "threshold", path),
        configurations=parts,
        settings=settings if isinstance(settings, dict) else {},
        provenance={name: x for name, x in content.items() if name not in _OWN},
        timings=timings(content, path),
        status=str(content.get("status", "finished")),
    )


def _swept(content: dict[str, Any], path: Path) -> dict[int, dict[str, Any]]:
    """Returns the swept settings of each configuration by its number."""
    try:
        return {
            int(entry["configuration"]): {k: v for k, v in entry.items() if k != "configuration"}
            for entry in content["configurations"]
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged: configurations is no list of settings with their number"
        ) from error


def _read_curves(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of curves.npz."""
    arrays = read_arrays(path, lambda headers: _check_curves(headers, path))
    return {name: arrays[name] for name in _ARRAYS}


def _check_curves(arrays: Mapping[str, Header], path: Path) -> None:
    """Raises ValueError for what is not in a curves.npz, or is missing there."""
    for name in sorted(arrays.keys() - set(_ARRAYS)):
        raise ValueError(f"{path} is damaged: {name!a} is not an array of a sweep")
    for name in _ARRAYS:
        if name not in arrays:
            raise ValueError(f"{path} is damaged: it has no array {name}")
        if not np.issubdtype(arrays[name].dtype, np.number):
            raise ValueError(f"{path} is damaged: {name} holds no numbers")
    shape = arrays["eval_return"].shape
    expected = {
        name: shape if name in ("eval_return", "env_steps") else shape[1:] for name in _ARRAYS
    }
    for name, wanted in expected.items():
        if len(shape) != 2 or shape[0] < 1 or arrays[name].shape != wanted:
            raise ValueError(
                f"{path} is damaged: {name} has the shape {arrays[name].shape}, not {wanted}"
            )


def _nonfinite(path: Path, curves: dict[str, np.ndarray]) -> np.ndarray:
    """Returns the non-finite updates [R] of the curves, as results.csv has them.

    Raises:
      ValueError: the file cannot be read, is damaged, or misses a seed that has a curve.
    """
    columns = read_columns(path, _COLUMNS)
    keys = zip(columns["configuration"].tolist(), columns["seed"].tolist(), strict=True)
    found = dict(zip(keys, columns["nonfinite"].tolist(), strict=True))
    wanted = list(zip(curves["configuration"].tolist(), curves["seed"].tolist(), strict=True))
    for configuration, seed in wanted:
        if (configuration, seed) not in found:
            raise ValueError(
                f"{path} is damaged: it has no row of configuration {configuration}, seed {seed}, "
                "whose curve is in curves.npz"
            )
    return np.array([found[key] for key in wanted], np.int64)


def _configuration(
    settings: dict[str, Any], curves: dict[str, np.ndarray], identity: int
) -> Configuration:
    rows = np.flatnonzero(curves["configuration"] == identity)
    return Configuration(
        label=settings_in_words(settings),
        settings=settings,
        eval_return=curves["eval_return"][:, rows].astype(float),
        env_steps=curves["env_steps"][:, rows].astype(np.int64),
        nonfinite=curves["nonfinite"][rows],
        seed=curves["seed"][rows].astype(np.int64),
    )

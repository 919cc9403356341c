"""What a report is drawn from: the directories of runs and sweeps, read into one experiment.

They may go on, or have been interrupted.
"""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.engine.checks import check_type
from mjx_reinforce.export.run_files import run_hint
from mjx_reinforce.files import naming_damage, read_arrays, read_json
from mjx_reinforce.reports.experiment import (
    Configuration,
    Experiment,
    Source,
    counted,
    lengthened,
    race_in_words,
    setting_in_words,
    settings_in_words,
)
from mjx_reinforce.statistics.sequential import Verdict

#: What config.json says besides the settings.
PROVENANCE = (
    "python",
    "packages",
    "git_commit",
    "device",
    "cpu",
    "machine_code",
    "jax_settings",
    "num_devices",
    "cpu_count",
    "cores",
    "x64",
    "xla_flags",
    "resumed",
)
_TIMINGS = ("compile_seconds", "run_seconds", "statistics_seconds")
#: What sweep.json says of the sweep itself; all else is its provenance.
_SWEEP_KEYS = (
    "status",
    "env",
    "threshold",
    "settings",
    "configurations",
    "until_decided",
    "decision",
    *_TIMINGS,
)
#: The columns and arrays that are read, and their types.
_METRICS = {"seed": np.int64, "env_steps": np.int64, "eval_return": np.float64}
#: How the columns of the reward's terms begin.
_TERM = "eval_reward"
_CURVES = {
    "configuration": np.int64,
    "seed": np.int64,
    "eval_return": np.float64,
    "env_steps": np.int64,
    "nonfinite": np.int64,
}
#: Those of a configuration.
_COLUMNS = ("seed", "eval_return", "env_steps", "nonfinite")
#: Settings that say where and how a run was kept, not what was trained.
_HOUSEKEEPING = ("output", "resume", "like", "checkpoint_every", "log", "num_seeds", "seeds")
#: What should be the same of sources that are compared.
_COMPARABLE = ("python", "packages", "git_commit", "device", "x64", "engine")


def read_tasks(paths: Sequence[Path]) -> list[Experiment]:
    """Reads run directories and sweep directories as an experiment of each task.

    The configurations of a sweep are told apart by what it swept; those of several sources by the
    settings in which they differ too, or else by the names of their directories. Shares of a run or
    sweep (--seeds) are joined.

    Raises:
      ValueError: there is no source, one is named twice, is neither a run nor a sweep or is damaged
        (which file, what is wrong in it), or shares do not fit each other.
    """
    if not paths:
        raise ValueError("there is nothing to report on: name a run or a sweep directory")
    # Counted twice, the seeds of one directory would look like twice as many.
    path_of_folder: dict[Path, Path] = {}
    for path in map(Path, paths):
        earlier_path = path_of_folder.setdefault(path.resolve(), path)
        if earlier_path is not path:
            raise ValueError(f"{earlier_path} and {path} are one directory: name each source once")
    sources_of_task: dict[str, list[Source]] = {}
    for path in path_of_folder.values():
        source = read_directory(path)
        sources_of_task.setdefault(source.env, []).append(source)
    return [_as_experiment(env, sources) for env, sources in sources_of_task.items()]


def read_experiment(paths: Sequence[Path]) -> Experiment:
    """Reads directories of one task, see ``read_tasks``; ValueError where there are several."""
    experiment, *others = read_tasks(paths)
    if others:
        envs = ", ".join(task.env for task in (experiment, *others))
        raise ValueError(
            f"these are of different tasks ({envs}), whose returns cannot be compared; compare "
            "their scores by python -m mjx_reinforce.report"
        )
    return experiment


def _as_experiment(env: str, sources: Sequence[Source]) -> Experiment:
    """Returns the sources of a task as one experiment, or raises ValueError, see ``read_tasks``."""
    joined = _join_shares(sources)
    configurations = _told_apart(joined)
    _check_common_seeds(configurations)
    # A run whose training goes on has not written its threshold yet.
    thresholds = (source.threshold for source in sources if source.threshold is not None)
    provenance, disagree = _merge_provenance(sources)
    timings = sum((Counter(source.timings) for source in sources), Counter())
    return Experiment(
        title=f"{env}, {counted(len(configurations), 'configuration')}",
        env=env,
        threshold=next(thresholds, None),
        configurations=configurations,
        settings=_in_common(sources),
        provenance=provenance,
        timings=dict(timings),
        directories=[source.directory for source in joined for _ in source.configurations],
        unfinished=[source.directory for source in sources if source.status != "finished"],
        disagree=disagree,
        decision=sources[0].decision if len(sources) == 1 else None,
    )


def _check_common_seeds(configurations: Sequence[Configuration]) -> None:
    """Raises ValueError for a configuration that shares no seed with the first."""
    reference, *challengers = configurations
    for part in challengers:
        if not np.intersect1d(reference.seed, part.seed).size:
            names = ", ".join(map(setting_in_words, part.settings))
            raise ValueError(
                f"{reference.label} and {part.label} have no seed in common, so they "
                "cannot be compared: train both with the same --seeds. As shares of one run they "
                f"would have to agree in {names}"
            )


def _join_shares(sources: Sequence[Source]) -> list[Source]:
    """Returns the sources, of which those that are shares of one run or sweep are one.

    Raises:
      ValueError: shares have a seed in common.
    """
    groups: dict[str, list[Source]] = {}
    for source in sources:
        settings = {k: x for k, x in source.settings.items() if k not in _HOUSEKEEPING}
        training = settings, [part.settings for part in source.configurations]
        groups.setdefault(repr(training), []).append(source)
    joined = []
    for shares in groups.values():
        # Equal settings without --seeds are a run repeated, which is a configuration of its own.
        if any(share.settings.get("seeds") for share in shares):
            configurations = zip(*(share.configurations for share in shares), strict=True)
            joined_configurations = [_join_parts(parts) for parts in configurations]
            shares = [shares[0]._replace(configurations=joined_configurations)]
        joined += shares
    return joined


def _join_parts(parts: Sequence[Configuration]) -> Configuration:
    """Returns one configuration of several shares; seeds that ended earlier repeat their last."""
    # A share ends with the slowest of its own seeds, so that shares differ in evaluations.
    length = max(len(part.eval_return) for part in parts)
    directories = [place for part in parts for place in part.directories]
    # ``order`` sorts the runs of all shares by their seeds.
    seed, order, times = np.unique(
        np.concatenate([part.seed for part in parts]), return_index=True, return_counts=True
    )
    if len(order) < len(directories):
        names = " and ".join(map(str, dict.fromkeys(directories)))
        raise ValueError(
            f"{names} have seed {seed[times.argmax()]} in common, with equal settings: give "
            "each share its own --seeds, or leave one out"
        )

    def joined(curves: Sequence[np.ndarray]) -> np.ndarray:
        return np.concatenate([lengthened(x, length) for x in curves], axis=1)[:, order]

    # Shares of other versions of the package may lack terms.
    names = [name for name in parts[0].terms if all(name in part.terms for part in parts)]

    return parts[0]._replace(
        eval_return=joined([part.eval_return for part in parts]),
        env_steps=joined([part.env_steps for part in parts]),
        terms={name: joined([part.terms[name] for part in parts]) for name in names},
        nonfinite=np.concatenate([part.nonfinite for part in parts])[order],
        seed=seed,
        directories=[directories[i] for i in order],
    )


def _told_apart(sources: Sequence[Source]) -> list[Configuration]:
    """Returns all configurations, each with a label of its own and the settings that differ."""
    pairs = [(source, part) for source in sources for part in source.configurations]
    full_settings = [source.settings | part.settings for source, part in pairs]
    names = dict.fromkeys(name for settings in full_settings for name in settings)
    varied_names = [
        name
        for name in names
        if name not in _HOUSEKEEPING
        and len({repr(settings.get(name)) for settings in full_settings}) > 1
    ]
    parts = []
    for (source, part), settings in zip(pairs, full_settings, strict=True):
        differences = {name: settings.get(name) for name in varied_names}
        label = settings_in_words(differences)
        if not label:
            # A run by itself is its task; several of one task are told by their directories.
            label = source.env if len(pairs) == 1 else _path_in_words(source.directory.name)
        # Nor does a mean of races stand anywhere without its label.
        if "race" not in differences:
            label += race_in_words(settings)
        parts.append(part._replace(settings=differences, label=label))
    # Charts and tables know a configuration by its label alone: no two may be equal.
    times = Counter(part.label for part in parts)
    for i, (source, _) in enumerate(pairs):
        label = parts[i].label
        if times[label] > 1:
            label = f"{label} in {_path_in_words(source.directory)}"
            parts[i] = parts[i]._replace(label=label)
    return parts


def _in_common(sources: Sequence[Source]) -> dict[str, Any]:
    """Returns the settings that all configurations of all sources share."""
    swept = {name for source in sources for part in source.configurations for name in part.settings}
    shared_settings = {
        name: value
        for name, value in sources[0].settings.items()
        if name not in (*_HOUSEKEEPING, *swept)
        and all(name in x.settings and x.settings[name] == value for x in sources[1:])
    }
    # NAME=VALUE each; a sweep over one of them is over "env_set.NAME".
    assignments = shared_settings.get("env_set")
    if assignments:
        shared_settings["env_set"] = [
            text for text in assignments if f"env_set.{text.partition('=')[0]}" not in swept
        ]
    return shared_settings


def _merge_provenance(sources: Sequence[Source]) -> tuple[dict[str, Any], list[str]]:
    """Returns what the sources say of their provenance, and where they do not agree.

    An entry in which they differ holds the answer of each directory.
    """
    entry_names = dict.fromkeys(name for source in sources for name in source.provenance)
    provenance = {}
    disagree = []
    for name in entry_names:
        answers = {str(s.directory): s.provenance.get(name) for s in sources}
        if len({repr(answer) for answer in answers.values()}) == 1:
            provenance[name] = sources[0].provenance.get(name)
            continue
        provenance[name] = answers
        # Two commands are no reason for distrust, but two devices are.
        if name in _COMPARABLE:
            disagree.append(name)
    return provenance, disagree


def _path_in_words(path: Path | str) -> str:
    """Returns a path for people, with escapes for bytes that a locale of ASCII cannot read."""
    return str(path).encode(errors="backslashreplace").decode()


def read_directory(directory: Path) -> Source:
    """Reads a run or a sweep.

    Raises:
      ValueError: it is neither, or a file is missing or damaged: which, and what is wrong.
    """
    for name, read in (("sweep.json", _read_sweep), ("config.json", _read_run)):
        if (directory / name).is_file():
            content = read_json(directory / name)
            with naming_damage(directory / name):
                check_type("env", content["env"], str)
            return read(directory, content)
    if not directory.is_dir():
        raise ValueError(f"there is no directory {directory}; name that of a run or a sweep")
    reason = run_hint(directory) or ": it has no config.json and no sweep.json"
    raise ValueError(f"{directory} is neither a run nor a sweep{reason}")


def _read_run(directory: Path, config: dict[str, Any]) -> Source:
    """Reads a run with this config.json."""
    columns = read_metrics(directory / "metrics.csv")
    terms = {x.removeprefix("eval_"): columns.pop(x) for x in [*columns] if x not in _METRICS}
    num_seeds = len(columns["seed"])
    if num_seeds != config.get("num_seeds", num_seeds):
        raise ValueError(
            f"{directory}/metrics.csv has {num_seeds} seeds, config.json {config['num_seeds']}: "
            "they are of different runs; put back the one that was there"
        )
    # The summary is written at the end; until then the run is read as far as it came.
    path = directory / "summary.json"
    summary: dict[str, Any] = {"status": "running"}
    if path.exists():
        summary = read_json(path)
    if config["env"] != summary.get("env", config["env"]):
        raise ValueError(
            f"{path} is for {summary['env']}, config.json for {config['env']}: they are of "
            "different runs; put back the one that was there"
        )
    with naming_damage(path):
        # [S] counts; a run that goes on has none yet, and 0 stands for all seeds.
        counts = np.array(summary.get("nonfinite", 0), np.int64)
        nonfinite = np.broadcast_to(counts, num_seeds)
        outcome = _outcome(summary)
    part = Configuration(
        directory.name,
        {},
        nonfinite=nonfinite,
        directories=[directory] * num_seeds,
        terms=terms,
        **columns,
    )
    provenance = {name: value for name, value in config.items() if name in PROVENANCE}
    # The engine that was chosen, in place of "auto" in the settings.
    provenance["engine"] = summary.get("engine", config.get("engine"))
    return Source(
        directory=directory,
        env=config["env"],
        configurations=[part],
        # Runs of earlier versions of the package do not race, and do not say so.
        settings={"race": 1} | {name: x for name, x in config.items() if name not in PROVENANCE},
        provenance=provenance,
        **outcome,
    )


def _read_sweep(directory: Path, content: dict[str, Any]) -> Source:
    """Reads a sweep with this sweep.json."""
    curves = _read_curves(directory)
    if not len(curves["seed"]):
        raise ValueError(f"{directory} has no results yet; wait for the first, or --resume it")
    parts = []
    with naming_damage(directory / "sweep.json"):
        # By this key, a number that is missing is named so in the error.
        swept = {f"configuration {x.pop('configuration')}": x for x in content["configurations"]}
        # A sweep that goes on has results of some configurations alone.
        for number in np.unique(curves["configuration"]):
            settings = swept[f"configuration {number}"]
            runs = curves["configuration"] == number
            columns: dict[str, Any] = {name: curves[name][..., runs] for name in _COLUMNS}
            directories = [directory] * int(runs.sum())
            label = settings_in_words(settings)
            parts.append(Configuration(label, settings, directories=directories, **columns))
        return Source(
            directory=directory,
            env=content["env"],
            configurations=parts,
            settings=content.get("settings", {}),
            provenance={name: x for name, x in content.items() if name not in _SWEEP_KEYS},
            decision=_read_decision(content.get("decision"), len(swept)),
            **_outcome(content),
        )


def _read_decision(record: Mapping[str, Any] | None, num_configurations: int) -> Verdict | None:
    """Returns the decision of a sweep; None where it makes none.

    Raises:
      ValueError: it is about other configurations.
    """
    if record is None:
        return None
    verdict = Verdict(**record)
    places = range(num_configurations)
    if len(verdict.num_seeds) != num_configurations or not set(verdict.contenders) <= set(places):
        raise ValueError(f"decision is not about {counted(num_configurations, 'configuration')}")
    return verdict


def _outcome(content: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what a file says of ``threshold``, ``timings`` and ``status``."""
    names = ("threshold", *_TIMINGS)
    numbers = {name: float(content[name]) for name in names if content.get(name) is not None}
    return {
        "threshold": numbers.pop("threshold", None),
        "timings": numbers,
        "status": content["status"],
    }


def _read_curves(directory: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of curves.npz, [R] or [E, R] of R runs."""
    path = directory / "curves.npz"
    arrays = read_arrays(path, _CURVES)
    with naming_damage(path):
        curves = {name: arrays[name].astype(kind) for name, kind in _CURVES.items()}
        shapes = {name: x.shape[-1:] for name, x in curves.items()}
        if len({*shapes.values()}) > 1 or len(curves["eval_return"]) != len(curves["env_steps"]):
            raise ValueError(f"its arrays are of different runs: {shapes}")
        if not len(curves["env_steps"]):
            raise ValueError("it has no evaluations")
        _check_steps(curves["env_steps"])
        return curves


def _check_steps(env_steps: np.ndarray) -> None:
    """Raises ValueError for env steps [E, R] that are negative, or fall between evaluations."""
    if (np.diff(env_steps, axis=0, prepend=0) < 0).any():
        raise ValueError("env_steps are negative, or fewer than at the evaluation before")


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """Returns the columns ``env_steps`` and ``eval_return`` [E, S] of a metrics.csv, ``seed`` [S].

    Behind them are the columns of the reward's terms [E, S], if there are any. A last line or
    evaluation that is not whole, which a killed run may leave, is left out.

    Raises:
      ValueError: the file cannot be read, a column is missing, an entry is no number, the rows are
        not in the order of the seeds, or env steps fall.
    """
    columns = read_columns(path, _METRICS, _TERM)
    seed = columns["seed"]
    if not len(seed):
        raise ValueError(f"{path} has no evaluation yet; wait for the first, or train again")
    num_seeds = len(np.unique(seed))
    # An evaluation is a line a seed, always in the same order.
    if (seed != np.resize(seed[:num_seeds], len(seed))).any():
        raise ValueError(f"{path} is damaged: its lines are not in the order of the seeds")
    num_evaluations = len(seed) // num_seeds
    curves = {
        name: column[: num_evaluations * num_seeds].reshape(num_evaluations, num_seeds)
        for name, column in columns.items()
    }
    with naming_damage(path):
        _check_steps(curves["env_steps"])
    return curves | {"seed": seed[:num_seeds]}


def read_columns(
    path: Path, kinds: Mapping[str, Any], prefix: str | None = None
) -> dict[str, np.ndarray]:
    """Returns columns of a CSV file by name; a last line that is not whole is left out.

    Args:
      path: of the file, whose first line has the names of the columns.
      kinds: the type of each column that is wanted.
      prefix: how the names of further columns begin, of floats, if any are wanted.

    Raises:
      ValueError: the file cannot be read, a column is missing, a row too short or long, or an entry
        not of its type.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read {path} ({error})") from error
    with naming_damage(path):  # csv has a class of errors of its own
        # A line without its end may have half a number.
        header, *rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines())) or [[]]
        for line_number, row in enumerate(rows, start=2):
            if len(row) != len(header):
                raise ValueError(f"line {line_number} has {len(row)} entries, not {len(header)}")
        columns = {name: [] for name in header}
        if rows:
            columns = dict(zip(header, zip(*rows, strict=True), strict=True))
        if prefix is not None:
            kinds = {**kinds, **{x: np.float64 for x in columns if x.startswith(prefix)}}
        return {name: np.array(columns[name], kind) for name, kind in kinds.items()}

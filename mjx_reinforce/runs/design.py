"""What a run or a sweep is to do: the settings of all runs, and the grid that it goes over."""

import contextlib
import dataclasses
import datetime
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_origin

import tyro

from mjx_reinforce.console.commands import command
from mjx_reinforce.engine.checks import check_name, check_type, nearest, read_as, spoken_kind
from mjx_reinforce.engine.memory import gigabytes, host_memory
from mjx_reinforce.files import naming_damage
from mjx_reinforce.settings.config import (
    Config,
    changed,
    check,
    check_each,
    check_read,
    flag,
    is_read,
    spoken,
)
from mjx_reinforce.settings.groups import LogSettings
from mjx_reinforce.statistics import enough
from mjx_reinforce.training.resume import as_config, read_record, recordable

#: What writing curves.npz and a report needs for a run with two evaluations (bytes).
_RESULT_BYTES = 760


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """What is swept, and how its runs are spread."""

    over: tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]] = ()
    """A setting and its values, such as `learning-rate 1e-3 3e-3`. Repeat it for more settings: all
    combinations are trained. Write layers as 32,32 (none: a linear policy)."""
    chunk_runs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most runs that train at the same time. If not given, as many as fit in memory."""
    exact: bool = False
    """Train one run at a time, on one device. No bit of a result then depends on other runs,
    chunks, or the number of devices. It takes many times as long."""
    until_decided: bool = False
    """Train an eighth of --num-seeds at a time, and stop when one configuration is surely the best.
    Configurations that are surely below another get no more seeds. Each such statement, over all
    looks and pairs together, is wrong at most 5% of the time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """A run, or a sweep, its values read.

    base: the settings of all runs but those that are swept, and where its directory is
    over: the values of each setting that is swept; nothing of a run, which is one configuration
    default: the settings that hold where the user gave none; at least one configuration must read
      each that differs. None where nobody chose
    exact: see ``SweepSettings``
    chunk_runs: see ``SweepSettings``
    until_decided: see ``SweepSettings``
    """

    base: Config
    over: Mapping[str, Sequence[Any]] = dataclasses.field(default_factory=dict)
    default: Config | None = None
    exact: bool = False
    chunk_runs: int | None = None
    until_decided: bool = False

    @property
    def is_sweep(self) -> bool:
        """Whether it is a sweep; a run is one configuration, and goes over nothing."""
        return bool(self.over)

    @property
    def kind(self) -> str:
        """What people call it: a run or a sweep."""
        return "sweep" if self.is_sweep else "run"

    @property
    def chosen_names(self) -> tuple[str, ...]:
        """The names of the settings that the user chose."""
        return () if self.default is None else changed(self.base, self.default)

    @functools.cached_property
    def directory(self) -> Path:
        """Where its files are; ``runs/<env>-<time>`` if nobody said."""
        time_stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")[:-3]
        # The id of a user's own task is module:Class, and some file systems refuse the colon.
        default_directory = Path("runs") / f"{self.base.env.replace(':', '.')}-{time_stamp}"
        return self.base.resume or self.base.output or default_directory

    def count(self) -> int:
        """Returns how many configurations it has."""
        return math.prod(map(len, self.over.values()))

    @functools.cached_property
    def configurations(self) -> list[dict[str, Any]]:
        """The values of what is swept, in each configuration; the last changes fastest."""
        combinations = itertools.product(*self.over.values())
        return [dict(zip(self.over, combination, strict=True)) for combination in combinations]

    @functools.cached_property
    def configs(self) -> list[Config]:
        """The settings of each configuration."""
        return [_with_values(self.base, values) for values in self.configurations]


def as_record(design: Design) -> dict[str, Any]:
    """Returns what sweep.json says of a design: all that decides its numbers."""
    swept_values = {name: list(setting_values) for name, setting_values in design.over.items()}
    return {
        "settings": recordable(design.base),
        "over": swept_values,
        "exact": design.exact,
        "until_decided": design.until_decided,
    }


def read_design(directory: Path) -> Design:
    """Returns the design of the run or the sweep in a directory, for going on with it.

    Raises:
      ValueError: there is none, or its first file is damaged or of another version.
    """
    record = read_record(directory)
    # Of the first files that of a sweep alone has this entry.
    if "over" not in record:
        record_path = directory / "config.json"
        with naming_damage(record_path):
            check_type("resumed", record.get("resumed", []), list)
        base = as_config(record, record_path)
        return Design(base=dataclasses.replace(base, resume=directory))
    record_path = directory / "sweep.json"
    with naming_damage(record_path):
        settings = dict(record["settings"])
        is_exact = record["exact"]
        # Sweeps of earlier versions of the package train all their seeds, and do not say so.
        until_decided = record.get("until_decided", False)
        # JSON has no tuples: a list among the values is one of layers, as ``read_over`` has it.
        swept_values = {
            name: [tuple(x) if isinstance(x, list) else x for x in values]
            for name, values in record["over"].items()
        }
    base = dataclasses.replace(as_config(settings, record_path), resume=directory)
    return Design(base=base, over=swept_values, exact=is_exact, until_decided=until_decided)


def check_design(design: Design) -> None:
    """Raises ValueError for what makes no sense, before anything heavy is imported.

    A configuration reads each setting that is swept, and one of them each that was given.
    """
    if design.is_sweep:
        _check_sweep(design)
    check_each(design.base)
    # By the count alone: ``design.configs`` below would itself fill the memory.
    num_runs = design.count() * design.base.num_policies
    if num_runs * _RESULT_BYTES > host_memory():
        raise ValueError(
            f"the results of {num_runs:,} runs do not fit into memory: they need about "
            f"{gigabytes(num_runs * _RESULT_BYTES)}, {gigabytes(host_memory())} are here; lower "
            "--num-seeds, --race or the number of values after --over"
        )
    for config, configuration in zip(design.configs, design.configurations, strict=True):
        check(config)
        check_read(config, configuration or design.chosen_names)
    # In a sweep a setting may be of use to some configurations alone. Where none reads it, the
    # first one stands for all in the message.
    for name in set(design.chosen_names).difference(design.over):
        if not any(is_read(name, config) for config in design.configs):
            check_read(design.configs[0], [name])


def _check_sweep(design: Design) -> None:
    """Raises ValueError for what makes no sense in a sweep."""
    for name in ("minutes", "init_from", "race"):
        if getattr(design.base, name) != getattr(Config, name):
            raise ValueError(f"{flag(name)} is for one run, not for a sweep: leave it out")
    if design.chunk_runs is not None and design.chunk_runs < 1:
        raise ValueError(f"--chunk-runs must be at least 1, got {design.chunk_runs}")
    if design.until_decided:
        _check_until_decided(design.base)
    check_over(design.base, design.over)


def _check_until_decided(base: Config) -> None:
    """Raises ValueError if no test of so many seeds, or of these seeds, can decide a sweep."""
    if base.seeds is not None:
        raise ValueError(
            f"--until-decided looks at all seeds, and --seeds {base.seeds} is a share of them: "
            "leave one out"
        )
    if not enough(base.num_seeds):
        raise ValueError(
            f"--until-decided cannot decide with {base.num_seeds} seeds: raise --num-seeds, the "
            "most seeds of a configuration, to 6 or more, such as 64"
        )


_SETTINGS = {field.name: field for field in dataclasses.fields(Config)}
#: What comes before the name of a setting of the environment, such as env_set.frame_skip.
_ENV_PREFIX = "env_set."
#: Settings of an environment that all configurations of a sweep share, and why.
_SHARED_ENV_SETTINGS = {
    "max_episode_steps": "--over horizon says how long episodes are",
    "reward_threshold": "its report has one return that counts as solved",
}
_OVER_WORDS = "such as --over learning-rate 1e-3 1e-2"


def read_over(flags: Sequence[Sequence[str]]) -> dict[str, list[Any]]:
    """Returns the values of each setting from ``--over NAME VALUE VALUE ...``, in that order.

    Args:
      flags: the words after each ``--over``.

    Raises:
      ValueError: a setting does not exist or stands twice, or a value is not of its type.
    """
    swept_values: dict[str, list[Any]] = {}
    for words in flags:
        if not words:
            raise ValueError(f"--over needs a setting and its values, {_OVER_WORDS}")
        name = words[0].removeprefix("--").replace("-", "_")
        if name not in _SETTINGS and not _of_env(name):
            raise ValueError(_unknown(words[0].removeprefix("--")))
        if name in swept_values:
            raise ValueError(f"--over {words[0]} is given twice: put all values behind one of them")
        swept_values[name] = [_value(name, value_word) for value_word in words[1:]]
    return swept_values


def _of_env(name: str) -> str | None:
    """Returns the setting of the environment that a name after --over means, if it is one."""
    setting = name.removeprefix(_ENV_PREFIX)
    return setting if setting != name and setting.isidentifier() else None


def _unknown(setting_word: str) -> str:
    """Returns the message about a word that is no setting."""
    # The field's word for it is too far from our name to be found by spelling.
    if setting_word == "distribution":
        nearest_name: str | None = "policy"
    else:
        nearest_name = nearest(setting_word, [spoken(name) for name in _SETTINGS])
    hint = f" Did you mean {nearest_name!r}?" if nearest_name else ""
    return f"unknown setting {setting_word!r} after --over.{hint} (--help lists the settings.)"


def check_swept(over: Mapping[str, Sequence[Any]]) -> None:
    """Raises ValueError where a sweep goes over nothing."""
    if not over:
        raise ValueError(
            f"nothing is swept: give --over a setting and its values, {_OVER_WORDS}, or train one "
            f"configuration by {command('train')}"
        )


def check_over(base: Config, over: Mapping[str, Sequence[Any]]) -> None:
    """Raises ValueError for settings that cannot be swept, or values that make no choice."""
    for field in dataclasses.fields(LogSettings):
        if getattr(base, field.name):
            raise ValueError(
                f"{flag(field.name)} logs a run; leave it out: a sweep writes curves.npz"
            )
    for name, values in over.items():
        env_setting = _of_env(name)
        if env_setting:
            reason = _SHARED_ENV_SETTINGS.get(env_setting)
        else:
            check_name("setting", name, _SETTINGS)
            reason = _SETTINGS[name].metadata.get("once")
        if reason:
            raise ValueError(f"a sweep cannot go over {spoken(name)}: {reason}")
        if len(values) < 2:
            if not values:
                remedy = f", {_OVER_WORDS}"
            elif env_setting:
                remedy = f"; for one value pass --env-set {env_setting}={values[0]}"
            else:
                remedy = f"; for one value pass {flag(name)}"
            raise ValueError(f"--over {spoken(name)} needs two values or more{remedy}")
        # Two equal configurations would have the same seeds, and so count each result twice.
        repeats = [x for index, x in enumerate(values) if x in values[:index]]
        if repeats:
            raise ValueError(f"--over {spoken(name)} has the value {repeats[0]} twice")


def _with_values(base: Config, configuration: Mapping[str, Any]) -> Config:
    """Returns settings with other values, also of settings of the environment."""
    config_values = {}
    env_words = {}
    for name, value in configuration.items():
        if env_setting := _of_env(name):
            env_words[env_setting] = f"{env_setting}={value}"
        else:
            config_values[name] = value
    config = dataclasses.replace(base, **config_values)
    if not env_words:
        return config
    # The base may set what is swept, too, and an environment refuses a setting that stands twice.
    base_words = [word for word in config.env_set if word.partition("=")[0] not in env_words]
    return dataclasses.replace(config, env_set=(*base_words, *env_words.values()))


def _value(name: str, value_word: str) -> Any:
    """Returns a word of the command line as a value of a setting's type.

    The environment reads its own settings.
    """
    value_type = (int | float | str) if _of_env(name) else _SETTINGS[name].type
    with contextlib.suppress(ValueError):
        return read_as(value_type, value_word)
    type_in_words = spoken_kind(value_type)
    if get_origin(value_type) is tuple:
        type_in_words = "layers, such as 32,32, or none"
    elif "," in value_word:
        type_in_words += "; write spaces between values"
    raise ValueError(f"--over {spoken(name)} has the value {value_word!r}, not {type_in_words}")

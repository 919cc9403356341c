"""All settings of a run side by side, as config.json shows them, and the rules they obey."""

import dataclasses
import enum
import functools
import importlib.util
import reprlib
import shlex
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mjx_reinforce import envs
from mjx_reinforce.engine.checks import MAX_OF_UPDATE, changed_fields, check_type
from mjx_reinforce.envs.settings import split_words
from mjx_reinforce.registry import (
    ALGORITHMS,
    DISTRIBUTIONS,
    ESTIMATORS,
    check_choice,
    find_algorithm,
    is_own,
)
from mjx_reinforce.settings.declare import MAX_COUNT as MAX_COUNT
from mjx_reinforce.settings.declare import Range
from mjx_reinforce.settings.groups import (
    CheckpointSettings,
    EstimatorSettings,
    EvaluationSettings,
    LogSettings,
    PolicySettings,
    Reader,
    RunSettings,
    UpdateSettings,
)

#: A block of so many updates has room for them whatever the budget is; it takes little memory.
_ALWAYS_ROOM = 100


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(
    LogSettings,
    CheckpointSettings,
    EvaluationSettings,
    UpdateSettings,
    EstimatorSettings,
    PolicySettings,
    RunSettings,
):
    """Train policies, many seeds at once, and report over the seeds.

    Examples:
      >>> import dataclasses
      >>> import mjx_reinforce as mr
      >>> config = mr.of_task("CartPole-v1", env_steps=20_000)
      >>> dataclasses.replace(config, num_seeds=8).num_seeds, config.env_steps
      (8, 20000)
    """

    def __repr__(self) -> str:
        return f"Config({changed_fields(self)})"

    @property
    def first_seed(self) -> int:
        """The number of the first seed."""
        if self.seeds is None:
            return 0
        return read_seeds(self.seeds).start

    @property
    def num_policies(self) -> int:
        """How many policies are trained side by side: those that race, of all seeds."""
        return self.num_seeds * self.race

    @property
    def episodes_per_update(self) -> int:
        """Episodes that a seed plays for an update."""
        return find_algorithm(self.algorithm).search_episodes or self.num_episodes

    def training_horizon(self, horizon: int) -> int:
        """Returns the time limit of a training episode of a task, in env steps.

        Where only the first are cut it is that of the others.

        Args:
          horizon: the task's own time limit.
        """
        limit = self.horizon or horizon
        # Once --whole-after is reached no episode is cut, and the programs must have room for that.
        if self.whole_after < 1 or not self.train_horizon:
            return limit
        return min(limit, self.train_horizon)

    def env_steps_at(self, num_updates: int) -> int | None:
        """Returns the budget in env steps after so many updates.

        That is ``env_steps``, unless ``budgets`` says how it came about.
        """
        if self.budgets[-1:] != (self.env_steps,):  # another budget was given since
            return self.env_steps
        pairs = zip(self.budgets[::2], self.budgets[1::2], strict=True)
        past_budgets = [env_steps for update, env_steps in pairs if update <= num_updates]
        return (past_budgets or [self.env_steps])[-1]

    def with_budget(self, num_updates: int, env_steps: int) -> "Config":
        """Returns the settings with another budget in env steps from an update on."""
        past_budgets = self.budgets if self.budgets[-1:] == (self.env_steps,) else ()
        budgets = (*past_budgets, num_updates, env_steps)
        return dataclasses.replace(self, minutes=None, env_steps=env_steps, budgets=budgets)

    @property
    def block_length(self) -> int:
        """How many updates a block between two evaluations has room for.

        That is ``eval_every``, but where it is great no more than the budget can need, at one step
        an episode. A block that is shorter anyway does not depend on the budget, so that a run with
        another budget finds its programs in the compilation cache.
        """
        # A block ends where the budget does, so none is longer than the whole run.
        bounds = [self.eval_every]
        if self.max_updates is not None:
            bounds.append(self.max_updates)
        # An episode has one step or more, so so many updates use up the budget in any case.
        if self.env_steps is not None:
            bounds.append(-(-self.env_steps // self.episodes_per_update))
        return min(self.eval_every, max(_ALWAYS_ROOM, min(bounds)))


def read_seeds(text: str) -> range:
    """Returns the numbers of seeds that --seeds names, or raises ValueError."""
    first_seed, _, end_seed = text.partition(":")
    # ``int`` alone would take signs, spaces, underscores and the digits of other scripts.
    is_number = all(word.isascii() and word.isdigit() for word in (first_seed, end_seed))
    if not (is_number and int(first_seed) < int(end_seed) <= MAX_OF_UPDATE):
        raise ValueError(
            f"--seeds must be FIRST:END, such as 64:128, got {text!r}; --num-seeds says how many"
        )
    return range(int(first_seed), int(end_seed))


@functools.cache
def marked(mark: enum.Enum) -> tuple[str, ...]:
    """Returns the names of the settings that are declared with a mark."""
    init_fields = dataclasses.fields(Config)
    return tuple(field.name for field in init_fields if mark in field.metadata.get("marks", ()))


def check(config: Config) -> None:
    """Raises ValueError for settings that make no sense: what, the value, the remedy."""
    check_each(config)
    if config.env_steps is None and config.max_updates is None:
        raise ValueError("nothing would end this run: give --env-steps or --max-updates a number")
    if config.algorithm == "reinforce":
        _check_reinforce(config)


def check_each(config: Config) -> None:
    """Raises ValueError for a setting that makes no sense whatever the others are."""
    for field in dataclasses.fields(Config):
        check_type(flag(field.name), getattr(config, field.name), field.type)
    if config.seeds is not None and len(read_seeds(config.seeds)) != config.num_seeds:
        raise ValueError(
            f"--seeds {config.seeds} names {len(read_seeds(config.seeds))} seeds, and num_seeds is "
            f"{config.num_seeds}: make them agree"
        )
    if len(config.budgets) % 2 or not all(0 <= x <= MAX_COUNT for x in config.budgets):
        raise ValueError(
            "--budgets must be pairs of an update and env steps, from 0 to 2^53, got "
            f"{config.budgets}"
        )
    # Before hours of training, and not where the first row is logged.
    for name in config.log:
        _check_installed(name)
    if not config.env:
        raise ValueError(
            "no environment is named: add --env, such as --env my_robot:MyRobot for the class "
            "MyRobot in my_robot.py"
        )
    envs.check_id(config.env)
    split_words(config.env_set)
    choices = {
        "algorithm": ALGORITHMS,
        "policy": {"auto": None} | DISTRIBUTIONS,
        "estimator": ESTIMATORS,
    }
    for kind, definitions in choices.items():
        check_choice(kind, getattr(config, kind), definitions)
    for rule in Range:
        for name in marked(rule):
            value = getattr(config, name)
            # None and words, such as "budget", are no numbers, and ``check_type`` let them pass.
            if not (value is None or isinstance(value, str) or rule.holds(value)):
                raise ValueError(f"{flag(name)} must be {rule.words}, got {reprlib.repr(value)}")
    last_seed = config.first_seed + config.num_seeds - 1
    if (last_seed + 1) * config.race > MAX_OF_UPDATE:
        raise ValueError(
            f"--race {config.race} has no random numbers for seed {last_seed:,}: a race of seed n "
            f"takes those of the seeds from {config.race} n on; lower one of them"
        )


#: The package that each log needs.
_LOG_PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}


def _check_installed(log: str) -> None:
    """Raises ValueError if a log's package is missing; imports nothing."""
    package = _LOG_PACKAGES[log]
    spec = importlib.util.find_spec(package)
    # A folder of that name, such as W&B leaves, is found too, but has no origin.
    if spec is None or spec.origin is None:
        raise ValueError(
            f"--log {log} needs the package {package}, which is not installed; pip install "
            f"{package}, or leave {log} out"
        )


def flag(name: str) -> str:
    """Returns the flag of a setting."""
    return f"--{spoken(name)}"


def spoken(name: str) -> str:
    """Returns the name of a setting as people write it, such as learning-rate."""
    return name.replace("_", "-")


def _check_reinforce(config: Config) -> None:
    """Raises ValueError for settings that do not go together."""
    if config.estimator.startswith("leave-one-out") and config.num_episodes < 2:
        raise ValueError(
            f"{config.estimator} needs at least two episodes per update, got --num-episodes "
            f"{config.num_episodes}; raise it or choose --estimator reward-to-go"
        )
    if config.policy == "deterministic":
        raise ValueError(
            "--policy deterministic has no log-probability for --algorithm reinforce to follow; "
            "choose --policy auto or --algorithm ars"
        )
    if config.update == "natural-gradient" and config.max_kl is None:
        raise ValueError(
            "--update natural-gradient has the length of its steps from --max-kl, which is None: "
            "give a number, such as 0.01"
        )


#: What a policy reads, or not.
_POLICIES = (Reader.FREE_STD, Reader.STD)


def is_read(name: str, config: Config) -> bool:
    """Returns whether anything reads a setting in a run."""
    return all(reader.holds(config) for reader in Reader if name in marked(reader))


def check_read(config: Config, chosen_names: Collection[str]) -> None:
    """Raises ValueError for settings that a user gave and that nothing would read.

    Args:
      config: the settings.
      chosen_names: of those that the user gave.
    """
    for reader in Reader:
        idle_settings = [name for name in marked(reader) if name in chosen_names]
        if idle_settings and not reader.holds(config):
            flags = " ".join(as_flag(name, getattr(config, name)) for name in idle_settings)
            pronoun = "it" if len(idle_settings) == 1 else "them"
            raise ValueError(
                f"{flags} would do nothing: only {reader.words} reads that; leave {pronoun} out, "
                f"or choose {reader.words}"
            )


def check_read_by_policy(config: Config, default: Config, policy: str) -> None:
    """Raises ValueError for settings that a user changed and that the policy does not read.

    Args:
      config: the settings.
      default: those that hold where the user gave none.
      policy: the distribution that stands for ``auto``, which depends on the environment.
    """
    policy_names = {name for reader in _POLICIES for name in marked(reader)}
    # ``auto`` reads all of them; the distribution that it stands for may not.
    config_of_policy = dataclasses.replace(config, policy=policy)
    check_read(config_of_policy, policy_names.intersection(changed(config, default)))


def changed(config: Config, default: Config) -> tuple[str, ...]:
    """Returns the names of the settings in which two differ."""
    setting_names = (field.name for field in dataclasses.fields(Config))
    return tuple(name for name in setting_names if getattr(config, name) != getattr(default, name))


def as_flag(name: str, value: object) -> str:
    """Returns a setting as it stands on the command line."""
    return " ".join(as_words(name, value))


def as_words(name: str, value: object) -> list[str]:
    """Returns the words of a setting on the command line; None, text, numbers or lists of them."""
    entries = value if isinstance(value, tuple | list) else (value,)
    return [flag(name), *map(str, entries)]


#: Settings that may name code of the user's own, which runs only where the command line names it:
#: the files of a run may be another's, and they name modules to import.
CODE = ("env", "algorithm", "estimator", "policy")


def code_flags(settings: Mapping[str, Any]) -> str:
    """Returns what a command that goes on with a run, or plays its policies, has at its end.

    Args:
      settings: of the run; those that name no code, or are none of ``CODE``, are left out.
    """
    own_code = {name: settings[name] for name in CODE if is_own(settings.get(name, ""))}
    return "".join(f" --{name} {shlex.quote(value)}" for name, value in own_code.items())


def check_named(
    settings: Mapping[str, Any], named: Mapping[str, str | None], directory: Path
) -> None:
    """Raises ValueError if a command would import code that only a file names.

    Args:
      settings: as the files of a run say; ``CODE`` says which of them may name code.
      named: the same as the command line says, where it does.
      directory: of the run.
    """
    # A damaged id is refused as such, before anyone is asked to trust it.
    envs.check_id(settings["env"])
    for name in CODE:
        value = settings.get(name, "")
        if is_own(value) and named.get(name) != value:
            # No proposal to run what is not even of the form module:name.
            check_choice(name, value, {})
            relation = "on" if name == "env" else f"with --{name}"
            raise ValueError(
                f"{directory} was trained {relation} {value}, and this would run that code; if you "
                f"trust it, add{code_flags(settings)} to the command"
            )

"""What a task is, for people: its sizes, its rules, and its default settings."""

import dataclasses
import inspect
from typing import TYPE_CHECKING

import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.console.commands import command
from mjx_reinforce.engine.base import Environment
from mjx_reinforce.settings import tables
from mjx_reinforce.settings.config import Config, as_flag, changed, is_read
from mjx_reinforce.settings.defaults import of_task

if TYPE_CHECKING:
    from mjx_reinforce.envs.base import MujocoEnv

#: Settings of the defaults that a sentence of their own says.
_SAID = ("env", "num_seeds", "env_steps")


def about_task(id: str) -> str:
    """Returns a page about a task, of paragraphs and lists.

    Args:
      id: of ours, or module:Class.

    Raises:
      ValueError: there is none, or it cannot be built.
    """
    env, config = envs.make(id), of_task(id)
    doc = inspect.cleandoc(type(env).__doc__ or "").replace("``", "`")
    said = (" ".join(paragraph.split()) for paragraph in doc.split("\n\n") if paragraph)
    return "\n\n".join([id, _sizes(id, env), *said, *_settings(env), *_how_to_train(config)])


def _sizes(id: str, env: "MujocoEnv") -> str:
    """Returns the sizes of a task, a line each."""
    from mjx_reinforce.engine.base import observation_size

    known = tables.TASKS.get(id)
    observation = observation_size(env) if known is None else known.observation
    limit = getattr(env, "max_episode_steps", None)
    threshold = getattr(env, "reward_threshold", None)
    seconds = f", of {env.dt:g} s each" if hasattr(env, "dt") else ""
    facts = {
        "observation": f"{observation} numbers",
        "action": _action_in_words(env),
        "episode": f"at most {limit:,} env steps{seconds}" if limit else "give --horizon a number",
        "solved": "the task names no return"
        if threshold is None
        else f"at a return of {threshold:,g}",
    }
    return "\n".join(f"  {name:11}  {fact}" for name, fact in facts.items())


def _settings(env: Environment) -> list[str]:
    """Returns the settings of a task and their values, one a line, if it has any."""
    settings = getattr(env, "settings", None)
    if not dataclasses.is_dataclass(settings):
        return []
    fields = dataclasses.fields(settings)
    lines = [f"  {f.name}={_as_text(getattr(settings, f.name))}" for f in fields if f.init]
    return ["\n".join(["Its settings, which --env-set NAME=VALUE changes:", *lines])]


def _as_text(value: object) -> str:
    """Returns the value of a setting as ``--env-set`` reads it."""
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _action_in_words(env: Environment) -> str:
    from mjx_reinforce.engine.base import Discrete, action_space

    space = action_space(env)
    if isinstance(space, Discrete):
        return f"one of {space.num_actions}"
    bounds = np.unique(np.stack([space.low, space.high], axis=1), axis=0)
    ranges = " or ".join(f"[{low:g}, {high:g}]" for low, high in bounds)
    count = len(space.low)
    return f"{count} number{'s' * (count > 1)} in {ranges}"


def _how_to_train(config: Config) -> list[str]:
    """Returns how to train on a task, and with which settings."""
    said = [
        f"To train {config.num_seeds} seeds for {config.env_steps:,} env steps each:",
        f"  {command('train')} --env {config.env}",
        "--minutes M sets a time in place of a number of env steps.",
    ]
    differing = (name for name in changed(config, Config()) if name not in _SAID)
    names = [name for name in differing if is_read(name, config)]
    if names:
        flags = "\n".join(f"  {as_flag(name, getattr(config, name))}" for name in names)
        said.append(f"Its default settings, where other tasks have others:\n{flags}")
    return said

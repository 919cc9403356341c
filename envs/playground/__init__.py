"""Tasks of MuJoCo Playground, as they are, with their physics computed by the engines here.

Nothing of Playground is imported before a task is asked for.
"""

import dataclasses
import functools
import importlib
from collections.abc import Callable
from typing import Any

from mjx_reinforce.engine.checks import BadEnvironmentError, check_name, explain, require
from mjx_reinforce.envs.playground.task import PlaygroundEnv as PlaygroundEnv


def builder(name: str) -> Callable[..., PlaygroundEnv]:
    """Returns a function that builds a task; its ``Settings`` are those of the configuration."""
    config = _registry(name).get_default_config(name)
    entries = [
        (entry, type(content), content)
        for entry, content in config.items()
        if type(content) in (bool, int, float, str)
    ]
    build: Any = functools.partial(load, name)
    build.__name__ = name
    build.Settings = dataclasses.make_dataclass(f"{name}Settings", entries, kw_only=True)
    return build


def load(name: str, **overrides: object) -> PlaygroundEnv:
    """Returns a task of Playground's registry.

    Args:
      name: such as "WalkerRun".
      **overrides: entries of its configuration by their names.

    Raises:
      ValueError: Playground is not installed, has no such task or entry, or lacks the robot's
        files.
    """
    registry = _registry(name)
    config = registry.get_default_config(name)
    for entry in overrides:
        check_name(f"entry of the configuration of {name}", entry, config)
    implementation = {"impl": "jax"} if "impl" in config else {}
    return PlaygroundEnv(registry.load(name, config_overrides=implementation | overrides))


def _registry(name: str) -> Any:
    """Returns Playground's registry, if it has a task and all that the task needs.

    Raises:
      ValueError: it does not. Playground would download a robot.
    """
    try:
        package = importlib.import_module("mujoco_playground")
    except ImportError as error:
        raise BadEnvironmentError(
            f"cannot import Playground: {explain(error)}; pip install 'mjx-reinforce[playground]'"
        ) from error
    check_name("task of Playground", name, dict.fromkeys(package.registry.ALL_ENVS))
    mjx_env = importlib.import_module("mujoco_playground._src.mjx_env")
    folder = mjx_env.MENAGERIE_PATH
    require(
        name in package.dm_control_suite.ALL_ENVS or folder.exists(),
        f"{name} needs MuJoCo Menagerie in {folder}, where there is nothing: link your copy there, "
        "or clone https://github.com/google-deepmind/mujoco_menagerie and check out "
        f"{mjx_env.MENAGERIE_COMMIT_SHA}",
    )
    return package.registry

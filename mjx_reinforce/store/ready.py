"""A run made ready: what its settings come to, and its programs before they are compiled."""

import dataclasses
import functools
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from mjx_reinforce import envs
from mjx_reinforce.engine.base import Environment
from mjx_reinforce.learning.learner import Learner
from mjx_reinforce.settings.config import Config, check_read_by_policy
from mjx_reinforce.store import kept
from mjx_reinforce.store.build import build, policy_settings
from mjx_reinforce.training.division import Division, divide_run
from mjx_reinforce.training.programs import Programs, programs_of


class Ready(NamedTuple):
    """What a run is made of.

    horizon: the time limit of an episode in steps
    threshold: the return that counts as solved, if any
    policy: how to rebuild its policy, see ``policy_files.save_policy``
    engine: the name of what plays the episodes
    why: the reason it was chosen, for people
    programs: () -> those of the runs, before they are compiled; made when they are first asked for
    """

    horizon: int
    threshold: float | None
    policy: dict[str, Any]
    engine: str
    why: str
    programs: Callable[[], Programs]


def get_ready(
    config: Config,
    default: Config,
    env: Environment | None = None,
    division: Division | None = None,
    traced: Collection[str] | None = None,
) -> Ready:
    """Returns what the settings come to; those of a run from disk, if they did before.

    Args:
      config: the settings.
      default: those that hold where the user gave none.
      env: the environment; by default the one that the settings name, built if it is needed.
      division: see ``made``.
      traced: see ``made``.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    division = division or divide_run(config)
    key = kept.key_of(config) if traced is None else None
    ready = None if key is None else _found(key, config, division)
    if ready is None:
        built = envs.make_set(config.env, config.env_set) if env is None else env
        ready = made(built, config, division, traced)
        if key is not None:
            facts = ready._asdict()
            del facts["programs"]
            whole = kept.keep(key, facts, ready.programs())
            ready = ready._replace(programs=lambda: whole)
    if config.resume is None and config.policy == "auto":
        check_read_by_policy(config, default, ready.policy["policy"])
    return ready


def _found(key: str, config: Config, division: Division) -> Ready | None:
    """Returns what is on disk of the settings; None if nothing is."""
    found = kept.read_programs(key)
    if found is None and config.resume is not None:
        # A run that is resumed has its time limit from config.json, also one that was not given.
        first = kept.key_of(dataclasses.replace(config, horizon=None))
        found = None if first is None else kept.read_programs(first)
        if found is not None and found[0]["horizon"] != config.horizon:
            return None
    if found is None:
        return None
    facts, programs = found
    programs = programs._replace(division=division)
    return Ready(**facts, programs=lambda: programs)


def made(
    env: Environment,
    config: Config,
    division: Division | None = None,
    traced: Collection[str] | None = None,
) -> Ready:
    """Returns what the settings come to in an environment.

    Args:
      env: what is trained on.
      config: the settings.
      division: among which devices they are divided; by default as ``divide_run`` says.
      traced: of a sweep, the names of the settings that differ from run to run of its programs.
        None of a run, whose programs measure more.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    division = division or divide_run(config)
    devices = division.devices() if division.episodes > 1 else None
    learner, horizon = build(env, config, devices=devices)
    threshold = getattr(env, "reward_threshold", None)

    def build_learner(settings: dict[str, Any]) -> Learner:
        if not settings:
            return learner
        if config.algorithm != "reinforce":
            return build(env, dataclasses.replace(config, **settings))[0]
        # How REINFORCE plays depends on no traced number, and takes a second to write out.
        other = build(env, dataclasses.replace(config, engine="vmap", **settings))[0]
        return learner._replace(init=other.init, learn=other.learn)

    @functools.cache
    def programs() -> Programs:
        width = division.width(config.num_seeds) if traced is None else 1
        return programs_of(
            *(env, build_learner, horizon, config, width, traced or ()),
            whole=traced is None,
            division=division,
        )

    return Ready(
        horizon=horizon,
        threshold=None if threshold is None else float(threshold),
        policy=policy_settings(env, config),
        engine=learner.engine.name,
        why=learner.engine.why,
        programs=programs,
    )

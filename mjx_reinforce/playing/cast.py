"""Who plays in a film: seeds of a run, a policy of the package, or one before training.

Where a command names no run, it is about the newest.
"""

from pathlib import Path
from typing import Any, NamedTuple

from mjx_reinforce.console.commands import command
from mjx_reinforce.export.player import Player
from mjx_reinforce.export.run_files import Run, choose_seed, is_pretrained, provenance_of, read_run


class PolicySource(NamedTuple):
    """Where policies come from.

    env: the id of their environment
    horizon: its time limit in env steps
    run: the run directory; None where the policy is the package's
    """

    env: str
    horizon: int
    run: Run | None


class Role(NamedTuple):
    """A policy that plays.

    label: what a picture says of it
    name: what a message says of it
    player: the policy
    """

    label: str
    name: str
    player: Any


def read_source(place: Path) -> PolicySource:
    """Returns the run of a directory, or the policy of the package for a task of that name.

    Raises:
      ValueError: there is neither, or the run has no policy yet.
    """
    if is_pretrained(place):
        return PolicySource(str(place), provenance_of(str(place))["horizon"], None)
    run = read_run(place)
    return PolicySource(run.env, run.horizon, run)


def main_seed(settings: Any, source: PolicySource) -> int:
    """Returns the number of the seed that plays.

    Raises:
      ValueError: the run has no such seed; or settings ask for another than the package's.
    """
    if source.run is not None:
        return choose_seed(source.run, settings.seed, settings.which)
    beside = settings.beside not in (None, "untrained")
    if settings.seed != "best" or settings.which != "last" or beside:
        raise ValueError(
            f"the package has one policy for {source.env}; leave --seed, --which and --beside out "
            "(but for --beside untrained), or give a run directory"
        )
    return provenance_of(source.env)["seed"]


def cast(settings: Any, source: PolicySource) -> list[Role]:
    """Returns the policies that play, from left to right; the last is the one asked for.

    Args:
      settings: ``seed``, ``which`` and ``beside``, as in ``watch.WatchSettings``.
      source: of the policies.

    Raises:
      ValueError: the run has no such seed, or a file is damaged.
    """
    main = _role(settings.seed, settings, source)
    if settings.beside is None:
        return [main._replace(label=source.env)]
    if settings.beside == "untrained":
        before = Role("before training", "untrained", untrained(main.player))
        return [before, main._replace(label="after training")]
    return [_role(settings.beside, settings, source), main]


def _role(seed: Any, settings: Any, source: PolicySource) -> Role:
    from mjx_reinforce.export.player import load_pretrained, load_seed

    if source.run is None:
        return Role(source.env, "the package's policy", load_pretrained(source.env)[0])
    player, _ = load_seed(source.run, seed, settings.which, settings.policy)
    rank = f" ({seed})" if isinstance(seed, str) else ""
    return Role(f"seed {player.seed}{rank}", f"seed {player.seed}", player)


def untrained(player: Player) -> Any:
    """Returns a player whose policy has random parameters, as training begins with."""
    import jax

    from mjx_reinforce.policies import normalize
    from mjx_reinforce.policies.actor import Actor

    params = player.policy.init(jax.random.key(player.seed))
    actor = Actor(params=params, normalizer=normalize.init(player.observation_size))
    return player._replace(actor=actor)


#: Where runs are put that name no other place, see ``runs.directory.choose_directory``.
RUNS = Path("runs")


def choose_run(directory: Path) -> Path:
    """Returns a directory, or of a folder of runs the one whose policies were written last.

    Raises:
      ValueError: the directory is ``RUNS``, and has no run that has policies.
    """
    if (directory / "config.json").exists():
        return directory
    policies = [x for x in directory.glob("*/policy") if (x.parent / "config.json").exists()]
    if policies:
        return max(policies, key=lambda policy: policy.stat().st_mtime).parent
    if directory == RUNS:
        raise ValueError(
            f"no run was named, and the folder {directory} has none: {command('train')} trains "
            f"one; one elsewhere is named as in {command('watch')} DIRECTORY"
        )
    return directory

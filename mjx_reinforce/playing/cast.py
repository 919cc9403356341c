"""Who plays in a film: seeds of a run, a policy of the package, or one before training."""

from pathlib import Path
from typing import Any, NamedTuple

from mjx_reinforce.export.player import Player
from mjx_reinforce.export.pretrained import is_pretrained, provenance_of
from mjx_reinforce.export.run_files import Run, choose_seed, read_run


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

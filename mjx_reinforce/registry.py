"""Tables from the names a user types to the definitions, imported only when chosen."""

import difflib
import importlib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

#: Action distributions: name -> "module:function" of an action space.
DISTRIBUTIONS = {
    "normal": "mjx_reinforce.policies.distributions.normal:normal",
    "normal-softplus": "mjx_reinforce.policies.distributions.normal:normal_softplus",
    "normal-sigmoid": "mjx_reinforce.policies.distributions.normal:normal_sigmoid",
    "truncated-normal": "mjx_reinforce.policies.distributions.truncated_normal:truncated_normal",
    "clipped-normal": "mjx_reinforce.policies.distributions.clipped_normal:clipped_normal",
    "tanh-normal": "mjx_reinforce.policies.distributions.tanh_normal:tanh_normal",
    "deterministic": "mjx_reinforce.policies.distributions.deterministic:deterministic",
    "categorical": "mjx_reinforce.policies.distributions.categorical:categorical",
}

#: Gradient estimators: name -> "module:function" of a discount.
ESTIMATORS = {
    "total-return": "mjx_reinforce.learners.estimators:total_return",
    "reward-to-go": "mjx_reinforce.learners.estimators:reward_to_go",
    "leave-one-out": "mjx_reinforce.learners.estimators:leave_one_out",
    "value-baseline": "mjx_reinforce.learners.value_baseline:value_baseline",
    "mean-log-prob": "mjx_reinforce.learners.estimators:mean_log_prob",
    "normalized-returns": "mjx_reinforce.learners.estimators:normalized_returns",
}

#: How alike names are, as ``difflib`` counts, of which a third of the letters differ.
_ALIKE = 0.66


def check_name(kind: str, name: str, known: Mapping[str, Any]) -> None:
    """Raises ValueError for a name that is not known, with the known ones and the nearest.

    Args:
      kind: what is named, for the message.
      name: what the user typed.
      known: the table.
    """
    if name in known:
        return
    near = nearest(name, known)
    hint = f" Did you mean {near!r}?" if near else ""
    raise ValueError(f"unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(known))}.")


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Returns the known name that somebody meant, whatever the case of the letters, if any is near.

    Args:
      name: what the user typed; a known name that contains it is near. A version, such as -v5,
        makes no two names alike.
      known: the names; of versions of one name the last is meant, unless the user typed another.
    """
    typed, versions = _plain(name), {}
    for each in sorted(known):
        versions.setdefault(_plain(each), []).append(each)
    inside = [each for each in versions if len(typed) > 2 and typed in each]
    near = difflib.get_close_matches(typed, inside or versions, n=1, cutoff=0 if inside else _ALIKE)
    return difflib.get_close_matches(name, versions[near[0]], n=1, cutoff=0)[0] if near else None


def _plain(name: str) -> str:
    """Returns a name in small letters, without the version of a task."""
    return re.sub(r"-v\d+$", "", name.lower())


def load_definition(entry: str | Callable[..., Any]) -> Callable[..., Any]:
    """Returns a definition: itself, or imported from "module:name"."""
    if not isinstance(entry, str):
        return entry
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)

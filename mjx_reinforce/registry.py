"""Tables from the names a user types to the definitions, imported only when chosen."""

import difflib
import importlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

#: Action distributions: name -> "module:function" of an action space.
DISTRIBUTIONS = {
    "normal": "mjx_reinforce.policies.normal:normal",
    "normal-softplus": "mjx_reinforce.policies.normal:normal_softplus",
    "normal-sigmoid": "mjx_reinforce.policies.normal:normal_sigmoid",
    "truncated-normal": "mjx_reinforce.policies.truncated_normal:truncated_normal",
    "clipped-normal": "mjx_reinforce.policies.clipped_normal:clipped_normal",
    "tanh-normal": "mjx_reinforce.policies.tanh_normal:tanh_normal",
    "deterministic": "mjx_reinforce.policies.deterministic:deterministic",
    "categorical": "mjx_reinforce.policies.categorical:categorical",
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


def check_name(kind: str, name: str, known: Mapping[str, Any]) -> None:
    """Raises ValueError for a name that is not known, with the known ones and the nearest.

    Args:
      kind: what is named, for the message.
      name: what the user typed.
      known: the table.
    """
    if name in known:
        return
    near = nearest(name, known, cutoff=0.4)
    hint = f" Did you mean {near!r}?" if near else ""
    raise ValueError(f"unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(known))}.")


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str | None:
    """Returns the known name that somebody meant, whatever the case of the letters, if any is near.

    Args:
      name: what the user typed; a known name that contains it is near.
      known: the names.
      cutoff: how alike names must be, from 0 to 1 (all).
    """
    plain = {each.lower(): each for each in sorted(known)}
    typed = name.lower()
    inside = [each for each in plain if len(typed) > 2 and typed in each]
    near = difflib.get_close_matches(typed, inside or plain, n=1, cutoff=0 if inside else cutoff)
    return plain[near[0]] if near else None


def load(entry: str | Callable[..., Any]) -> Callable[..., Any]:
    """Returns a definition: itself, or imported from "module:name"."""
    if not isinstance(entry, str):
        return entry
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)

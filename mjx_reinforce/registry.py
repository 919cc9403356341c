"""Tables from the names a user types to the definitions, imported only when chosen."""

import importlib
import os
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from mjx_reinforce.engine.checks import check_name, explain

#: Action distributions: name -> "module:function" of an action space.
DISTRIBUTIONS = {
    "normal": "mjx_reinforce.learning.distributions:normal",
    "normal-softplus": "mjx_reinforce.learning.distributions:normal_softplus",
    "normal-sigmoid": "mjx_reinforce.learning.distributions:normal_sigmoid",
    "truncated-normal": "mjx_reinforce.learning.bounded:truncated_normal",
    "tanh-normal": "mjx_reinforce.learning.bounded:tanh_normal",
    "deterministic": "mjx_reinforce.published.variants:deterministic",
    "categorical": "mjx_reinforce.learning.distributions:categorical",
}

#: Gradient estimators: name -> "module:function" of a discount.
ESTIMATORS = {
    "total-return": "mjx_reinforce.learning.estimators:total_return",
    "reward-to-go": "mjx_reinforce.learning.estimators:reward_to_go",
    "leave-one-out": "mjx_reinforce.learning.estimators:leave_one_out",
    "leave-one-out-alive": "mjx_reinforce.learning.estimators:leave_one_out_alive",
    "value-baseline": "mjx_reinforce.learning.value:value_baseline",
    "mean-log-prob": "mjx_reinforce.published.variants:mean_log_prob",
    "normalized-returns": "mjx_reinforce.published.variants:normalized_returns",
}


class Algorithm(NamedTuple):
    """A way to learn.

    make: "module:function" of an environment, the settings, and what ``setup.build`` adds
    search_episodes: episodes of an update, of one that tries out policies; 0: it follows a gradient
    policy: what its policies have in place of the usual, see ``setup.build.policy_settings``
    """

    make: str
    search_episodes: int = 0
    policy: Mapping[str, Any] = {}


#: The documents' programs are written for PyTorch's initial weights, and for means as they are.
_AS_PUBLISHED = {"initializer": "torch", "rescale": False}
#: Ways to learn, by name: ours, and programs of published documents.
ALGORITHMS = {
    "reinforce": Algorithm("mjx_reinforce.setup.build:build_reinforce"),
    "ars": Algorithm("mjx_reinforce.published.ars:make", search_episodes=16),
    "gymnasium-tutorial": Algorithm(
        "mjx_reinforce.published.gymnasium_tutorial:reward_to_go", policy=_AS_PUBLISHED
    ),
    "gymnasium-tutorial-v0.26": Algorithm(
        "mjx_reinforce.published.gymnasium_tutorial:mean_log_prob", policy=_AS_PUBLISHED
    ),
    "baseline-truncated-normal": Algorithm(
        "mjx_reinforce.published.baseline_truncated_normal:make", policy=_AS_PUBLISHED
    ),
    "continuous-cartpole": Algorithm(
        "mjx_reinforce.published.continuous_cartpole:reinforce", policy=_AS_PUBLISHED
    ),
    "continuous-cartpole-ars": Algorithm(
        "mjx_reinforce.published.continuous_cartpole:random_search",
        search_episodes=20,
        policy=_AS_PUBLISHED,
    ),
    "categorical-cartpole": Algorithm(
        "mjx_reinforce.published.categorical_cartpole:make", policy=_AS_PUBLISHED
    ),
}


def find_algorithm(name: str) -> Algorithm:
    """Returns a way to learn by its name; that of the user's own, module:name, may be any."""
    return ALGORITHMS.get(name, Algorithm(name))


def is_own(name: str) -> bool:
    """Returns whether a name is that of the user's own code, module:name."""
    return ":" in name


def check_choice(kind: str, name: str, choices: Mapping[str, Any]) -> None:
    """Raises ValueError for what is neither one of the choices nor of the form module:name."""
    if not is_own(name):
        check_name(kind, name, choices)
    elif not re.fullmatch(r"\w+(\.\w+)*:\w+", name):
        raise ValueError(
            f"the {kind} {name!r} is not of the form module:name, such as mine:make for the "
            "function make in mine.py"
        )


def load_choice(kind: str, name: str, choices: Mapping[str, Any]) -> Callable[..., Any]:
    """Returns the definition of one of the choices, or the user's own by module:name.

    Raises:
      ValueError: as ``check_choice`` and ``load_own``.
    """
    check_choice(kind, name, choices)
    if is_own(name):
        return load_own(kind, name)
    return load_definition(choices[name])


def load_own(kind: str, name: str, *, form: str = "module:name") -> Callable[..., Any]:
    """Returns the user's own class or function, imported from the current folder or elsewhere.

    Args:
      kind: what it is, for messages.
      name: "module:name".
      form: what is called so, for messages.

    Raises:
      ValueError: it cannot be imported, or is not a class or function.
    """
    # ``python -m`` looks in the current folder, and the script mjx-reinforce does not.
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
    # An import runs the user's code, which may raise anything.
    try:
        definition = load_definition(name)
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"cannot import the {kind} {name!r}: {explain(error)}; write {form} of a module that "
            "is in this folder or installed"
        ) from error
    if not callable(definition):
        raise ValueError(
            f"the {kind} {name!r} is not a class or function, but of type "
            f"{type(definition).__name__}; write {form}"
        )
    return definition


def load_definition(entry: str | Callable[..., Any]) -> Callable[..., Any]:
    """Returns a definition: itself, or imported from "module:name"."""
    if not isinstance(entry, str):
        return entry
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)

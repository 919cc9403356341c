"""REINFORCE on MuJoCo, vectorised over episodes and seeds.

The public names are imported on first use, so that ``import mjx_reinforce``
and ``python -m mjx_reinforce.train --help`` stay quick: neither MJX nor brax
is loaded before an environment is made.
"""

import importlib
from typing import Any

_HOME = {
    "Learner": "learners.learner",
    "TrainState": "learners.learner",
    "reinforce": "learners.reinforce",
    "AutoEpisodes": "learners.pace",
    "train_step": "learners.learner",
    "ars": "learners.ars",
    "Distribution": "policies.distribution",
    "categorical": "policies.categorical",
    "clipped_normal": "policies.clipped_normal",
    "deterministic": "policies.deterministic",
    "normal": "policies.normal",
    "tanh_normal": "policies.tanh_normal",
    "truncated_normal": "policies.truncated_normal",
    "Estimator": "learners.estimators",
    "total_return": "learners.estimators",
    "reward_to_go": "learners.estimators",
    "leave_one_out": "learners.estimators",
    "value_baseline": "learners.value_baseline",
    "full_batch_value_baseline": "learners.value_baseline",
    "mean_log_prob": "learners.estimators",
    "normalized_returns": "learners.estimators",
    "standardize": "learners.estimators",
    "discount_weights": "learners.estimators",
    "shift_rewards": "learners.estimators",
    "full_batch": "learners.updates",
    "minibatches": "learners.updates",
    "each_step": "learners.updates",
    "natural_gradient": "learners.natural_gradient",
    "make_optimizer": "learners.updates",
    "Actor": "policies.actor",
    "act": "policies.actor",
    "Policy": "policies.policy",
    "mlp_policy": "policies.policy",
    "evaluate": "runs.evaluation",
    "rollout": "engines.rollouts",
    "Box": "types",
    "Discrete": "types",
    "Environment": "types",
    "Trajectory": "types",
    "Player": "export.player",
    "load": "export.player",
    "pretrained": "export.pretrained",
    "load_policy": "export.policy_files",
    "save_policy": "export.policy_files",
}

#: Folders and files that are attributes too, also imported on first use.
_MODULES = (
    *("engines", "envs", "export", "fused", "learners", "physics", "policies"),
    *("registry", "reports", "runs", "sweeps", "types"),
)

__version__: str
__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Any:
    """Imports a public name from its module, or a module, on first use (PEP 562)."""
    if name == "__version__":
        return _version()
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def _version() -> str:
    """Returns the version of the installed package."""
    from importlib import metadata

    try:
        return metadata.version("mjx-reinforce")
    except metadata.PackageNotFoundError:
        return "0+not.installed"


def __dir__() -> list[str]:
    return sorted([*__all__, *_MODULES])

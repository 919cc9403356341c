"""REINFORCE on MuJoCo, vectorised over episodes and seeds.

The public names are imported on first use, so that ``import mjx_reinforce``
and ``python -m mjx_reinforce.train --help`` stay quick: neither MJX nor brax
is loaded before an environment is made.
"""

import importlib

_HOME = {
    "Learner": "learner",
    "TrainState": "learner",
    "reinforce": "learner",
    "train_step": "learner",
    "Distribution": "distributions",
    "normal": "normals",
    "Estimator": "estimators",
    "total_return": "estimators",
    "reward_to_go": "estimators",
    "leave_one_out": "estimators",
    "value_baseline": "estimators",
    "mean_log_prob": "estimators",
    "normalized_returns": "estimators",
    "standardize": "estimators",
    "discount_weights": "estimators",
    "full_batch": "updates",
    "minibatches": "updates",
    "each_step": "updates",
    "make_optimizer": "updates",
    "Policy": "policies",
    "mlp_policy": "policies",
    "evaluate": "evaluation",
    "rollout": "rollouts",
    "Box": "types",
    "Environment": "types",
    "Trajectory": "types",
    "load_policy": "checkpoint",
    "save_policy": "checkpoint",
}

__all__ = [*_HOME, "__version__"]
__version__ = "0.1.0"


def __getattr__(name: str):
    """Imports a public name from its module on first use (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)

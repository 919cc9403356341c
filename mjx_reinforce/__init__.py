"""REINFORCE on MuJoCo, vectorised over episodes and seeds.

The public names are imported on first use, so that ``import mjx_reinforce``
and ``python -m mjx_reinforce.train --help`` stay quick: neither MJX nor brax
is loaded before an environment is made.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors read in place of __getattr__
    from mjx_reinforce.engines.any_policy import rollout
    from mjx_reinforce.export.player import Player, load
    from mjx_reinforce.export.policy_files import load_policy, save_policy
    from mjx_reinforce.export.run_files import pretrained
    from mjx_reinforce.learners.ars import ars
    from mjx_reinforce.learners.estimators import (
        Estimator,
        discount_weights,
        leave_one_out,
        mean_log_prob,
        normalized_returns,
        reward_to_go,
        shift_rewards,
        standardize,
        total_return,
    )
    from mjx_reinforce.learners.learner import Learner, TrainState, train_step
    from mjx_reinforce.learners.natural_gradient import natural_gradient
    from mjx_reinforce.learners.pace import AutoEpisodes
    from mjx_reinforce.learners.reinforce import reinforce
    from mjx_reinforce.learners.updates import each_step, full_batch, make_optimizer, minibatches
    from mjx_reinforce.learners.value_baseline import full_batch_value_baseline, value_baseline
    from mjx_reinforce.policies.actor import Actor, act
    from mjx_reinforce.policies.distributions.categorical import categorical
    from mjx_reinforce.policies.distributions.clipped_normal import clipped_normal
    from mjx_reinforce.policies.distributions.deterministic import deterministic
    from mjx_reinforce.policies.distributions.distribution import Distribution
    from mjx_reinforce.policies.distributions.normal import normal
    from mjx_reinforce.policies.distributions.tanh_normal import tanh_normal
    from mjx_reinforce.policies.distributions.truncated_normal import truncated_normal
    from mjx_reinforce.policies.policy import Policy, mlp_policy
    from mjx_reinforce.reports.statistics import iqm, iqm_interval, mean_interval
    from mjx_reinforce.reports.statistics.comparisons import (
        compare_all,
        paired_difference,
        probability_of_improvement,
    )
    from mjx_reinforce.reports.statistics.survival import kaplan_meier, log_rank
    from mjx_reinforce.runs.run import RunResults, run
    from mjx_reinforce.settings.config import Config
    from mjx_reinforce.settings.defaults import of_task
    from mjx_reinforce.sweeps.run import SweepResults, sweep
    from mjx_reinforce.training.driver import Evaluation
    from mjx_reinforce.training.evaluation import evaluate
    from mjx_reinforce.types import Box, Discrete, Environment, Trajectory
    from mjx_reinforce.vector.environment import VectorEnv, make_vec
    from mjx_reinforce.vector.episodes import VectorState
    from mjx_reinforce.vector.segments import Segment, unroll

_HOME = {
    "Config": "settings.config",
    "of_task": "settings.defaults",
    "run": "runs.run",
    "RunResults": "runs.run",
    "Evaluation": "training.driver",
    "sweep": "sweeps.run",
    "SweepResults": "sweeps.run",
    "iqm": "reports.statistics",
    "iqm_interval": "reports.statistics",
    "mean_interval": "reports.statistics",
    "compare_all": "reports.statistics.comparisons",
    "paired_difference": "reports.statistics.comparisons",
    "probability_of_improvement": "reports.statistics.comparisons",
    "kaplan_meier": "reports.statistics.survival",
    "log_rank": "reports.statistics.survival",
    "make_vec": "vector.environment",
    "VectorEnv": "vector.environment",
    "VectorState": "vector.episodes",
    "Segment": "vector.segments",
    "unroll": "vector.segments",
    "Learner": "learners.learner",
    "TrainState": "learners.learner",
    "reinforce": "learners.reinforce",
    "AutoEpisodes": "learners.pace",
    "train_step": "learners.learner",
    "ars": "learners.ars",
    "Distribution": "policies.distributions.distribution",
    "categorical": "policies.distributions.categorical",
    "clipped_normal": "policies.distributions.clipped_normal",
    "deterministic": "policies.distributions.deterministic",
    "normal": "policies.distributions.normal",
    "tanh_normal": "policies.distributions.tanh_normal",
    "truncated_normal": "policies.distributions.truncated_normal",
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
    "evaluate": "training.evaluation",
    "rollout": "engines.any_policy",
    "Box": "types",
    "Discrete": "types",
    "Environment": "types",
    "Trajectory": "types",
    "Player": "export.player",
    "load": "export.player",
    "pretrained": "export.run_files",
    "load_policy": "export.policy_files",
    "save_policy": "export.policy_files",
}

#: Folders and files that are attributes too, also imported on first use.
_MODULES = (
    *("console", "engines", "envs", "export", "files", "fused", "hosts", "learners", "physics"),
    *("playing", "policies", "registry", "reports", "runs", "settings", "store", "sweeps"),
    *("training", "types", "vector"),
)

__version__: str
__all__ = [
    "Actor",
    "AutoEpisodes",
    "Box",
    "Config",
    "Discrete",
    "Distribution",
    "Environment",
    "Estimator",
    "Evaluation",
    "Learner",
    "Player",
    "Policy",
    "RunResults",
    "Segment",
    "SweepResults",
    "TrainState",
    "Trajectory",
    "VectorEnv",
    "VectorState",
    "__version__",
    "act",
    "ars",
    "categorical",
    "clipped_normal",
    "compare_all",
    "deterministic",
    "discount_weights",
    "each_step",
    "evaluate",
    "full_batch",
    "full_batch_value_baseline",
    "iqm",
    "iqm_interval",
    "kaplan_meier",
    "leave_one_out",
    "load",
    "load_policy",
    "log_rank",
    "make_optimizer",
    "make_vec",
    "mean_interval",
    "mean_log_prob",
    "minibatches",
    "mlp_policy",
    "natural_gradient",
    "normal",
    "normalized_returns",
    "of_task",
    "paired_difference",
    "pretrained",
    "probability_of_improvement",
    "reinforce",
    "reward_to_go",
    "rollout",
    "run",
    "save_policy",
    "shift_rewards",
    "standardize",
    "sweep",
    "tanh_normal",
    "total_return",
    "train_step",
    "truncated_normal",
    "unroll",
    "value_baseline",
]


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

"""The public names and their homes: what type checkers read, and ``__init__.py`` too."""

from mjx_reinforce.engine.base import Box, Discrete, Environment, Trajectory
from mjx_reinforce.engine.play.choice import rollout
from mjx_reinforce.engine.vector.environment import VectorEnv, VectorState
from mjx_reinforce.engine.vector.segments import Segment, unroll
from mjx_reinforce.envs import make_vec
from mjx_reinforce.export.policy_files import Player, load, load_policy, save_policy
from mjx_reinforce.export.run_files import pretrained
from mjx_reinforce.learning.bounded import tanh_normal, truncated_normal
from mjx_reinforce.learning.distributions import Distribution, categorical, normal
from mjx_reinforce.learning.estimators import (
    Estimator,
    discount_weights,
    leave_one_out,
    reward_to_go,
    standardize,
    total_return,
)
from mjx_reinforce.learning.learner import Learner, TrainState, reinforce, train_step
from mjx_reinforce.learning.natural_gradient import natural_gradient
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy
from mjx_reinforce.learning.schedules import Cut
from mjx_reinforce.learning.updates import full_batch, make_optimizer
from mjx_reinforce.learning.value import full_batch_value_baseline, value_baseline
from mjx_reinforce.published.ars import ars
from mjx_reinforce.published.variants import (
    deterministic,
    each_step,
    mean_log_prob,
    minibatches,
    normalized_returns,
)
from mjx_reinforce.runs.results import RunResults, SweepResults, run, sweep
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.statistics import iqm, iqm_interval, mean_interval
from mjx_reinforce.statistics.comparisons import (
    compare_all,
    paired_difference,
    probability_of_improvement,
)
from mjx_reinforce.statistics.sequential import sequential_test
from mjx_reinforce.statistics.survival import kaplan_meier, log_rank
from mjx_reinforce.statistics.tolerance import lower_tolerance
from mjx_reinforce.training.driver import Evaluation
from mjx_reinforce.training.programs import evaluate

from . import console as console
from . import engine as engine
from . import envs as envs
from . import export as export
from . import files as files
from . import learning as learning
from . import playing as playing
from . import published as published
from . import registry as registry
from . import reports as reports
from . import runs as runs
from . import settings as settings
from . import setup as setup
from . import statistics as statistics
from . import training as training

__version__: str
__all__ = [
    "Actor",
    "Box",
    "Config",
    "Cut",
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
    "lower_tolerance",
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
    "sequential_test",
    "standardize",
    "sweep",
    "tanh_normal",
    "total_return",
    "train_step",
    "truncated_normal",
    "unroll",
    "value_baseline",
]

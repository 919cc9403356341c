"""The groups of settings of a run: one class a group of ``--help``, its docstrings the help."""

import dataclasses
import enum
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from mjx_reinforce.registry import find_algorithm, is_own
from mjx_reinforce.settings.declare import COUNT, TOTAL, Mark, Range, Value, setting

#: Families whose standard deviation is a parameter, the same in all states.
_FREE_STD = ("normal", "truncated-normal", "tanh-normal")


class Reader(enum.Enum):
    """What reads a setting; checked in this order, the most general first.

    A setting with several is read where all of them read; one with none always is.

    words: the condition, for messages
    holds: whether a configuration fulfils it
    """

    def __init__(self, words: str, holds: Callable[[Any], bool]):
        self.words = words
        self.holds = holds

    # An algorithm of the user's own may read all of them.
    GRADIENT = (
        "an --algorithm that follows a gradient",
        lambda c: not find_algorithm(c.algorithm).search_episodes,
    )
    REINFORCE = (
        "--algorithm reinforce",
        lambda c: c.algorithm == "reinforce" or is_own(c.algorithm),
    )
    VALUE_BASELINE = (
        "--estimator value-baseline",
        lambda c: c.estimator == "value-baseline" or c.algorithm == "baseline-truncated-normal",
    )
    CUT = "--train-horizon N", lambda c: c.train_horizon is not None
    # The natural gradient's step has its length from --max-kl.
    OPTIMIZER = "another --update than natural-gradient", lambda c: c.update != "natural-gradient"
    FIRST_RATE = (
        "another --update than natural-gradient, or --final-learning-rate",
        lambda c: c.update != "natural-gradient" or c.final_learning_rate is not None,
    )
    NORMALIZATION = "--normalize-steps N", lambda c: c.normalize_steps != 0
    ADAM = "--optimizer adam", lambda c: c.optimizer == "adam"
    DECAY = "--decay-steps N", lambda c: c.decay_steps is not None
    FREE_STD = (
        "a --policy whose standard deviation is the same in all states",
        lambda c: c.policy in ("auto", *_FREE_STD),
    )
    STD = (
        "a --policy with a standard deviation",
        lambda c: (
            c.policy not in ("categorical", "deterministic")
            and not (c.policy == "auto" and find_algorithm(c.algorithm).search_episodes)
        ),
    )


def _for_reinforce(default: Value, *marks: enum.Enum) -> Value:
    return setting(default, *marks, Reader.REINFORCE)


def _for_gradients(default: Value, *marks: enum.Enum) -> Value:
    return setting(default, *marks, Reader.GRADIENT)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What is trained, for how long, and where it is written."""

    env: str = setting(
        "InvertedPendulum-v5", once="its results are of one task; make a sweep for each"
    )
    """Environment id, or module:Class for your own environment. `python -m mjx_reinforce.envs`
    lists the ids."""
    env_set: tuple[str, ...] = ()
    """Settings of the environment, such as frame_skip=4; see `python -m mjx_reinforce.envs ID`."""
    algorithm: str = "reinforce"
    """reinforce follows the policy gradient; ars is augmented random search (Mania et al. 2018); a
    preset's name is its program without its settings. Or module:name."""
    num_seeds: int = setting(4, *COUNT, once="every configuration has as many seeds")
    """Number of independent seeds, trained together in one compiled program."""
    seeds: str | None = setting(
        None, Mark.NOT_COMPILED, once="every configuration has the same seeds"
    )
    """FIRST:END, in place of --num-seeds: seeds FIRST to END - 1, a share of a larger run, for one
    of several machines. `python -m mjx_reinforce.report A B` joins shares."""
    race: int = setting(1, *COUNT, once="it is for one run")
    """Policies that train for each seed and race: at a quarter, a half and three quarters of the
    budget, the half with the better training returns replaces the other half, and goes on with
    random numbers of its own; the best one at the end is the seed's. Each has --env-steps, so that
    a seed costs as many times as much. A mean over such seeds is one of races: say so beside it."""
    seed: int = setting(
        0,
        Range.SEED,
        Mark.NOT_COMPILED,
        once="every configuration has the same seeds; raise --num-seeds",
    )
    """Root of all randomness; the seeds' keys are split from it."""
    env_steps: int | None = setting(280_000, *TOTAL, Mark.BUDGET, Mark.NOT_COMPILED)
    """Training budget per seed, in env steps; a seed stops after the update that reaches it. None:
    only --max-updates counts."""
    minutes: float | None = setting(
        None, Range.POSITIVE, Mark.BUDGET, Mark.NOT_COMPILED, once="it is for one run"
    )
    """Training time of all seeds together, in place of --env-steps. The first updates measure how
    many env steps fit, and what follows corrects that. A seed with shorter episodes than others may
    end with fewer. config.json keeps these numbers, so --like RUN repeats the run to the bit. The
    default of most tasks, if no other budget is given."""
    budgets: tuple[int, ...] = setting(
        (), Mark.BUDGET, Mark.NOT_COMPILED, once="it is measured in one run"
    )
    """What --minutes measured, for config.json: a number of updates and the --env-steps from there
    on, and so on. Ignored if the last of them is not --env-steps."""
    max_updates: int | None = setting(None, *TOTAL, Mark.BUDGET, Mark.NOT_COMPILED)
    """Stop every seed after this many updates. With --num-episodes 1, these are episodes."""
    num_episodes: int = _for_gradients(16, *COUNT)
    """Episodes per update and seed."""
    horizon: int | None = setting(None, *COUNT)
    """Time limit of an episode in env steps. None: the environment's own limit."""
    train_horizon: int | None = setting(None, *COUNT)
    """Cut training episodes, not evaluations, after this many env steps."""
    whole_after: float = _for_gradients(1.0, Range.SHARE, Reader.CUT)
    """Share of the budget after which --train-horizon no longer cuts episodes."""
    engine: Literal["auto", "vmap", "native", "mujoco"] = setting(
        "auto", once="it changes no result but by rounding"
    )
    """How episodes are played: vmap (jax.vmap of the step), native (machine code for this CPU or
    NVIDIA GPU), mujoco (C MuJoCo on the CPU's cores), or auto, the fastest here."""
    like: Path | None = setting(None, Mark.PLACE, once="every configuration begins with it")
    """Take all settings from this run, except those on the command line."""
    init_from: str | None = setting(None, Mark.NOT_COMPILED, once="it is for one run")
    """Start from the last policies of this run, which must have the same policy settings. Seed i
    takes the policy of seed i modulo the number of seeds there."""
    output: Path | None = setting(None, Mark.PLACE, once="it has one directory")
    """Directory of the run. If not given, runs/<env>-<time>."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicySettings:
    """The network and the distribution of its actions."""

    policy: str = "auto"
    """Action distribution: normal (one trained std), normal-softplus and normal-sigmoid (std from
    the state), truncated-normal and tanh-normal (within the action bounds), categorical
    (discrete actions), deterministic (ars only); auto is categorical where the actions are
    discrete, else normal, or deterministic for ars. Or module:name."""
    hidden_sizes: tuple[int, ...] = setting((32, 32), Range.LAYERS)
    """Units of each tanh layer of the policy network. The flag without a number makes the policy
    linear."""
    initial_std: float | None = setting(None, Range.POSITIVE, Reader.STD, Mark.TRACED)
    """Standard deviation of the actions before training, in the action's unit. None: of each entry,
    half of half its range; 0.5 if it is not bounded."""
    final_std: float | None = _for_reinforce(
        None, Range.POSITIVE, Reader.DECAY, Reader.FREE_STD, Mark.TRACED
    )
    """Standard deviation of the actions after --decay-steps, apart from what is learned. With
    --max-kl it may stay larger. None: learned only."""
    normalize_steps: int | None = setting(1000, Range.AT_LEAST_0, Range.COUNTED)
    """Scale observations by their mean and standard deviation over the first env steps, about this
    many. 0: do not scale. None: update the statistics throughout training."""
    normalize_min_std: float = setting(0.0, Range.NOT_NEGATIVE, Reader.NORMALIZATION, Mark.TRACED)
    """Lower bound on the std that scales observations, in the observation's unit. Without it, an
    entry that barely varies in the first env steps is magnified."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """What multiplies the gradient of an action's log-probability (reinforce)."""

    estimator: str = _for_reinforce("leave-one-out")
    """What weights the gradient: total-return; reward-to-go; leave-one-out (reward to go minus the
    mean of the other episodes, where an episode that is over counts as 0); leave-one-out-alive
    (minus the mean of the episodes that still run); value-baseline (minus a learned value).
    mean-log-prob and normalized-returns are published variants, which their docstrings explain. Or
    module:name."""
    discount: float = _for_gradients(0.99, Range.SHARE, Mark.TRACED)
    """Discount of rewards, in [0, 1]."""
    standardize_floor: float | None = _for_reinforce(10.0, Range.NOT_NEGATIVE, Mark.TRACED)
    """The weights are divided by their root mean square plus this number, in units of return.
    None: they are not divided."""
    value_learning_rate: float = _for_gradients(
        3e-3, Range.POSITIVE, Reader.VALUE_BASELINE, Mark.TRACED
    )
    """Adam's learning rate for the value network of value-baseline."""
    value_fits: int = _for_reinforce(32, *COUNT, Reader.VALUE_BASELINE)
    """Gradient steps of the value network in each update, on the squared error."""
    value_batch_size: int = _for_reinforce(256, *COUNT, Reader.VALUE_BASELINE)
    """Env steps per minibatch of the value network, drawn with replacement."""
    value_hidden_sizes: tuple[int, ...] = _for_gradients(
        (64, 64), Range.LAYERS, Reader.VALUE_BASELINE
    )
    """Units of each tanh layer of the value network."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How the gradient becomes changes of the parameters (reinforce)."""

    update: Literal["full-batch", "natural-gradient"] = _for_reinforce("full-batch")
    """How an update changes the policy. full-batch: one optimizer step. natural-gradient: one step
    of length --max-kl, which shrinks as the learning rate decays."""
    entropy_cost: float = _for_reinforce(0.0, Range.NOT_NEGATIVE, Mark.TRACED)
    """Weight of the policy's entropy in the objective."""
    optimizer: Literal["adam", "sgd"] = _for_reinforce("adam", Reader.OPTIMIZER)
    """The rule that turns a gradient into a step."""
    learning_rate: float = _for_gradients(1e-2, Range.POSITIVE, Reader.FIRST_RATE, Mark.TRACED)
    """Learning rate of the optimizer at the start of training."""
    momentum: float = _for_reinforce(0.9, Range.BELOW_1, Reader.OPTIMIZER, Reader.ADAM, Mark.TRACED)
    """b1 of adam: the share of the running mean gradient that each step keeps."""
    final_learning_rate: float | None = _for_reinforce(
        None, Range.POSITIVE, Reader.DECAY, Mark.TRACED
    )
    """Learning rate after the linear decay. If not given, a tenth of --learning-rate."""
    decay_steps: int | Literal["budget"] | None = _for_reinforce("budget", *TOTAL, Mark.TRACED)
    """Env steps per seed over which the learning rate decays; with --final-std, the noise decays
    too. budget: the length of the run. None: no decay."""
    max_grad_norm: float | None = _for_reinforce(1.0, Range.POSITIVE, Reader.OPTIMIZER, Mark.TRACED)
    """Maximum Euclidean norm of the gradient; a longer gradient is scaled down. None: no
    maximum."""
    max_kl: float | None = _for_reinforce(None, Range.POSITIVE, Mark.TRACED)
    """Most that an update may change the policy: the mean KL divergence (nats) before and after,
    over 64 of the visited steps. A larger change is shortened, that of the observations' scale with
    it. None: no maximum."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Playing the policies without training them."""

    eval_every: int = setting(5, *COUNT)
    """Updates between evaluations."""
    eval_episodes: int = setting(16, *COUNT)
    """Episodes per evaluation: this many without noise, and as many with it. A seed has the same
    starts at every evaluation."""
    test_episodes: int | None = setting(None, *COUNT, once="it has no test")
    """Episodes of the test at the end, from starts that no evaluation uses. If not given,
    --eval-episodes. The test plays --eval-episodes at a time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckpointSettings:
    """Resuming a run that was interrupted, or whose budget is used."""

    checkpoint_every: int | None = setting(
        None, *COUNT, Mark.BUDGET, Mark.NOT_COMPILED, once="it is saved as a whole"
    )
    """Updates between checkpoints, from which --resume continues; about a minute if not given.
    They follow evaluations."""
    resume: Path | None = setting(None, Mark.PLACE, once="it goes on as a whole")
    """Resume the run in this directory, with its own settings. Only the budget may change:
    --env-steps, --minutes, --max-updates, --checkpoint-every. Name your own code, module:Class or
    module:name, again."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Logs to which the rows of metrics.csv also go. The x axis of charts is the number of updates.

    Some columns are empty in some runs. gradient_snr, the signal-to-noise ratio of the gradient,
    needs at least two episodes (or directions of ars). explained_variance needs a baseline.
    """

    log: tuple[Literal["tensorboard", "wandb"], ...] = setting(
        (), Mark.NOT_COMPILED, once="what it measures is in curves.npz"
    )
    """Log the interquartile mean, ends and first 16 seeds of each column. tensorboard: charts
    in RUN/tensorboard; to see them, pip install tensorboard, then tensorboard --logdir RUN.
    wandb: Weights & Biases (pip install wandb), offline in RUN/wandb; upload with wandb sync, or
    set WANDB_MODE=online during the run."""


#: The groups of --help, in order, under their titles.
GROUPS = {
    "run": RunSettings,
    "policy": PolicySettings,
    "estimator": EstimatorSettings,
    "updates": UpdateSettings,
    "evaluation": EvaluationSettings,
    "checkpoints": CheckpointSettings,
    "logs": LogSettings,
}

"""The groups of settings of a run: one class a group of ``--help``, its docstrings the help."""

import dataclasses
import enum
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from mjx_reinforce.settings.declare import (
    COUNT,
    LAYERS,
    NOT_NEGATIVE,
    POSITIVE,
    RATE,
    SEVERAL,
    STEPS,
    TOTAL,
    Mark,
    Range,
    Value,
    setting,
)

#: Families whose standard deviation is a parameter, the same in all states.
_FREE_STD = ("normal", "truncated-normal", "clipped-normal", "tanh-normal")


class Reader(enum.Enum):
    """What reads a setting; checked in this order, the most general first.

    A setting with several is read where all of them read; one with none always is.

    said: the condition in words
    holds: whether a configuration fulfils it
    """

    def __init__(self, said: str, holds: Callable[[Any], bool]):
        self.said, self.holds = said, holds

    REINFORCE = "--algorithm reinforce", lambda c: c.algorithm == "reinforce"
    ARS = "--algorithm ars", lambda c: c.algorithm == "ars"
    VALUE_BASELINE = "--estimator value-baseline", lambda c: c.estimator == "value-baseline"
    VALUE_MINIBATCHES = "--value-fit minibatches", lambda c: c.value_fit == "minibatches"
    LEAVE_ONE_OUT = "--estimator leave-one-out", lambda c: c.estimator == "leave-one-out"
    AUTO_EPISODES = "--num-episodes auto", lambda c: c.num_episodes == "auto"
    STANDARDIZE = "--standardize", lambda c: c.standardize
    DIRECTORY = "--output DIR", lambda c: c.output is not None or c.resume is not None
    MINIBATCHES = "--update minibatches", lambda c: c.update == "minibatches"
    NATURAL_GRADIENT = "--update natural-gradient", lambda c: c.update == "natural-gradient"
    CONJUGATE_GRADIENTS = (
        "hidden layers or another --policy than normal",
        lambda c: bool(c.hidden_sizes) or c.policy != "normal",
    )
    # The natural gradient's step has its length from --max-kl.
    OPTIMIZER = "another --update than natural-gradient", lambda c: c.update != "natural-gradient"
    FIRST_RATE = (
        "another --update than natural-gradient, or --final-learning-rate",
        lambda c: c.update != "natural-gradient" or c.final_learning_rate is not None,
    )
    # A minibatch is averaged over its own steps.
    WHOLE_EPISODES = (
        "--update full-batch or --update each-step",
        lambda c: c.update != "minibatches",
    )
    DECAY = (
        "--decay-steps N (or --decay-updates N)",
        lambda c: c.decay_steps is not None or c.decay_updates is not None,
    )
    NORMALIZATION = "--normalize-steps N", lambda c: c.normalize_steps != 0
    ADAM = "--optimizer adam or --optimizer adamw", lambda c: c.optimizer in ("adam", "adamw")
    DECAY_STEPS = "--decay-steps N", lambda c: c.decay_steps is not None
    FREE_STD = (
        "a --policy whose standard deviation is the same in all states",
        lambda c: c.policy in ("auto", *_FREE_STD),
    )
    STD = (
        "a --policy with a standard deviation",
        lambda c: (
            c.policy not in ("categorical", "deterministic")
            and not (c.policy == "auto" and c.algorithm == "ars")
        ),
    )
    CONTINUOUS = "a --policy for continuous actions", lambda c: c.policy != "categorical"


def _for_reinforce(default: Value, *marks: enum.Enum) -> Value:
    return setting(default, *marks, Reader.REINFORCE)


def _for_ars(default: Value, *marks: enum.Enum) -> Value:
    return setting(default, *marks, Reader.ARS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What is trained, for how long, and where it is written."""

    env: str = setting(
        "InvertedPendulum-v5", once="its results are of one task; make a sweep for each"
    )
    """Environment id; `python -m mjx_reinforce.envs` lists them. Or module:Class for your own."""
    algorithm: Literal["reinforce", "ars"] = "reinforce"
    """reinforce follows the policy gradient; ars (augmented random search, Mania et al. 2018)
    tries out changes of the parameters. Its own settings are in the group "search" below."""
    num_seeds: int = setting(4, Range.AT_LEAST_1, once="every configuration has as many seeds")
    """How many independent seeds are trained together, in one compiled program."""
    seed: int = setting(
        0,
        Range.SEED,
        Mark.NOT_COMPILED,
        once="every configuration has the same seeds; raise --num-seeds",
    )
    """Root of all randomness; the seeds' keys are split from it."""
    env_steps: int | None = setting(280_000, *TOTAL, Mark.BUDGET, Mark.NOT_COMPILED)
    """Training budget of each seed in env steps; it stops after the update that reaches it. What
    about a minute gives here if not given. None leaves it to --max-updates."""
    minutes: float | None = setting(
        None, Range.POSITIVE, Mark.BUDGET, Mark.NOT_COMPILED, once="it is for one run"
    )
    """In place of --env-steps, about how long to train, all seeds together: the first updates show
    how many env steps that is. The number goes into config.json, so that --like RUN repeats the
    run to the last bit. Where episodes grow, later steps come faster, above all on a GPU, and the
    run ends early."""
    max_updates: int | None = setting(None, *TOTAL, Mark.BUDGET, Mark.NOT_COMPILED)
    """Stop every seed after this many updates; with --num-episodes 1, as many episodes."""
    stop_when_solved: bool = setting(
        False, Mark.BUDGET, once="a run would end when others beside it are solved"
    )
    """Stop once every seed's last evaluation reached the environment's reward threshold."""
    num_episodes: int | Literal["auto"] = _for_reinforce(16, *COUNT)
    """Complete episodes played for one update, for each seed. auto: as many as noise and signal of
    the gradient are equal with, measured as the seed learns. (ars: see --num-directions.)"""
    min_episodes: int = _for_reinforce(16, *SEVERAL, Reader.AUTO_EPISODES)
    """With --num-episodes auto, how many an update plays at least,"""
    max_episodes: int = _for_reinforce(2048, *SEVERAL, Reader.AUTO_EPISODES)
    """and at most: memory holds so many."""
    horizon: int | None = setting(None, *COUNT)
    """Steps after which an episode ends; the environment's own limit if not given."""
    one_start: bool = False
    """Begin all training episodes of a seed in one state; each seed has its own. Evaluations keep
    their own starts, so they show what the policy does where it was not trained."""
    engine: Literal["auto", "vmap", "fused", "native"] = setting(
        "auto", once="it changes no result but by rounding"
    )
    """How episodes are played: vmap (the step mapped by jax.vmap), fused (the step written out as
    scalar operations), native (whole episodes in machine code for this CPU or NVIDIA GPU), or auto,
    the fastest here."""
    like: Path | None = setting(None, Mark.PLACE, once="every configuration begins with it")
    """Take all settings from the run in this directory, but for what is given beside it."""
    init_from: str | None = setting(None, Mark.NOT_COMPILED, once="it is for one run")
    """Begin with the last policies of the run in this directory, which may have other settings, but
    for the policy's own. Seed i begins with the policy of its seed i, or of i modulo its seeds."""
    output: Path | None = setting(None, Mark.PLACE, once="it has one directory")
    """Run directory; runs/<env>-<time> if not given."""
    overwrite: bool = setting(False, Reader.DIRECTORY, Mark.PLACE, once="it has one directory")
    """Write into an output directory that is not empty, replacing a run's files there."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicySettings:
    """The network and the distribution of its actions."""

    policy: str = "auto"
    """Action distribution: normal (one trained std), normal-softplus and normal-sigmoid (std from
    the state), truncated-normal, clipped-normal, tanh-normal (on the action bounds), categorical
    (discrete actions), deterministic (ars only); auto is categorical where the actions are
    discrete, else normal, or deterministic for ars."""
    hidden_sizes: tuple[int, ...] = setting((32, 32), *LAYERS)
    """Units of the policy network's tanh layers; none, as the flag alone says, make it linear."""
    shared_trunk: bool = True
    """Compute means and stds in one network; else stds from the state have their own."""
    initializer: Literal["orthogonal", "torch"] = "orthogonal"
    """Initial weights: orthogonal, the last layer's scaled by 0.01, so that a fresh policy acts
    alike everywhere; or torch.nn.Linear's uniform ones."""
    initial_std: float = setting(0.5, *POSITIVE, Reader.STD, Mark.TRACED, Mark.LOG)
    """Standard deviation of the actions before training, in the action's unit."""
    final_std: float | None = _for_reinforce(
        None, *POSITIVE, Reader.DECAY_STEPS, Reader.FREE_STD, Mark.TRACED, Mark.LOG
    )
    """Towards this it shrinks over --decay-steps, besides what learning makes of it: some policies
    play well with their noise alone. Where --max-kl shortens updates it stays larger. None leaves
    it to learning."""
    rescale: bool = setting(True, Reader.CONTINUOUS)
    """Scale the mean so that the network's output 1 is the end of the action's range; else the
    output is the mean."""
    normalize_steps: int | None = setting(1000, Range.AT_LEAST_0, Range.INT32)
    """Scale observations by the statistics of about the first so many steps; 0 does not, None
    goes on for ever."""
    normalize_min_std: float = setting(
        0.0, *NOT_NEGATIVE, Reader.NORMALIZATION, Mark.TRACED, Mark.LOG
    )
    """They are divided by at least this, in the observation's unit: what hardly changes in those
    steps would be magnified for ever."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """What multiplies the gradient of an action's log-probability (reinforce)."""

    estimator: str = _for_reinforce("leave-one-out")
    """total-return; reward-to-go; leave-one-out (less that of the other episodes);
    value-baseline (less a learned value); and two that are published but odd: mean-log-prob,
    normalized-returns (their docstrings say how)."""
    ended_episodes: Literal["zero", "skip"] = _for_reinforce("zero", Reader.LEAVE_ONE_OUT)
    """How leave-one-out counts the other episodes that are over at a step: zero, as the 0 that
    they still earn; skip, not at all, which is less noisy where episodes end at different times."""
    discount: float = _for_reinforce(0.99, Range.SHARE, Mark.TRACED, Mark.LOG_OF_REST)
    """Discount of rewards, in [0, 1]."""
    final_discount: float | None = _for_reinforce(None, Range.SHARE, Mark.TRACED)
    """It goes to this one over the budget, evenly in the logarithm of 1 / (1 - discount), the
    steps that it looks ahead: noisy gradients want few, sure ones many. None: it stays."""
    reward_shift: float = _for_reinforce(0.0, Range.FINITE, Mark.TRACED)
    """Subtracted from the reward of every step for training alone, such as the bonus for staying
    alive, which may keep a policy from moving (Mania et al. 2018). Returns stay those of the
    task."""
    discount_weights: bool = _for_reinforce(False)
    """Multiply the weight at step t by discount^t, which most programs leave out."""
    standardize: bool = _for_reinforce(True)
    """Divide the weights by their standard deviation plus the floor below."""
    standardize_floor: float = _for_reinforce(
        10.0, *NOT_NEGATIVE, Reader.STANDARDIZE, Mark.TRACED, Mark.LOG
    )
    """Added to that standard deviation, in units of return."""
    value_learning_rate: float = _for_reinforce(
        3e-3, *RATE, Reader.VALUE_BASELINE, Mark.TRACED, Mark.LOG
    )
    """Adam's learning rate for the value network of value-baseline."""
    value_fit: Literal["minibatches", "full-batch"] = _for_reinforce(
        "minibatches", Reader.VALUE_BASELINE
    )
    """minibatches: it reads the time besides the observation, and is fitted, in units of the
    return's standard deviation, to steps drawn from the episodes; full-batch: as published programs
    do it, it reads the observation alone, and each gradient step takes the whole rollout."""
    value_fits: int = _for_reinforce(32, *STEPS, Reader.VALUE_BASELINE)
    """Its gradient steps an update, on the squared error."""
    value_batch_size: int = _for_reinforce(
        256, *COUNT, Reader.VALUE_BASELINE, Reader.VALUE_MINIBATCHES
    )
    """Steps of the episodes a minibatch, drawn with replacement."""
    value_hidden_sizes: tuple[int, ...] = _for_reinforce((64, 64), *LAYERS, Reader.VALUE_BASELINE)
    """Units of its tanh layers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How the gradient becomes changes of the parameters (reinforce)."""

    update: Literal["full-batch", "natural-gradient", "minibatches", "each-step"] = _for_reinforce(
        "full-batch"
    )
    """full-batch: one optimiser step a rollout; natural-gradient: one along the natural gradient,
    as long as --max-kl says, of which decays of the learning rate leave a share; minibatches:
    several, on steps drawn from it; each-step: one for every time step, in order. Only the first
    two measure gradient_snr."""
    natural_damping: float = _for_reinforce(0.1, *POSITIVE, Reader.NATURAL_GRADIENT, Mark.TRACED)
    """Added to the diagonal of the Fisher matrix of natural-gradient: directions in which the
    policy hardly changes are followed less far."""
    natural_iterations: int = _for_reinforce(
        10, *STEPS, Reader.NATURAL_GRADIENT, Reader.CONJUGATE_GRADIENTS
    )
    """Conjugate gradients that solve for its direction; a linear policy with the distribution
    normal needs none."""
    minibatch_updates: int = _for_reinforce(50, *STEPS, Reader.MINIBATCHES)
    """Optimiser steps a rollout, of minibatches."""
    minibatch_size: int = _for_reinforce(128, *COUNT, Reader.MINIBATCHES)
    """Steps of the episodes a minibatch, drawn with replacement; their loss is averaged."""
    loss_per: Literal["episode", "step"] = _for_reinforce("episode", Reader.WHOLE_EPISODES)
    """Average the gradient over episodes (the definition) or over steps."""
    entropy_cost: float = _for_reinforce(0.0, *NOT_NEGATIVE, Mark.TRACED)
    """Weight of the policy's entropy in the objective."""
    optimizer: Literal["adam", "adamw", "sgd"] = _for_reinforce("adam", Reader.OPTIMIZER)
    """The rule that turns a gradient into a step."""
    learning_rate: float = _for_reinforce(1e-2, *RATE, Reader.FIRST_RATE, Mark.TRACED, Mark.LOG)
    """The learning rate of the optimizer at the start."""
    momentum: float = _for_reinforce(0.9, Range.BELOW_1, Reader.OPTIMIZER, Reader.ADAM, Mark.TRACED)
    """Of adam, its b1: how much of the last mean gradient the next one keeps."""
    final_learning_rate: float | None = _for_reinforce(
        None, *RATE, Reader.DECAY, Mark.TRACED, Mark.LOG
    )
    """Learning rate after the decay, which is linear; a tenth of the first if not given."""
    decay_steps: int | Literal["budget"] | None = _for_reinforce("budget", *TOTAL, Mark.TRACED)
    """Env steps of a seed over which the learning rate decays, and the noise with --final-std:
    budget is as long as the run, whatever --env-steps or --max-updates says. None: it stays, or
    see --decay-updates."""
    decay_updates: int | None = _for_reinforce(None, *COUNT)
    """Updates over which the learning rate decays; needs --decay-steps None."""
    weight_decay: float = _for_reinforce(0.0, *NOT_NEGATIVE, Reader.OPTIMIZER)
    """adamw: the parameters shrink by learning rate times this; adam, sgd: this times the
    parameters is added to the gradient (L2, as in PyTorch)."""
    max_grad_norm: float | None = _for_reinforce(
        1.0, *POSITIVE, Reader.OPTIMIZER, Mark.TRACED, Mark.LOG
    )
    """The gradient is scaled down to at most this Euclidean norm; None leaves it."""
    max_kl: float | None = _for_reinforce(None, *POSITIVE, Mark.TRACED, Mark.LOG)
    """An update moves the policy by at most about this mean KL divergence, in nats, over the steps
    that it visited: a change that goes further is shortened. (A new scale of the observations
    comes on top.) None shortens none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Augmented random search (ars)."""

    num_directions: int = _for_ars(8, *COUNT)
    """Directions tried in an update, each by one episode forwards and one backwards."""
    top_directions: int | None = _for_ars(None, Range.AT_LEAST_1)
    """How many of them are used, those with the greatest returns; all if not given."""
    step_size: float = _for_ars(0.02, *RATE, Mark.TRACED, Mark.LOG)
    """Learning rate."""
    noise_std: float = _for_ars(0.03, *POSITIVE, Mark.TRACED, Mark.LOG)
    """Distance along a direction from the present parameters to those that are tried."""
    shared_starts: bool = _for_ars(False)
    """Start the two episodes of a direction alike."""
    ars_update: Literal["paper", "document"] = _for_ars("paper")
    """paper, or that of a published notebook with its mistakes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Playing the policies without training them."""

    eval_every: int = setting(5, *COUNT)
    """Updates between evaluations."""
    eval_episodes: int = setting(16, *COUNT)
    """Episodes of an evaluation, with the mode and as many with samples. Each seed has starts of
    its own, the same at every evaluation."""
    test_episodes: int | None = setting(None, *COUNT, once="it has no test")
    """Episodes of the test at the end, which plays --eval-episodes at a time, from other starts; as
    many as an evaluation if not given."""
    eval_seed: int = setting(0, Range.SEED, Mark.NOT_COMPILED)
    """Root of the evaluation's keys, apart from all training keys whatever its value."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckpointSettings:
    """Going on with a run that was interrupted, or whose budget is used."""

    checkpoint_every: int | None = setting(
        None, *COUNT, Mark.BUDGET, Mark.NOT_COMPILED, once="it is saved as a whole"
    )
    """Updates between checkpoints, to which a killed run falls back; about every minute if not
    given. They are written after evaluations."""
    resume: Path | None = setting(None, Mark.PLACE, once="it goes on as a whole")
    """Go on with the run in this directory, with its own settings. Only its budget may change:
    --env-steps, --max-updates, --stop-when-solved, --checkpoint-every. A run of your own
    module:Class needs its --env again."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Where the rows of metrics.csv go besides. The charts' step is the number of updates.

    A column is empty where nothing is measured: gradient_snr, the signal-to-noise ratio of the
    gradient over episodes, needs --update full-batch or natural-gradient, or ars, and two episodes
    or directions; explained_variance a baseline; clipped_gradients --max-grad-norm.
    """

    tensorboard: bool = setting(False, Mark.NOT_COMPILED, once="its rows are in results.csv")
    """Charts for TensorBoard in RUN/tensorboard: of each column the interquartile mean, quantiles
    and a histogram over seeds, and the first 16 seeds. To see them: pip install tensorboard, then
    tensorboard --logdir RUN."""
    wandb: bool = setting(False, Mark.NOT_COMPILED, once="its rows are in results.csv")
    """The same numbers for Weights & Biases (pip install wandb) in RUN/wandb, offline: wandb sync
    uploads them. With WANDB_MODE=online in the environment they are sent as the run goes on."""
    jsonl: bool = setting(False, Mark.NOT_COMPILED, once="its rows are in results.csv")
    """All rows in RUN/metrics.jsonl too, a JSON object a line."""


#: The groups of --help, in order, under their titles.
GROUPS = {
    "run": RunSettings,
    "policy": PolicySettings,
    "estimator": EstimatorSettings,
    "updates": UpdateSettings,
    "search": SearchSettings,
    "evaluation": EvaluationSettings,
    "checkpoints": CheckpointSettings,
    "logs": LogSettings,
}
#: The settings that --help alone shows: those that most runs change.
MAIN = (
    *("env", "env_steps", "minutes", "num_seeds", "output", "resume"),
    *("estimator", "num_episodes", "learning_rate", "hidden_sizes"),
)

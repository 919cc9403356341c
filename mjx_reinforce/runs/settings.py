"""The groups of settings of a run: one class a group of ``--help``, its docstrings the help."""

import dataclasses
from pathlib import Path
from typing import Literal


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What is trained, for how long, and where it is written."""

    env: str = "InvertedPendulum-v5"
    """Environment id; `python -m mjx_reinforce.envs` lists them. Or module:Class for your own."""
    algorithm: Literal["reinforce", "ars"] = "reinforce"
    """reinforce follows the policy gradient; ars (augmented random search, Mania et al. 2018)
    tries out changes of the parameters. Its own settings are in the group "search" below."""
    num_seeds: int = 4
    """How many independent seeds are trained together, in one compiled program."""
    seed: int = 0
    """Root of all randomness; the seeds' keys are split from it."""
    env_steps: int | None = 280_000
    """Training budget of each seed in env steps; it stops after the update that reaches it. What
    about a minute gives here if not given. None leaves it to --max-updates."""
    minutes: float | None = None
    """In place of --env-steps, about how long to train, all seeds together: the first updates show
    how many env steps that is. The number goes into config.json, so that --like RUN repeats the
    run to the last bit. Where episodes grow, later steps come faster, above all on a GPU, and the
    run ends early."""
    max_updates: int | None = None
    """Stop every seed after this many updates; with --num-episodes 1, as many episodes."""
    stop_when_solved: bool = False
    """Stop once every seed's last evaluation reached the environment's reward threshold."""
    num_episodes: int | Literal["auto"] = 16
    """Complete episodes played for one update, for each seed. auto: as many as noise and signal of
    the gradient are equal with, measured as the seed learns. (ars: see --num-directions.)"""
    min_episodes: int = 16
    """With --num-episodes auto, how many an update plays at least,"""
    max_episodes: int = 2048
    """and at most: memory holds so many."""
    horizon: int | None = None
    """Steps after which an episode ends; the environment's own limit if not given."""
    one_start: bool = False
    """Begin all training episodes of a seed in one state; each seed has its own. Evaluations keep
    their own starts, so they show what the policy does where it was not trained."""
    engine: Literal["auto", "vmap", "fused", "native"] = "auto"
    """How episodes are played: vmap (the step mapped by jax.vmap), fused (the step written out as
    scalar operations), native (whole episodes in machine code for this CPU or NVIDIA GPU), or auto,
    the fastest here."""
    like: Path | None = None
    """Take all settings from the run in this directory, but for what is given beside it."""
    init_from: str | None = None
    """Begin with the last policies of the run in this directory, which may have other settings, but
    for the policy's own. Seed i begins with the policy of its seed i, or of i modulo its seeds."""
    output: Path | None = None
    """Run directory; runs/<env>-<time> if not given."""
    overwrite: bool = False
    """Write into an output directory that is not empty, replacing a run's files there."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicySettings:
    """The network and the distribution of its actions."""

    policy: str = "auto"
    """Action distribution: normal (one trained std), normal-softplus and normal-sigmoid (std from
    the state), truncated-normal, clipped-normal, tanh-normal (on the action bounds), categorical
    (discrete actions), deterministic (ars only); auto is categorical where the actions are
    discrete, else normal, or deterministic for ars."""
    hidden_sizes: tuple[int, ...] = (32, 32)
    """Units of the policy network's tanh layers; none, as the flag alone says, make it linear."""
    shared_trunk: bool = True
    """Compute means and stds in one network; else stds from the state have their own."""
    initializer: Literal["orthogonal", "torch"] = "orthogonal"
    """Initial weights: orthogonal, the last layer's scaled by 0.01, so that a fresh policy acts
    alike everywhere; or torch.nn.Linear's uniform ones."""
    initial_std: float = 0.5
    """Standard deviation of the actions before training, in the action's unit."""
    final_std: float | None = None
    """Towards this it shrinks over --decay-steps, besides what learning makes of it: some policies
    play well with their noise alone. Where --max-kl shortens updates it stays larger. None leaves
    it to learning."""
    rescale: bool = True
    """Scale the mean so that the network's output 1 is the end of the action's range; else the
    output is the mean."""
    normalize_steps: int | None = 1000
    """Scale observations by the statistics of about the first so many steps; 0 does not, None
    goes on for ever."""
    normalize_min_std: float = 0.0
    """They are divided by at least this, in the observation's unit: what hardly changes in those
    steps would be magnified for ever."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """What multiplies the gradient of an action's log-probability (reinforce)."""

    estimator: str = "leave-one-out"
    """total-return; reward-to-go; leave-one-out (less that of the other episodes);
    value-baseline (less a learned value); and two that are published but odd: mean-log-prob,
    normalized-returns (their docstrings say how)."""
    ended_episodes: Literal["zero", "skip"] = "zero"
    """How leave-one-out counts the other episodes that are over at a step: zero, as the 0 that
    they still earn; skip, not at all, which is less noisy where episodes end at different times."""
    discount: float = 0.99
    """Discount of rewards, in [0, 1]."""
    final_discount: float | None = None
    """It goes to this one over the budget, evenly in the logarithm of 1 / (1 - discount), the
    steps that it looks ahead: noisy gradients want few, sure ones many. None: it stays."""
    reward_shift: float = 0.0
    """Subtracted from the reward of every step for training alone, such as the bonus for staying
    alive, which may keep a policy from moving (Mania et al. 2018). Returns stay those of the
    task."""
    discount_weights: bool = False
    """Multiply the weight at step t by discount^t, which most programs leave out."""
    standardize: bool = True
    """Divide the weights by their standard deviation plus the floor below."""
    standardize_floor: float = 10.0
    """Added to that standard deviation, in units of return."""
    value_learning_rate: float = 3e-3
    """Adam's learning rate for the value network of value-baseline."""
    value_fit: Literal["minibatches", "full-batch"] = "minibatches"
    """minibatches: it reads the time besides the observation, and is fitted, in units of the
    return's standard deviation, to steps drawn from the episodes; full-batch: as published programs
    do it, it reads the observation alone, and each gradient step takes the whole rollout."""
    value_fits: int = 32
    """Its gradient steps an update, on the squared error."""
    value_batch_size: int = 256
    """Steps of the episodes a minibatch, drawn with replacement."""
    value_hidden_sizes: tuple[int, ...] = (64, 64)
    """Units of its tanh layers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UpdateSettings:
    """How the gradient becomes changes of the parameters (reinforce)."""

    update: Literal["full-batch", "natural-gradient", "minibatches", "each-step"] = "full-batch"
    """full-batch: one optimiser step a rollout; natural-gradient: one along the natural gradient,
    as long as --max-kl says, of which decays of the learning rate leave a share; minibatches:
    several, on steps drawn from it; each-step: one for every time step, in order. Only the first
    two measure gradient_snr."""
    natural_damping: float = 0.1
    """Added to the diagonal of the Fisher matrix of natural-gradient: directions in which the
    policy hardly changes are followed less far."""
    natural_iterations: int = 10
    """Conjugate gradients that solve for its direction; a linear policy with the distribution
    normal needs none."""
    minibatch_updates: int = 50
    """Optimiser steps a rollout, of minibatches."""
    minibatch_size: int = 128
    """Steps of the episodes a minibatch, drawn with replacement; their loss is averaged."""
    loss_per: Literal["episode", "step"] = "episode"
    """Average the gradient over episodes (the definition) or over steps."""
    entropy_cost: float = 0.0
    """Weight of the policy's entropy in the objective."""
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    """The rule that turns a gradient into a step."""
    learning_rate: float = 1e-2
    """The learning rate of the optimizer at the start."""
    momentum: float = 0.9
    """Of adam, its b1: how much of the last mean gradient the next one keeps."""
    final_learning_rate: float | None = None
    """Learning rate after the decay, which is linear; a tenth of the first if not given."""
    decay_steps: int | Literal["budget"] | None = "budget"
    """Env steps of a seed over which the learning rate decays, and the noise with --final-std:
    budget is as long as the run, whatever --env-steps or --max-updates says. None: it stays, or
    see --decay-updates."""
    decay_updates: int | None = None
    """Updates over which the learning rate decays; needs --decay-steps None."""
    weight_decay: float = 0.0
    """adamw: the parameters shrink by learning rate times this; adam, sgd: this times the
    parameters is added to the gradient (L2, as in PyTorch)."""
    max_grad_norm: float | None = 1.0
    """The gradient is scaled down to at most this Euclidean norm; None leaves it."""
    max_kl: float | None = None
    """An update moves the policy by at most about this mean KL divergence, in nats, over the steps
    that it visited: a change that goes further is shortened. (A new scale of the observations
    comes on top.) None shortens none."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Augmented random search (ars)."""

    num_directions: int = 8
    """Directions tried in an update, each by one episode forwards and one backwards."""
    top_directions: int | None = None
    """How many of them are used, those with the greatest returns; all if not given."""
    step_size: float = 0.02
    """Learning rate."""
    noise_std: float = 0.03
    """Distance along a direction from the present parameters to those that are tried."""
    shared_starts: bool = False
    """Start the two episodes of a direction alike."""
    ars_update: Literal["paper", "document"] = "paper"
    """paper, or that of a published notebook with its mistakes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Playing the policies without training them."""

    eval_every: int = 5
    """Updates between evaluations."""
    eval_episodes: int = 16
    """Episodes of an evaluation, with the mode and as many with samples. Each seed has starts of
    its own, the same at every evaluation."""
    test_episodes: int | None = None
    """Episodes of the test at the end, which plays --eval-episodes at a time, from other starts; as
    many as an evaluation if not given."""
    eval_seed: int = 0
    """Root of the evaluation's keys, apart from all training keys whatever its value."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckpointSettings:
    """Going on with a run that was interrupted, or whose budget is used."""

    checkpoint_every: int | None = None
    """Updates between checkpoints, to which a killed run falls back; about every minute if not
    given. They are written after evaluations."""
    resume: Path | None = None
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

    tensorboard: bool = False
    """Charts for TensorBoard in RUN/tensorboard: of each column the interquartile mean, quantiles
    and a histogram over seeds, and the first 16 seeds. To see them: pip install tensorboard, then
    tensorboard --logdir RUN."""
    wandb: bool = False
    """The same numbers for Weights & Biases (pip install wandb) in RUN/wandb, offline: wandb sync
    uploads them. With WANDB_MODE=online in the environment they are sent as the run goes on."""
    jsonl: bool = False
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

"""Published programs, setting by setting, under names for the command line.

Their network weights, optimisers and constants are those of the programs. Two things are ours:
five seeds train together, so that there is an interval, and each is evaluated as in every other
run, beside the training returns that the programs report. Our random numbers are not theirs.
"""

import dataclasses
import math

from mjx_reinforce.settings.config import Config

# What they share: PyTorch's weights, one episode an update, and none of our own additions.
_PLAIN = Config(
    num_seeds=5,
    env_steps=None,
    num_episodes=1,
    initializer="torch",
    rescale=False,
    normalize_steps=0,
    estimator="reward-to-go",
    standardize=False,
    decay_steps=None,
    max_grad_norm=None,
)

_TUTORIAL = dataclasses.replace(
    _PLAIN,
    env="InvertedPendulum-v4",
    max_updates=5000,
    one_start=True,
    policy="normal-softplus",
    hidden_sizes=(16, 32),
    initial_std=math.log(2.0),  # log(1 + exp(0)): the network's second output is used as it is
    optimizer="adamw",
    learning_rate=1e-4,
    weight_decay=0.01,
    eval_every=100,
)

_BASELINE = dataclasses.replace(
    _PLAIN,
    env="InvertedDoublePendulum-v5",
    max_updates=20_000,
    policy="truncated-normal",
    hidden_sizes=(64, 64),
    initial_std=1.0,
    estimator="value-baseline",
    discount_weights=True,
    value_learning_rate=3e-4,
    value_fit="full-batch",
    value_fits=1,
    loss_per="step",
    learning_rate=3e-4,
    eval_every=500,
)

_CONTINUOUS = dataclasses.replace(
    _PLAIN,
    env="ContinuousCartPole-v0",
    max_updates=20,
    num_episodes=100,
    policy="normal-sigmoid",
    hidden_sizes=(),
    initial_std=0.5,  # sigmoid(0)
    estimator="normalized-returns",
    update="minibatches",
    minibatch_updates=50,
    minibatch_size=128,
    learning_rate=1e-3,
    weight_decay=1e-4,
    eval_every=1,
    eval_episodes=20,
)

_SEARCH = dataclasses.replace(
    _PLAIN,
    algorithm="ars",
    env="ContinuousCartPole-v0",
    max_updates=500,
    hidden_sizes=(),
    num_directions=10,
    step_size=1.0,
    noise_std=0.1,
    ars_update="document",
    eval_every=20,
    eval_episodes=20,
)

_CATEGORICAL = dataclasses.replace(
    _PLAIN,
    env="CartPole-v0",
    max_updates=5000,
    policy="categorical",
    hidden_sizes=(),
    update="each-step",
    learning_rate=1e-3,
    eval_every=100,
)

#: name -> (a line for --help, the settings).
PRESETS: dict[str, tuple[str, Config]] = {
    "gymnasium-tutorial": (
        "Gymnasium's REINFORCE tutorial: reward to go, AdamW, one start state a seed",
        _TUTORIAL,
    ),
    "gymnasium-tutorial-v0.26": (
        "its first version: mean log-probability times the sum of returns",
        dataclasses.replace(_TUTORIAL, estimator="mean-log-prob"),
    ),
    "baseline-truncated-normal": (
        "REINFORCE with a learned value, actions within their bounds; --env for other tasks",
        _BASELINE,
    ),
    "continuous-cartpole": (
        "100 episodes, returns normalised in each, then 50 minibatches; a linear policy",
        _CONTINUOUS,
    ),
    "continuous-cartpole-ars": (
        "the same task by random search, with its mistakes; --ars-update paper is without",
        _SEARCH,
    ),
    "categorical-cartpole": (
        "discrete actions, linear softmax; one optimiser step a time step",
        _CATEGORICAL,
    ),
}

"""The floating-point operations of a run's networks, for an estimate of its time.

A layer takes two for each of its weights forwards, and four backwards.
"""

from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.measured import Task
from mjx_reinforce.settings.memory import critic_parameters, num_parameters

_FORWARDS, _BACKWARDS = 2, 4
#: Steps that each of the natural gradient's iterations passes over at most, forwards and backwards.
_FISHER_STEPS = 4096


def per_step(config: Config, task: Task) -> float:
    """Returns the operations for each env step that a run plays and trains on.

    The policy plays and measures how far it moved, and learns from each step once, or from what
    minibatches draw; the natural gradient passes over some of them again and again. The value
    network gives each step its value, and is fitted ``value_fits`` times, on all of them or on
    minibatches.

    Args:
      config: the settings.
      task: the sizes of the task; ``config`` may have another time limit.
    """
    policy = num_parameters(config, task)
    if config.algorithm == "ars":
        return _FORWARDS * policy
    steps = config.fewest_episodes * config.training_horizon(task.horizon)
    learned = 1.0
    if config.update == "minibatches":
        learned = config.minibatch_updates * config.minibatch_size / steps
    elif config.update == "natural-gradient" and config.hidden_sizes:
        learned += config.natural_iterations * min(1, _FISHER_STEPS / steps)
    fitted = config.value_fits
    if config.value_fit == "minibatches":
        fitted *= config.value_batch_size / steps
    once = _FORWARDS + _BACKWARDS
    value = critic_parameters(config, task) * (_FORWARDS + once * fitted)
    return (2 * _FORWARDS + once * learned) * policy + value

"""How much memory the networks of a run take: foretold, before anything is compiled.

What is counted is certain to be there at one time. What XLA adds is known when it has compiled, see
``training.slots``.
"""

import itertools
import math

import jax

from mjx_reinforce.engine.base import Environment, observation_size
from mjx_reinforce.engine.devices import check_room
from mjx_reinforce.learning.contract import check_num_steps
from mjx_reinforce.learning.policy import Policy
from mjx_reinforce.learning.samples import chunk_length
from mjx_reinforce.learning.updates import num_noise_episodes
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.groups import Reader

_FLOAT_SIZE = 4
#: Copies of the states of training while an update is made: those before it and after it on the
#: device; on the host its own, those before the last block, and the policies alone the best.
_DEVICE_STATES = 2
_HOST_STATES = 2
#: What an optimizer keeps of each parameter, with the parameter itself.
_ADAM_SIZE = 3
_SGD_SIZE = 1
#: Vectors of the conjugate gradients: the solution, the residual, the direction, its product.
_SOLVER_VECTORS = 4


def check_networks(
    env: Environment, config: Config, policy: Policy, horizon: int, num_seeds: int
) -> None:
    """Raises ValueError where the networks of a run cannot fit into memory.

    Args:
      env: what they see.
      config: the settings.
      policy: whose parameters are trained.
      horizon: T, the time limit of a training episode in steps.
      num_seeds: how many a device trains at once.
    """
    check_num_steps(config.episodes_per_update, horizon)
    num_bytes = num_seeds * float(_of_seed(config, policy, observation_size(env), horizon))
    check_room(num_bytes)


def _of_seed(config: Config, policy: Policy, entries: int, horizon: int) -> int:
    """Returns the bytes of one seed's networks; ``entries`` is the size of an observation.

    Of other algorithms than ``reinforce`` it counts what any keeps, the parameters.
    """
    leaves = jax.tree.leaves(jax.eval_shape(policy.init, jax.random.key(0)))
    param_bytes = _FLOAT_SIZE * sum(math.prod(x.shape) for x in leaves)
    state_bytes = param_bytes
    scratch = 0
    if config.algorithm == "reinforce":
        value_bytes = _value_bytes(config, entries)
        is_natural = config.update == "natural-gradient"
        # Natural gradients take their steps by SGD, whatever the optimizer of the settings is.
        is_adam = config.optimizer == "adam" and not is_natural
        state_bytes = (
            _ADAM_SIZE if is_adam else _SGD_SIZE
        ) * param_bytes + _ADAM_SIZE * value_bytes
        # Vectors as long as the parameters: the gradient, those of groups of episodes that tell
        # its noise, and the solver's. Then what the hidden layers put out for a chunk of steps.
        vectors = 1 + num_noise_episodes(config.num_episodes) + _SOLVER_VECTORS * is_natural
        samples = config.num_episodes * chunk_length(horizon, config.num_episodes)
        scratch = (
            vectors * param_bytes + value_bytes + _FLOAT_SIZE * samples * sum(config.hidden_sizes)
        )
    # On a CPU the host's memory is the device's too.
    host_bytes = 0
    if jax.default_backend() == "cpu":
        host_bytes = _HOST_STATES * state_bytes + param_bytes
    return _DEVICE_STATES * state_bytes + scratch + host_bytes


def _value_bytes(config: Config, entries: int) -> int:
    """Returns the bytes of a value network, 0 without one; it sees the time too."""
    if not Reader.VALUE_BASELINE.holds(config):
        return 0
    layer_sizes = entries + 1, *config.value_hidden_sizes, 1
    return _FLOAT_SIZE * sum((x + 1) * y for x, y in itertools.pairwise(layer_sizes))

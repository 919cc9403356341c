"""The seeds of a run in one slot, without a plan, files or a driver."""

import numpy as np

from mjx_reinforce.training.slots import Slots, compile_slots


def compile_run(programs, config):
    """Returns the seeds of a run before the first update, in one slot."""
    compiled = compile_slots(programs, config, programs.division.capacity(config.num_seeds))
    return Slots(compiled, config.first_seed + np.arange(config.num_seeds))

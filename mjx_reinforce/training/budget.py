"""How much of its budget a run has used."""

import numpy as np

from mjx_reinforce.settings.config import Config


def used(config: Config, env_steps: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Returns the fraction of its budget that each seed has used, of counts [..., S]."""
    fraction = np.zeros(env_steps.shape)
    if config.env_steps is not None:
        fraction = env_steps / config.env_steps
    if config.max_updates is not None:
        fraction = np.maximum(fraction, updates / config.max_updates)
    return fraction

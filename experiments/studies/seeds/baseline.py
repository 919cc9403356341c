"""The learned baseline of the seeds study: small, since its fits take most of the time."""

from typing import Any

import mjx_reinforce as mr
from mjx_reinforce.learning.policy import MLP


def make(discount: Any) -> mr.Estimator:
    """Returns a value baseline that reads the observation and is fitted to whole rollouts."""
    return mr.full_batch_value_baseline(discount, network=MLP((32, 32), 1), num_fits=10)

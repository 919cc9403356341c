"""The settings that are trained, and their names on the page."""

import dataclasses
import math

from experiments.studies.failures.runs import Setting
from mjx_reinforce.settings.config import flag

#: The mended settings: those that differ from the base's.
_MENDED = {
    "num_episodes": 8,
    "max_kl": 0.02,
    "discount": 0.988,
    "standardize_floor": 5.0,
    "decay_steps": 200_000,
    "final_learning_rate": 1e-5,
}
MENDED = Setting(**_MENDED, decay_updates=math.inf, env_steps=200_000, max_updates=200)
#: The same as flags.
MENDED_FLAGS = " ".join(f"{flag(k)} {v:g}" for k, v in _MENDED.items())
#: The first is the base; the others, down to ``linear``, change one thing of it.
ARMS = {
    "base": Setting(),
    "position-scale": Setting(least_position_scale=0.2),
    "clip": Setting(clip=1e6),
    "normalize-3000": Setting(normalize_steps=3000),
    "normalize-10000": Setting(normalize_steps=10_000),
    "max-kl": Setting(max_kl=0.02),
    "momentum": Setting(momentum=0.0),
    "linear": Setting(hidden_sizes=()),
    "both": Setting(max_kl=0.02, least_position_scale=0.2),
    "all": Setting(max_kl=0.02, least_position_scale=0.2, momentum=0.0),
    "mended": MENDED,
    "mended-scale": dataclasses.replace(MENDED, least_position_scale=0.2),
}
#: The arms in words.
WORDS = {
    "base": "nothing changed",
    "position-scale": "position divided by 0.2 m at least",
    "clip": "observations not clipped",
    "normalize-3000": "scale of the first 3,000 steps",
    "normalize-10000": "scale of the first 10,000 steps",
    "max-kl": "KL of an update at most 0.02",
    "momentum": "Adam without momentum (b1 = 0)",
    "linear": "a linear policy",
    "both": "KL at most 0.02, position by 0.2 m",
    "all": "these two, and no momentum",
    "mended": "the mended settings",
    "mended-scale": "the mended settings, position by 0.2 m",
}

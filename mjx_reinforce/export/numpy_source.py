"""A policy as a Python file that needs NumPy alone."""

from mjx_reinforce.export.arithmetic import Arithmetic

_PLAYER = '''"""A trained policy's deterministic action, written by mjx_reinforce.export.

It needs NumPy, and {name}.npz beside this file:

    import {name}
    action = {name}.act(observation)  # {shapes}
"""

from pathlib import Path

import numpy as np

#: What it was trained on, and the number of the seed.
ENVIRONMENT, SEED = {env}, {seed}
with np.load(Path(__file__).with_suffix(".npz")) as archive:
    P = dict(archive)


def act(observation):
    """Returns the action for an observation."""
    x = np.asarray(observation, np.float32)
    {body}
'''


def numpy_source(plain: Arithmetic, name: str, env: str, seed: int) -> str:
    """Returns the text of a module with a function ``act``.

    Args:
      plain: what it computes.
      name: of the module, and of the archive of ``plain.arrays`` beside it.
      env: the id of the environment.
      seed: the number of the seed.
    """
    size, out = plain.sizes
    shapes = f"[{size}] -> [{out}], or [N, {size}] -> [N, {out}]"
    if plain.head == "argmax":
        shapes = f"[{size}] -> an integer, or [N, {size}] -> [N]"
    body = "\n    ".join(_statements(plain))
    return _PLAYER.format(name=name, shapes=shapes, env=ascii(env), seed=seed, body=body)


def _statements(plain: Arithmetic) -> list[str]:
    """Returns the statements that make the action of the observation x."""
    lines = []
    if plain.normalized:
        lines.append(f'x = np.clip((x - P["mean"]) / P["std"], -{plain.clip}, {plain.clip})')
    layers = [f'x @ P["weight_{i}"] + P["bias_{i}"]' for i in range(plain.num_layers)]
    lines += [f"x = np.tanh({layer})" for layer in layers[:-1]]
    endings = {
        "mean": "x",
        "clip": 'np.clip(x, P["low"], P["high"])',
        "tanh": 'P["middle"] + P["half"] * np.tanh(x)',
        "argmax": "np.argmax(x, axis=-1)",
    }
    return [*lines, f"x = {layers[-1]}", f"return {endings[plain.head]}"]

"""A trained policy's deterministic action as plain arithmetic, in Python."""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.export.policy_files import SavedPolicy, saved_action_space
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import gaussian_outputs, middle_and_half_range

#: What the deterministic action of a family is of the network's last layer x, once the scaling
#: of means is part of that layer: x, x clipped to the bounds, middle + half tanh(x), or the
#: number of the greatest entry.
HEADS: dict[str, Literal["mean", "clip", "tanh", "argmax"]] = {
    "normal": "mean",
    "normal-softplus": "mean",
    "normal-sigmoid": "mean",
    "deterministic": "mean",
    "truncated-normal": "clip",
    "clipped-normal": "clip",
    "tanh-normal": "tanh",
    "categorical": "argmax",
}


class Arithmetic(NamedTuple):
    """The deterministic action, as arithmetic on float32.

    arrays: by name: ``mean`` and ``std`` [O] if observations are scaled, ``weight_i`` [I, J] and
      ``bias_i`` [J] of layer i, ``low`` and ``high`` [A] for "clip", ``middle`` and ``half`` [A]
      for "tanh"
    num_layers: how many layers there are; all but the last have tanh units
    head: one of ``HEADS``
    clip: what scaled observations are clipped to, on both sides
    """

    arrays: dict[str, np.ndarray]
    num_layers: int
    head: str
    clip: float = normalize.CLIP

    @property
    def normalized(self) -> bool:
        """Whether observations are scaled."""
        return "mean" in self.arrays

    @property
    def sizes(self) -> tuple[int, int]:
        """O and the number of entries of the last layer."""
        return len(self.arrays["weight_0"]), len(self.arrays[f"bias_{self.num_layers - 1}"])


def arithmetic(saved: SavedPolicy) -> Arithmetic:
    """Returns the arithmetic of one seed's policy.

    Args:
      saved: with the actor of one seed.

    Raises:
      ValueError: the family of its distribution is not in ``HEADS``.
    """
    family = saved.settings["policy"]
    check_name("policy for export", family, HEADS)
    layers = _layers(saved.actor.params["network"]["params"])
    middle, half, extra = _ending(HEADS[family], saved.settings)
    # Further columns of a shared trunk are standard deviations, which the mode does not need.
    weight, bias = (x[..., : len(half)].astype(np.float64) for x in layers[-1])
    layers[-1] = weight * half, bias * half + middle
    arrays: dict[str, Any] = _scaling(saved.actor.normalizer)
    for i, (weight, bias) in enumerate(layers):
        arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
    arrays = {name: np.asarray(x, np.float32) for name, x in (arrays | extra).items()}
    return Arithmetic(arrays, len(layers), HEADS[family])


def _layers(params: dict[str, Any]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the weights [I, J] and biases [J] of an MLP's layers, from first to last."""
    names = (f"Dense_{i}" for i in range(len(params)))
    return [(np.asarray(params[n]["kernel"]), np.asarray(params[n]["bias"])) for n in names]


def _scaling(normalizer: normalize.Normalizer) -> dict[str, Any]:
    """Returns the mean and divisor of observations, or nothing where they are not scaled."""
    if normalizer.count <= 0:
        return {}
    return {"mean": normalizer.mean, "std": normalize.standard_deviation(normalizer)}


def _ending(head: str, settings: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Returns what the last layer is multiplied by, what is added, and the arrays of the head.

    Args:
      head: one of ``HEADS``.
      settings: of the policy, see ``save_policy``.

    Returns:
      ``middle`` and ``half``, one entry for each entry of the last layer, and the arrays.
    """
    space = saved_action_space(settings)
    if isinstance(space, Discrete):
        return np.zeros(space.num_actions), np.ones(space.num_actions), {}
    rescale = settings.get("rescale", True)
    means = gaussian_outputs(settings["policy"], space, "parameter", 1.0, rescale)
    if head == "clip":
        return means.middle, means.half, {"low": space.low, "high": space.high}
    if head == "tanh":
        middle, half = middle_and_half_range(space)
        extra = {"middle": middle, "half": half}
        return (means.middle - middle) / half, means.half / half, extra
    return means.middle, means.half, {}


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
    if plain.head == "mean":
        shapes += "\n\nActions are not clipped: clip to the actuators' range before you send it."
    body = "\n    ".join(_statements(plain))
    template = Path(__file__).with_name("numpy_policy.txt").read_text("utf-8")
    return template.format(name=name, shapes=shapes, env=ascii(env), seed=seed, body=body)


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

"""A trained policy's deterministic action as plain arithmetic, in Python."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.export.policy_files import SavedPolicy, saved_action_space
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import gaussian_outputs, middle_and_half_range

#: What the deterministic action of a family is of the network's last layer x, once the scaling
#: of means is part of that layer: x clipped to the bounds, middle + half tanh(x), or the number of
#: the greatest entry.
HEADS: dict[str, Literal["clip", "tanh", "argmax"]] = {
    "normal": "clip",
    "normal-softplus": "clip",
    "normal-sigmoid": "clip",
    "deterministic": "clip",
    "truncated-normal": "clip",
    "tanh-normal": "tanh",
    "categorical": "argmax",
}
#: How the action follows from the last layer x, by what it is.
_ENDINGS = {
    "clip": 'np.clip(x, P["low"], P["high"])',
    "tanh": 'P["middle"] + P["half"] * np.tanh(x)',
    "argmax": "np.argmax(x, axis=-1)",
}


def numpy_policy(
    saved: SavedPolicy, name: str, env: str, seed: int
) -> tuple[dict[str, np.ndarray], str]:
    """Returns the arrays of one seed's policy, and the text of a module with a function ``act``.

    Args:
      saved: with the actor of one seed.
      name: of the module, and of the archive of the arrays beside it.
      env: the id of the environment.
      seed: the number of the seed.

    Raises:
      ValueError: the family of its distribution is not in ``HEADS``.
    """
    family = saved.settings["policy"]
    check_name("policy for export", family, HEADS)
    head = HEADS[family]
    params = saved.actor.params["network"]["params"]
    layer_params = [params[f"Dense_{i}"] for i in range(len(params))]
    layers = [(np.asarray(x["kernel"]), np.asarray(x["bias"])) for x in layer_params]
    middle, half_range, arrays = _ending(head, saved.settings)
    # Further columns are standard deviations, which the mode does not need.
    weight, bias = (x[..., : len(half_range)].astype(np.float64) for x in layers[-1])
    # In float64, so that an entry is rounded once, at the end.
    layers[-1] = weight * half_range, bias * half_range + middle
    lines = []
    # A policy that was trained without scaled observations has a normalizer that counted nothing.
    normalizer = saved.actor.normalizer
    if normalizer.count > 0:
        arrays |= {"mean": normalizer.mean, "std": normalize.standard_deviation(normalizer)}
        scaled = '(x - P["mean"]) / P["std"]'
        lines = [f"x = np.clip({scaled}, -{normalize.CLIP}, {normalize.CLIP})"]
    for i, (weight, bias) in enumerate(layers):
        arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
        layer = f'x @ P["weight_{i}"] + P["bias_{i}"]'
        # The last layer is linear; its nonlinearity is in the ending.
        if i < len(layers) - 1:
            layer = f"np.tanh({layer})"
        lines.append(f"x = {layer}")
    lines.append(f"return {_ENDINGS[head]}")
    inputs = len(layers[0][0])
    outputs = len(half_range)
    shapes = f"[{inputs}] -> [{outputs}], or [N, {inputs}] -> [N, {outputs}]"
    if head == "argmax":
        shapes = f"[{inputs}] -> an integer, or [N, {inputs}] -> [N]"
    if head == "clip":
        shapes += "\n\nActions are clipped to the range that the environment declared."
    template = Path(__file__).with_name("numpy_policy.txt").read_text("utf-8")
    body = "\n    ".join(lines)
    source = template.format(name=name, shapes=shapes, env=ascii(env), seed=seed, body=body)
    return {name: np.asarray(x, np.float32) for name, x in arrays.items()}, source


def _ending(head: str, settings: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Returns what is added to the last layer, what it is multiplied by, and the head's arrays.

    Args:
      head: one of ``HEADS``.
      settings: of the policy, see ``save_policy``.

    Returns:
      ``middle`` and ``half_range``, one entry for each entry of the last layer, and the arrays.
    """
    space = saved_action_space(settings)
    if isinstance(space, Discrete):
        return np.zeros(space.num_actions), np.ones(space.num_actions), {}
    rescale = settings.get("rescale", True)
    means = gaussian_outputs(settings["policy"], space, "parameter", 1.0, rescale)
    if head == "clip":
        return means.middle, means.half, {"low": space.low, "high": space.high}
    # The mode is middle + half * tanh((mean - middle) / half): the fraction joins the last layer.
    middle, half_range = middle_and_half_range(space)
    arrays = {"middle": middle, "half": half_range}
    return (means.middle - middle) / half_range, means.half / half_range, arrays

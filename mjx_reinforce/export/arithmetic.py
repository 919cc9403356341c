"""A trained policy's deterministic action as plain arithmetic, which each format writes down."""

from typing import Any, Literal, NamedTuple

import numpy as np

from mjx_reinforce.engine.base import Discrete
from mjx_reinforce.engine.checks import check_name
from mjx_reinforce.export.policy_files import SavedPolicy, saved_action_space
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import gaussian_outputs, middle_and_half_range

#: What the deterministic action of a family is of the network's last layer x, once the scaling
#: of means is part of that layer: x clipped to the bounds, middle + half tanh(x) clipped likewise,
#: or the number of the greatest entry.
HEADS: dict[str, Literal["clip", "tanh", "argmax"]] = {
    "normal": "clip",
    "normal-softplus": "clip",
    "normal-sigmoid": "clip",
    "deterministic": "clip",
    "truncated-normal": "clip",
    "tanh-normal": "tanh",
    "categorical": "argmax",
}


class Arithmetic(NamedTuple):
    """What a policy computes, in float32.

    scale: ``mean`` and ``std`` [O] of the observations, which are scaled by them and clipped to
      ``normalize.CLIP``; empty if the policy was trained without
    layers: the weight [I, J] and the bias [J] of each; tanh follows each but the last
    head: what follows the last layer, of ``HEADS``
    bounds: what the head needs, [A] each: ``low`` and ``high``; for "tanh" also ``middle`` and
      ``half``; empty for "argmax"
    frames: how many observations of the environment, the oldest first, are one of the policy's
    control: what the task applies of an action, see ``affine_control``; empty where nobody asked
    """

    scale: Arrays
    layers: list[tuple[np.ndarray, np.ndarray]]
    head: Literal["clip", "tanh", "argmax"]
    bounds: Arrays
    frames: int
    control: Arrays


def policy_arithmetic(saved: SavedPolicy) -> Arithmetic:
    """Returns what the policy of one seed computes.

    Args:
      saved: with the actor of one seed.

    Raises:
      ValueError: the family of its distribution is not in ``HEADS``.
    """
    family = saved.settings["policy"]
    check_name("policy for export", family, HEADS)
    head = HEADS[family]
    params = saved.actor.params["network"]["params"]
    layer_params = [params[f"Dense_{i}"] for i in range(len(params))]
    layers = [(np.asarray(x["kernel"]), np.asarray(x["bias"])) for x in layer_params]
    middle, half_range, bounds = _ending(head, saved.settings)
    # Further columns are standard deviations, which the mode does not need.
    weight, bias = (x[..., : len(half_range)].astype(np.float64) for x in layers[-1])
    # In float64, so that an entry is rounded once, at the end.
    layers[-1] = weight * half_range, bias * half_range + middle
    scale = {}
    # A policy that was trained without scaled observations has a normalizer that counted nothing.
    normalizer = saved.actor.normalizer
    if normalizer.count > 0:
        scale = {"mean": normalizer.mean, "std": normalize.standard_deviation(normalizer)}
    return Arithmetic(
        scale=_single(scale),
        layers=[(weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers],
        head=head,
        bounds=_single(bounds),
        frames=int(saved.settings.get("frames", 1)),
        control={},
    )


def _single(arrays: dict[str, Any]) -> Arrays:
    """Returns arrays in float32."""
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


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
    bounds = {"low": space.low, "high": space.high}
    if head == "clip":
        return means.middle, means.half, bounds
    # The mode is middle + half * tanh((mean - middle) / half): the fraction joins the last layer.
    middle, half_range = middle_and_half_range(space)
    bounds |= {"middle": middle, "half": half_range}
    return (means.middle - middle) / half_range, means.half / half_range, bounds

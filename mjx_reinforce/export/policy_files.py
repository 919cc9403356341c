"""Trained policies on disk: a NumPy archive and a JSON file, never pickle."""

import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization, traverse_util

from mjx_reinforce.export.files import write_arrays, write_json
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.policies.normalize import Normalizer
from mjx_reinforce.policies.policy import Policy, mlp_policy
from mjx_reinforce.registry import DISTRIBUTIONS, check_name, load
from mjx_reinforce.types import Box, Discrete


def save_policy(directory: Path, actor: Actor, settings: dict[str, Any]) -> None:
    """Writes the actors of all seeds and how to rebuild their policy.

    Args:
      directory: made if it does not exist; ``actor.npz`` and ``policy.json`` in it.
      actor: every leaf with a leading seed axis [S, ...].
      settings: ``policy`` (a name), ``hidden_sizes``, ``initial_std``, ``observation_size``,
        ``action_low`` and ``action_high`` or, if discrete, ``num_actions``; optionally
        ``shared_trunk``, ``initializer``, ``rescale``: what ``build_policy`` reads.
    """
    flat = traverse_util.flatten_dict(serialization.to_state_dict(actor), sep="/")
    directory.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(value) for name, value in flat.items()}
    write_json(directory / "policy.json", settings)
    write_arrays(directory / "actor.npz", arrays)  # last: where it is, the folder is whole


def load_policy(directory: str | Path, seed: int | None = None) -> tuple[Policy, Actor]:
    """Reads what ``save_policy`` wrote.

    Args:
      directory: the ``policy`` folder of a run.
      seed: which seed's actor; all of them, stacked [S, ...], if not given.

    Returns:
      The policy and its actor; ``policy.apply(actor.params, normalize.apply(
      actor.normalizer, observation))`` gives the distribution's outputs.

    Raises:
      FileNotFoundError: it is no such folder.
      ValueError: its files are damaged, or there is no such seed.
    """
    directory = Path(directory)
    try:
        settings = json.loads((directory / "policy.json").read_text(encoding="utf-8"))
        with np.load(directory / "actor.npz", allow_pickle=False) as archive:
            flat = {name: jnp.asarray(archive[name]) for name in archive.files}
        tree = traverse_util.unflatten_dict(flat, sep="/")
        actor = Actor(params=tree["params"], normalizer=Normalizer(**tree["normalizer"]))
        policy = build_policy(settings)
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"the policy in {directory} is damaged: {error!r}") from error
    if seed is not None:
        num_seeds = actor.normalizer.count.shape[0]
        if not 0 <= seed < num_seeds:
            raise ValueError(f"seed {seed} is not among the {num_seeds} of {directory}")
        actor = jax.tree.map(lambda x: x[seed], actor)
    return policy, actor


def build_policy(settings: dict[str, Any]) -> Policy:
    """Returns the policy that ``settings`` of ``save_policy`` describe.

    What an older file does not say is as it was then: one trunk, orthogonal
    weights, means scaled to the action's range.
    """
    check_name("policy", settings["policy"], DISTRIBUTIONS)
    distribution = load(DISTRIBUTIONS[settings["policy"]])(
        _space(settings),
        initial_std=settings["initial_std"],
        rescale=settings.get("rescale", True),
    )
    return mlp_policy(
        settings["observation_size"],
        distribution,
        settings["hidden_sizes"],
        shared_trunk=settings.get("shared_trunk", True),
        initializer=settings.get("initializer", "orthogonal"),
    )


def _space(settings: dict[str, Any]) -> Box | Discrete:
    """Returns the action space: ``num_actions``, or ``action_low`` and ``action_high``."""
    if "num_actions" in settings:
        return Discrete(settings["num_actions"])
    return Box(np.asarray(settings["action_low"]), np.asarray(settings["action_high"]))

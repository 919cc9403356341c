"""Trained policies on disk, a NumPy archive and a JSON file, never pickle; and how they play.

A ``Player`` is for programs without JAX: NumPy observations in, NumPy actions out.
"""

import functools
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization, traverse_util

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import check_kind, check_type, explain
from mjx_reinforce.export.run_files import (
    PolicyChoice,
    Run,
    SeedChoice,
    check_policies,
    choose_seed,
    policy_folder,
    read_run,
)
from mjx_reinforce.files import (
    Arrays,
    expanded,
    finite,
    naming_damage,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
)
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.distributions import Distribution, default_std
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy, within_bounds
from mjx_reinforce.registry import DISTRIBUTIONS, check_choice, is_own, load_choice

#: The name in the archive of what says that it belongs to the settings beside it.
_CHECKSUM = "checksum"
#: What a family takes beside the action space, and what holds where a file does not say it.
_FAMILY_ARGUMENTS = {"initial_std": None, "rescale": True}


class SavedPolicy(NamedTuple):
    """What a ``policy`` folder holds.

    policy: the policy; its mode is clipped to the action space
    actor: of one seed, or of all, stacked [S, ...]
    settings: what ``policy`` was built from, see ``save_policy``
    num_seeds: S, how many seeds the folder holds
    """

    policy: Policy
    actor: Actor
    settings: dict[str, Any]
    num_seeds: int


def save_policy(directory: Path, actor: Actor, settings: dict[str, Any]) -> None:
    """Writes the actors of all seeds and how to rebuild their policy.

    Args:
      directory: made if it does not exist; ``actor.npz`` and ``policy.json`` in it.
      actor: every leaf with a leading seed axis [S, ...].
      settings: ``policy`` (a name), ``hidden_sizes``, ``initial_std``, ``observation_size``,
        ``action_low`` and ``action_high`` or, if discrete, ``num_actions``; optionally
        ``initializer`` and ``rescale``: what ``build_policy`` reads; and ``frames``, how many
        observations of the environment are one of the policy's, as of ``MujocoEnv``.

    Examples:
      >>> import pathlib, tempfile
      >>> import jax, numpy as np
      >>> import mjx_reinforce as mr
      >>> settings = {
      ...     "policy": "categorical", "hidden_sizes": (8,), "initial_std": 0.5,
      ...     "observation_size": 4, "num_actions": 2,
      ... }
      >>> env = mr.envs.make("CartPole-v1")
      >>> policy = mr.mlp_policy(4, mr.categorical(env.action_space), (8,))
      >>> keys = jax.random.split(jax.random.key(0), 3)  # three seeds
      >>> actors = jax.vmap(mr.reinforce(env, policy=policy).init)(keys).actor
      >>> folder = pathlib.Path(tempfile.mkdtemp()) / "policy"
      >>> mr.save_policy(folder, actors, settings)
      >>> policy, actor = mr.load_policy(folder, seed=2)
      >>> mr.act(policy, actor, np.zeros(4)).shape
      (2,)
    """
    directory.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.asarray(value) for name, value in arrays_of(actor).items()}
    arrays[_CHECKSUM] = np.array(_checksum(settings, arrays))
    write_json(directory / "policy.json", settings)
    write_arrays(directory / "actor.npz", arrays)  # last: where it is, the folder is whole


def load_policy(directory: str | Path, seed: int | None = None) -> tuple[Policy, Actor]:
    """Reads what ``save_policy`` wrote.

    Args:
      directory: the folder of policies: ``policy`` in that of a run, or ``policy/best``. ``load``
        takes the run itself.
      seed: which seed's actor; all of them, stacked [S, ...], if not given.

    Returns:
      The policy and its actor; ``act(policy, actor, observation)`` gives the distribution's
      outputs.

    Raises:
      ValueError: it is another folder, such as that of the run, the files cannot be read or are
        damaged, or there is no such seed.

    Examples:
      >>> import pathlib, tempfile
      >>> import jax, numpy as np
      >>> import mjx_reinforce as mr
      >>> settings = {
      ...     "policy": "categorical", "hidden_sizes": (8,), "initial_std": 0.5,
      ...     "observation_size": 4, "num_actions": 2,
      ... }
      >>> env = mr.envs.make("CartPole-v1")
      >>> policy = mr.mlp_policy(4, mr.categorical(env.action_space), (8,))
      >>> keys = jax.random.split(jax.random.key(0), 3)  # three seeds
      >>> actors = jax.vmap(mr.reinforce(env, policy=policy).init)(keys).actor
      >>> folder = pathlib.Path(tempfile.mkdtemp()) / "policy"
      >>> mr.save_policy(folder, actors, settings)
      >>> policy, actor = mr.load_policy(folder, seed=2)
      >>> mr.act(policy, actor, np.zeros(4)).shape
      (2,)
    """
    saved = read_policy(directory, seed)
    return saved.policy, saved.actor


def read_policy(
    directory: str | Path, seed: int | None = None, trusted_code: str | None = None
) -> SavedPolicy:
    """Reads what ``save_policy`` wrote, as ``load_policy``, with all that it says.

    Args:
      directory: as ``load_policy``.
      seed: as ``load_policy``.
      trusted_code: "module:name" of a distribution that may be imported; what only a file names is
        not.
    """
    folder = expanded(directory)
    check_policies(folder)
    settings_path = folder / "policy.json"
    actor_path = folder / "actor.npz"
    settings = read_json(settings_path)
    arrays = read_arrays(actor_path, stored=True)
    # The checksum finds damage, not ill will: who changes the files can compute it again.
    if arrays.pop(_CHECKSUM, None) != _checksum(settings, arrays):
        raise ValueError(
            f"{settings_path} is damaged, or actor.npz beside it: they do not belong together "
            "(their checksum differs), so one of them was changed or is another run's"
        )
    with naming_damage(settings_path):
        check_choice("policy", settings["policy"], DISTRIBUTIONS)
    # A run may be a stranger's. Code runs only if the user names it, not because a file does.
    if is_own(settings["policy"]) and settings["policy"] != trusted_code:
        raise ValueError(
            f"{settings_path} names the distribution {settings['policy']}, and this would run that "
            f"code; if you trust it, add --policy {settings['policy']} to watch, or give "
            f"mjx_reinforce.load(..., policy={settings['policy']!r})"
        )
    with naming_damage(settings_path):
        policy = played_policy(settings)
        shapes = _shapes(policy, settings)
    with naming_damage(actor_path):
        num_seeds = _check_shapes(arrays, shapes)
    if seed is not None and not 0 <= seed < num_seeds:
        seeds = "it has seed 0 alone"
        if num_seeds > 1:
            seeds = f"its seeds are 0 to {num_seeds - 1}"
        raise ValueError(f"{directory} has no seed {seed}: {seeds}")
    with np.errstate(over="ignore"):  # a double that no float32 holds becomes infinite
        arrays = {k: x.astype(jax.dtypes.canonicalize_dtype(x.dtype)) for k, x in arrays.items()}
    # Of one seed, others may be broken.
    with naming_damage(actor_path):
        _check_finite(arrays, seed)
    if seed is not None:
        arrays = {name: array[seed] for name, array in arrays.items()}
    actor = jax.tree.map(jnp.asarray, actor_of(arrays))
    return SavedPolicy(policy, actor, settings, num_seeds)


def check_arrays(arrays: Arrays, settings: dict[str, Any]) -> None:
    """Raises ValueError for arrays [S, ...] by ``arrays_of`` that no policy of the settings has."""
    _check_shapes(arrays, _shapes(played_policy(settings), settings))


def _shapes(policy: Policy, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns what has the shape and the type of each array of a policy, by its name."""
    # Traced, not computed: the shapes are known in milliseconds.
    return arrays_of(jax.eval_shape(functools.partial(_untrained, policy, settings)))


def _untrained(policy: Policy, settings: dict[str, Any]) -> Actor:
    """Returns an actor of a policy, of whose arrays the names, shapes and kinds are wanted."""
    params = policy.init(jax.random.key(0))
    return Actor(params=params, normalizer=normalize.init(settings["observation_size"]))


def _check_shapes(arrays: Arrays, shape_tree: dict[str, Any]) -> int:
    """Returns how many seeds the arrays of an archive are of.

    Args:
      arrays: [S, ...] by name.
      shape_tree: what has the shape and the type of each, of one seed.

    Raises:
      ValueError: they are not those, or not of the same number of seeds.
    """
    for name in sorted(arrays.keys() ^ shape_tree.keys()):
        if name in shape_tree:
            raise ValueError(f"{name} is missing")
        raise ValueError(f"{name} is in no policy of these settings")
    # Damaged, the count may have no axis of seeds; its own shape is found wrong below.
    num_seeds = max((*arrays["normalizer/count"].shape[:1], 1))
    for name, array in sorted(arrays.items()):
        shape = (num_seeds, *shape_tree[name].shape)
        kind = shape_tree[name].dtype
        # JAX has neither numbers of other machines' byte order nor longer ones than float64.
        is_readable = array.dtype.isnative and array.dtype.itemsize <= np.dtype(float).itemsize
        if array.shape != shape or array.dtype.kind != np.dtype(kind).kind or not is_readable:
            raise ValueError(
                f"{name} is {array.dtype}{list(array.shape)}, and the settings of the policy make "
                f"it {kind}{list(shape)}"
            )
    return num_seeds


def _check_finite(arrays: Arrays, seed: int | None) -> None:
    """Raises ValueError for numbers that are not finite, of one seed or, if None, of any."""
    for name in sorted(arrays):
        seeds = [seed]
        if seed is None:
            seeds = range(len(arrays[name]))
        for s in seeds:
            if not np.isfinite(arrays[name][s]).all():
                raise ValueError(f"{name} of seed {s} has numbers that are not finite")


def arrays_of(actor: Actor) -> dict[str, Any]:
    """Returns an actor's arrays under the names they have in the archive."""
    return traverse_util.flatten_dict(serialization.to_state_dict(actor), sep="/")


def actor_of(arrays: dict[str, Any]) -> Actor:
    """Returns the actor of ``arrays_of``."""
    tree = traverse_util.unflatten_dict(arrays, sep="/")
    return Actor(params=tree["params"], normalizer=normalize.Normalizer(**tree["normalizer"]))


def _checksum(settings: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """Returns what says that settings and the arrays of an archive were saved together.

    It is kept in the archive: a run that goes on replaces that file at once, and a kill between
    the two files leaves a pair that fits.
    """
    # Keys are sorted, because a reader of JSON may keep another order than the writer.
    checksum = hashlib.sha256(json.dumps(finite(settings), default=str, sort_keys=True).encode())
    for name in sorted(arrays):
        checksum.update(name.encode() + np.ascontiguousarray(arrays[name]).tobytes())
    return checksum.hexdigest()


def build_policy(settings: dict[str, Any]) -> Policy:
    """Returns the policy that ``settings`` of ``save_policy`` describe.

    Where they do not say it, weights begin orthogonal, and means are scaled to the action's range.
    """
    family = settings["policy"]
    make = load_choice("policy", family, DISTRIBUTIONS)
    arguments = {k: settings.get(k, default) for k, default in _FAMILY_ARGUMENTS.items()}
    space = saved_action_space(settings)
    if is_own(family) and arguments["initial_std"] is None and isinstance(space, Box):
        std = default_std(space)  # one number where it can be
        arguments["initial_std"] = std if np.ptp(std) > 0 else float(std[0])
    try:
        distribution = make(space, **arguments)
    # Other people's code may raise anything, and even leave the program.
    except (Exception, SystemExit) as error:
        if not is_own(family):
            raise
        raise ValueError(f"cannot build the policy {family!r}: {explain(error)}") from error
    check_kind(f"what {family} returns", distribution, Distribution, "mjx_reinforce.normal(space)")
    return mlp_policy(
        settings["observation_size"],
        distribution,
        settings["hidden_sizes"],
        initializer=settings.get("initializer", "orthogonal"),
    )


def played_policy(settings: dict[str, Any]) -> Policy:
    """Returns ``build_policy(settings)``, whose actions are clipped where it is played."""
    return within_bounds(build_policy(settings), saved_action_space(settings))


def saved_action_space(settings: dict[str, Any]) -> Box | Discrete:
    """Returns the action space that ``settings`` of ``save_policy`` describe.

    It is ``num_actions``, or ``action_low`` and ``action_high``; None, as JSON has no infinity,
    stands for unbounded.
    """
    if "num_actions" in settings:
        return Discrete(settings["num_actions"])
    low = [-np.inf if x is None else x for x in settings["action_low"]]
    high = [np.inf if x is None else x for x in settings["action_high"]]
    return Box(np.asarray(low), np.asarray(high))


class Player(NamedTuple):
    """The trained policy of one seed of a run.

    Attributes:
      env: the id of the environment that it was trained on
      seed: the number of the seed
      policy: the network and its distribution
      actor: the seed's parameters and observation statistics

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> player = mr.load("CartPole-v1")  # it comes with the package
      >>> player.act(np.array([0.0, 0.0, 0.1, 0.0]))  # the pole leans to the right
      1
    """

    env: str
    seed: int
    policy: Policy
    actor: Actor

    def __repr__(self) -> str:
        return f"Player({self.env}, seed {self.seed}, {self.policy!r})"

    @property
    def observation_size(self) -> int:
        """The number O of entries of an observation."""
        return self.actor.normalizer.mean.shape[0]

    def act(
        self, observation: np.ndarray, rng: np.random.Generator | None = None
    ) -> np.ndarray | int:
        """Returns what ``env.step`` of Gymnasium takes.

        Args:
          observation: [O], or [N, O] for N environments, as the environment gave it.
          rng: draws the action; without it the action is the policy's mode.

        Returns:
          The action [A], or [N, A], clipped to the bounds of the actions; discrete: an int, or [N].

        Raises:
          ValueError: the observation is not of this environment.
        """
        mean = self.actor.normalizer.mean
        observation = np.asarray(observation, mean.dtype)
        if observation.ndim not in (1, 2) or observation.shape[-1:] != mean.shape:
            raise ValueError(
                f"the policy for {self.env} takes observations [{mean.size}] or "
                f"[N, {mean.size}], got one of shape {list(observation.shape)}"
            )
        if rng is None:
            action = _mode(self.policy, self.actor, observation)
        else:
            # NumPy's generator gives the seed of JAX's, so that a caller needs no key.
            key = jax.random.key(int(rng.integers(2**32)))
            action = _sample(self.policy, self.actor, observation, key)
        # Gymnasium's Discrete takes an int. A copy is writable, which JAX's array is not.
        return np.array(action) if action.ndim else int(action)


def load(
    run: str | Path,
    seed: SeedChoice = "best",
    *,
    which: PolicyChoice = "last",
    policy: str | None = None,
) -> Player:
    """Loads a trained policy to play, in Gymnasium or elsewhere.

    Args:
      run: the run directory that training left, or the id of a task whose trained policy comes with
        the package, such as "HalfCheetah-v5"; ``pretrained()`` lists them. A directory of that name
        goes first.
      seed: "best", "worst" or "median" in the run's final evaluation, or a number.
      which: "last" for the policy at the end of training, "best" for the one that did best on
        the way, where the run kept it.
      policy: "module:name" where the distribution of the run is of that code, which is imported
        then.

    Raises:
      ValueError: there is no such run, task or seed, the run has not ended, or a file is damaged.

    Examples:
      >>> import numpy as np
      >>> import mjx_reinforce as mr
      >>> player = mr.load("HalfCheetah-v5")  # it comes with the package
      >>> player.env, player.act(np.zeros(17)).shape, player.act(np.zeros((5, 17))).shape
      ('HalfCheetah-v5', (6,), (5, 6))
    """
    check_type("run", run, str | Path)
    return load_seed(read_run(run), seed, which, policy)[0]


def load_seed(
    run: Run, seed: SeedChoice, choice: PolicyChoice = "last", trusted_code: str | None = None
) -> tuple[Player, SavedPolicy]:
    """Loads one seed, as ``load``, with what its files say."""
    folder = policy_folder(run, choice)
    number = choose_seed(run, seed, choice)
    saved = read_policy(folder, run.place(number), trusted_code)
    # A policy that was copied into another run's folder may fit its shapes by chance.
    if saved.settings.get("env", run.env) != run.env:
        raise ValueError(
            f"{folder / 'policy.json'} is for {saved.settings['env']}, "
            f"{run.directory / 'config.json'} for {run.env}: they are of different runs"
        )
    return Player(run.env, number, saved.policy, saved.actor), saved


@functools.partial(jax.jit, static_argnums=0)
def _mode(policy: Policy, actor: Actor, observation: jax.Array) -> jax.Array:
    return policy.distribution.mode(act(policy, actor, observation))


@functools.partial(jax.jit, static_argnums=0)
def _sample(policy: Policy, actor: Actor, observation: jax.Array, key: jax.Array) -> jax.Array:
    outputs = act(policy, actor, observation)
    noise = policy.distribution.noise(key, outputs.shape[:-1])
    return policy.distribution.clip(policy.distribution.sample(outputs, noise))

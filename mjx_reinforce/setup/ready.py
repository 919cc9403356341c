"""A run that is ready: what its settings come to, and its programs before they are compiled.

Programs are saved on disk, as JAX exports them: a run that was compiled before is not traced. They
lie beside XLA's compiled programs in JAX's cache, under a hash of all that they depend on: every
source file of this package, the versions of others, the settings, the device. What a run begins
with (its seeds) and when it ends are inputs of its programs. What they take and return is described
in JSON, without pickle: pytrees whose leaves are shapes or random keys.
"""

import dataclasses
import functools
import hashlib
import importlib
import json
import warnings
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.engine.base import Environment, PyTree, is_key, term_names
from mjx_reinforce.engine.cache import Cache
from mjx_reinforce.envs.settings import split_words
from mjx_reinforce.learning.learner import Learner
from mjx_reinforce.registry import is_own
from mjx_reinforce.settings.config import CODE, Config, check_read_by_policy, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.setup.build import build
from mjx_reinforce.setup.provenance import provenance, version
from mjx_reinforce.training.division import ALONE, Division
from mjx_reinforce.training.programs import Programs, programs_of
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.state import Budget, StateRows


class Ready(NamedTuple):
    """What a run is made of.

    horizon: the time limit of an episode in steps
    threshold: the return that counts as solved, if any
    policy: how to rebuild its policy, see ``policy_files.save_policy``
    engine: the name of what plays the episodes
    why: the reason it was chosen, for people
    terms: the names of the reward's terms, in the order of the task
    programs: () -> those of the runs, before they are compiled; made when they are first asked for
    """

    horizon: int
    threshold: float | None
    policy: dict[str, Any]
    engine: str
    why: str
    terms: Sequence[str]
    programs: Callable[[], Programs]


def load_or_build_ready(
    config: Config,
    default: Config,
    env: Environment | None = None,
    division: Division = ALONE,
    traced: Collection[str] | None = None,
    played_by: str | None = None,
) -> Ready:
    """Returns what the settings come to; those of a run from disk, if they did before.

    Args:
      config: the settings.
      default: those that hold where the user gave none.
      env: the environment; by default the one that the settings name, built if it is needed.
      division: see ``build_ready``.
      traced: see ``build_ready``.
      played_by: the engine that played before, where a run goes on.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    # Programs of a sweep take settings as arguments, and are not saved.
    key = None
    if traced is None:
        key = key_of(config)
    ready = None
    if key is not None:
        ready = _load_of_settings(key, config, division)
    if ready is None:
        task = envs.make_set(config.env, config.env_set) if env is None else env
        ready = build_ready(task, config, division, traced)
        # JAX exports no program that calls C MuJoCo, for it calls Python.
        if key is not None and ready.engine != "mujoco":
            ready = save_ready(key, ready)
    # ``auto`` may choose otherwise now: compiled programs have come to the disk, or have gone.
    if played_by not in (None, ready.engine):
        same_engine: Any = dataclasses.replace(config, engine=played_by)
        return load_or_build_ready(same_engine, default, env, division, traced)
    if config.resume is None and config.policy == "auto":
        check_read_by_policy(config, default, ready.policy["policy"])
    return ready


def _load_of_settings(key: str, config: Config, division: Division) -> Ready | None:
    """Returns what is on disk of the settings; None if nothing is."""
    ready = load_ready(key, division)
    if ready is not None or config.resume is None:
        return ready
    # A run that is resumed has its time limit from config.json, also one that was not given: its
    # programs may be there under the key without a limit.
    first_key = key_of(dataclasses.replace(config, horizon=None))
    if first_key is not None:
        ready = load_ready(first_key, division)
    if ready is not None and ready.horizon != config.horizon:
        return None
    return ready


def build_ready(
    env: Environment,
    config: Config,
    division: Division = ALONE,
    traced: Collection[str] | None = None,
) -> Ready:
    """Returns what the settings come to in an environment.

    Args:
      env: what is trained on.
      config: the settings.
      division: among which devices they are divided.
      traced: of a sweep, the names of the settings that differ from run to run of its programs.
        None of a run, whose programs measure more.

    Raises:
      ValueError: the settings do not fit the environment.
    """
    devices = division.devices() if division.episodes > 1 else None
    # Programs of a sweep are traced for one run: as many as fit are put side by side later.
    width = 1
    if traced is None:
        width = division.width(config.num_policies)
    built = build(env, config, devices=devices, num_seeds=width)
    learner = built.learner
    threshold = getattr(env, "reward_threshold", None)
    if threshold is not None:
        threshold = float(threshold)

    def build_learner(settings: dict[str, Any]) -> Learner:
        """Returns the learner with these settings traced; the one above without any."""
        if not settings:
            return learner
        if config.algorithm != "reinforce":
            return build(env, dataclasses.replace(config, **settings)).learner
        # How REINFORCE plays depends on no traced number, and machine code takes a second to write
        # out. These engines write nothing, and vmap refuses what C MuJoCo alone plays.
        idle_engine: Any = "vmap"
        if learner.engine.name == "mujoco":
            idle_engine = "mujoco"
        with warnings.catch_warnings(action="ignore"):  # this engine does not play
            idle_config = dataclasses.replace(config, engine=idle_engine, **settings)
            idle_learner = build(env, idle_config).learner
        return learner._replace(init=idle_learner.init, learn=idle_learner.learn)

    @functools.cache
    def programs() -> Programs:
        """Returns the programs, which take a second to trace: once, and only if asked for."""
        return programs_of(
            env,
            build_learner,
            built.horizon,
            built.training_horizon,
            config,
            width,
            traced or (),
            all_metrics=traced is None,
            division=division,
        )

    return Ready(
        horizon=built.horizon,
        threshold=threshold,
        policy=built.policy,
        engine=learner.engine.name,
        why=learner.engine.why,
        terms=term_names(env),
        programs=programs,
    )


_PROGRAM_NAMES = ("begin", "advance", "evaluate")


def key_of(config: Config) -> str | None:
    """Returns a name for all that the programs of a run depend on.

    None where nothing is saved: where ``Cache.find`` finds no place, and of code or a model of the
    user's.
    """
    cache = Cache.find()
    if cache is None:
        return None
    # The user's code is no source file of this package, and may import what it likes.
    if not envs.is_ours(config.env) or any(is_own(getattr(config, name)) for name in CODE):
        return None
    if "xml_file" in split_words(config.env_set):  # the file may change
        return None
    program_provenance = provenance()
    del program_provenance["git_commit"]  # the sources say it better
    # Of the budgets, ``block_length`` says what changes a program.
    inputs = marked(Mark.NOT_COMPILED)
    settings = {k: v for k, v in recordable(config).items() if k not in inputs}
    dependencies = {
        "settings": settings | {"block": config.block_length},
        "engine": cache.made_by("mjx_reinforce"),
        "made_by": program_provenance,
        "numpy": version("numpy"),
    }
    return hashlib.sha256(json.dumps(dependencies, sort_keys=True).encode()).hexdigest()


def save_ready(key: str, ready: Ready) -> Ready:
    """Returns the same with programs that are written to disk when they are traced.

    A program that JAX cannot export, such as one that calls Python, is not saved.

    Args:
      key: of ``key_of``.
      ready: what is saved; all of it but the programs is in JSON's types.
    """
    programs = ready.programs()
    state_shapes = programs.like
    json_facts = ready._asdict()
    del json_facts["programs"]
    cache = Cache.find()
    assert cache is not None  # there is a key
    # A state of the user's own classes is no error; it is not saved.
    try:
        json_content = {
            "facts": json_facts,
            "like": describe_tree(state_shapes),
            "advance_evaluates": programs.advance_evaluates,
        }
    except TypeError:
        return ready
    cache.write(f"{key}-facts", json.dumps(json_content).encode())
    # Shapes of the arguments, in the order in which ``Programs`` describes them.
    slot_width = len(state_shapes.eval_keys)
    seed = jax.ShapeDtypeStruct((), np.uint32)
    seed_numbers = jax.ShapeDtypeStruct((slot_width,), np.uint32)
    rows = jax.ShapeDtypeStruct((slot_width, StateRows(state_shapes).size), np.uint8)
    budget = (jax.ShapeDtypeStruct((2,), np.uint32),) * len(Budget._fields)
    occupied = jax.ShapeDtypeStruct((slot_width,), bool)
    evaluation_due = jax.ShapeDtypeStruct((), bool)
    arguments = {
        "begin": (seed, seed_numbers, {}),  # a run has no settings that are traced
        "advance": (rows, budget, occupied, evaluation_due),
        "evaluate": (rows, occupied),
    }

    def keep(name: str, program: Callable[..., Any]) -> Callable[..., Any]:
        return cache.keep(f"{key}-{name}", program, arguments[name])

    # Each when it is asked for: while XLA compiles the one, the next is traced.
    kept_programs = programs._replace(keep=keep)
    return ready._replace(programs=lambda: kept_programs)


def load_ready(key: str, division: Division = ALONE) -> Ready | None:
    """Returns what ``save_ready`` wrote under a key; None unless all of it is on disk."""
    cache = Cache.find()
    if cache is None:
        return None
    json_text = cache.read(f"{key}-facts")
    if json_text is None:
        return None
    # A crash may have left some of them, and one that JAX could not export is never there.
    loaded_programs: list[Any] = [cache.load(f"{key}-{name}") for name in _PROGRAM_NAMES]
    if any(program is None for program in loaded_programs):
        return None
    json_content = json.loads(json_text)
    state_shapes = rebuild(json_content["like"])
    programs = Programs(
        *loaded_programs,
        advance_evaluates=json_content["advance_evaluates"],
        like=state_shapes,
        division=division,
    )
    return Ready(**json_content["facts"], programs=lambda: programs)


#: The packages whose classes a description may name.
_PACKAGES = ("mjx_reinforce", "optax")


def describe_tree(tree: PyTree) -> Any:
    """Returns what JSON can hold of a pytree: its structure, and its leaves' shapes and dtypes.

    Args:
      tree: of dicts, tuples, lists, None, NamedTuples and dataclasses; every leaf has a shape.

    Raises:
      TypeError: it has something else.
    """
    if tree is None:
        return None
    if isinstance(tree, dict):
        return {"dict": {name: describe_tree(x) for name, x in tree.items()}}
    owner = type(tree)
    field_names = _fields(tree)
    # Classes are named, and loaded by that name; a name in a file must not load any code there is.
    if field_names is not None:
        if owner.__module__.partition(".")[0] not in _PACKAGES:
            raise TypeError(f"{owner} is of another package than {', '.join(_PACKAGES)}")
        if "." in owner.__qualname__:
            raise TypeError(f"{owner} is not at the top of its module")
        members = {name: describe_tree(getattr(tree, name)) for name in field_names}
        return {"class": f"{owner.__module__}:{owner.__qualname__}", "fields": members}
    if isinstance(tree, tuple | list):
        return {owner.__name__: [describe_tree(x) for x in tree]}
    if not hasattr(tree, "shape"):
        raise TypeError(f"a leaf of {owner}")
    return {"leaf": "key" if is_key(tree) else np.dtype(tree.dtype).name, "shape": list(tree.shape)}


def rebuild(description: Any) -> Any:
    """Returns the pytree of ``describe_tree``; its leaves are ``jax.ShapeDtypeStruct``.

    Raises:
      ValueError, KeyError, TypeError, AttributeError or ImportError: it is no such description.
    """
    if description is None:
        return None
    if "leaf" in description:
        kind = description["leaf"]
        dtype = jax.eval_shape(jax.random.key, 0).dtype if kind == "key" else np.dtype(kind)
        return jax.ShapeDtypeStruct(tuple(description["shape"]), dtype)
    if "class" in description:
        module, _, name = description["class"].partition(":")
        if module.partition(".")[0] not in _PACKAGES:
            raise ValueError(f"{module} is of another package than {', '.join(_PACKAGES)}")
        field_trees = {name: rebuild(x) for name, x in description["fields"].items()}
        return getattr(importlib.import_module(module), name)(**field_trees)
    if "dict" in description:
        return {name: rebuild(x) for name, x in description["dict"].items()}
    ((kind, children),) = description.items()
    return {"tuple": tuple, "list": list}[kind](map(rebuild, children))


def _fields(tree: PyTree) -> tuple[str, ...] | None:
    """Returns the names of the fields of a dataclass or NamedTuple; None of anything else."""
    if dataclasses.is_dataclass(tree):
        return tuple(field.name for field in dataclasses.fields(tree))
    return getattr(tree, "_fields", None)

"""Programs of runs on disk, as JAX exports them: a run that was compiled before is not traced.

They lie beside XLA's compiled programs in JAX's cache, under a hash of all that they depend on:
every source file of this package, the versions of others, the settings, the device. What a run
begins with (its seeds) and when it ends are inputs of its programs. What they take and return is
described in JSON, without pickle: pytrees whose leaves are shapes or random keys.
"""

import dataclasses
import hashlib
import importlib
import json
from typing import Any

import jax
import numpy as np

from mjx_reinforce import envs
from mjx_reinforce.engine.base import PyTree, is_key
from mjx_reinforce.engine.cache import Cache
from mjx_reinforce.envs.settings import split_words
from mjx_reinforce.registry import is_own
from mjx_reinforce.settings.config import CODE, Config, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.store.provenance import provenance, version
from mjx_reinforce.training.programs import Programs
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.state import Budget, StateRows

_PROGRAMS = ("begin", "advance", "evaluate")


def key_of(config: Config) -> str | None:
    """Returns a name for all that the programs of a run depend on.

    None where nothing is kept: where ``Cache.find`` finds no place, and of code or a model of the
    user's.
    """
    cache = Cache.find()
    own = not envs.is_ours(config.env) or any(is_own(getattr(config, name)) for name in CODE)
    if cache is None or own:
        return None
    if "xml_file" in split_words(config.env_set):  # the file may change
        return None
    made_by = provenance()
    del made_by["git_commit"]  # the sources say it better
    # Of the budgets, ``block_length`` says what changes a program.
    inputs = marked(Mark.NOT_COMPILED)
    settings = {k: v for k, v in recordable(config).items() if k not in inputs}
    known = {
        "settings": settings | {"block": config.block_length},
        "engine": cache.made_by("mjx_reinforce"),
        "made_by": made_by,
        "numpy": version("numpy"),
    }
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def keep(key: str, facts: dict[str, Any], programs: Programs) -> Programs:
    """Returns programs that are written to disk when they are traced.

    A program that JAX cannot export, such as one that calls Python, is not kept.

    Args:
      key: of ``key_of``.
      facts: what else a run needs, in JSON's types.
      programs: of the run.
    """
    like, cache = programs.like, Cache.find()
    if cache is None:
        return programs
    try:
        whole = {"facts": facts, "like": describe_tree(like), "rides": programs.rides}
    except TypeError:
        return programs
    cache.write(f"{key}-facts", json.dumps(whole).encode())
    width = len(like.eval_keys)
    seed, numbers, count = (jax.ShapeDtypeStruct(x, np.uint32) for x in ((), (width,), (2,)))
    rows = jax.ShapeDtypeStruct((width, StateRows(like).size), np.uint8)
    which, look = (jax.ShapeDtypeStruct(x, bool) for x in ((width,), ()))
    given = {
        "begin": (seed, numbers, {}),  # a run has no settings that are traced
        "advance": (rows, (count,) * len(Budget._fields), which, look),
        "evaluate": (rows, which),
    }
    return programs._replace(
        **{
            name: cache.keep(f"{key}-{name}", getattr(programs, name), given[name])
            for name in _PROGRAMS
        }
    )


def read_programs(key: str) -> tuple[dict[str, Any], Programs] | None:
    """Returns the facts and the programs of a run; None unless all of them are on disk."""
    cache = Cache.find()
    facts = None if cache is None else cache.read(f"{key}-facts")
    if cache is None or facts is None:
        return None
    found = {name: cache.load(f"{key}-{name}") for name in _PROGRAMS}
    loaded = {name: program for name, program in found.items() if program is not None}
    if len(loaded) < len(found):
        return None
    whole = json.loads(facts)
    programs = (loaded[name] for name in _PROGRAMS)
    return whole["facts"], Programs(*programs, rides=whole["rides"], like=rebuild(whole["like"]))


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
    kind, fields = type(tree), _fields(tree)
    if fields is not None:
        if kind.__module__.partition(".")[0] not in _PACKAGES:
            raise TypeError(f"{kind} is of another package than {', '.join(_PACKAGES)}")
        if "." in kind.__qualname__:
            raise TypeError(f"{kind} is not at the top of its module")
        parts = {name: describe_tree(getattr(tree, name)) for name in fields}
        return {"class": f"{kind.__module__}:{kind.__qualname__}", "fields": parts}
    if isinstance(tree, tuple | list):
        return {kind.__name__: [describe_tree(x) for x in tree]}
    if not hasattr(tree, "shape"):
        raise TypeError(f"a leaf of {kind}")
    return {"leaf": "key" if is_key(tree) else np.dtype(tree.dtype).name, "shape": list(tree.shape)}


def rebuild(described: Any) -> Any:
    """Returns the pytree of ``describe_tree``; its leaves are ``jax.ShapeDtypeStruct``.

    Raises:
      ValueError, KeyError, TypeError, AttributeError or ImportError: it is no such description.
    """
    if described is None:
        return None
    if "leaf" in described:
        kind = described["leaf"]
        dtype = _key_dtype() if kind == "key" else np.dtype(kind)
        return jax.ShapeDtypeStruct(tuple(described["shape"]), dtype)
    if "class" in described:
        module, _, name = described["class"].partition(":")
        if module.partition(".")[0] not in _PACKAGES:
            raise ValueError(f"{module} is of another package than {', '.join(_PACKAGES)}")
        parts = {name: rebuild(x) for name, x in described["fields"].items()}
        return getattr(importlib.import_module(module), name)(**parts)
    if "dict" in described:
        return {name: rebuild(x) for name, x in described["dict"].items()}
    ((kind, parts),) = described.items()
    return {"tuple": tuple, "list": list}[kind](map(rebuild, parts))


def _fields(tree: PyTree) -> tuple[str, ...] | None:
    """Returns the names of the fields of a dataclass or NamedTuple; None of anything else."""
    if dataclasses.is_dataclass(tree):
        return tuple(field.name for field in dataclasses.fields(tree))
    return getattr(tree, "_fields", None)


def _key_dtype() -> Any:
    return jax.eval_shape(jax.random.key, 0).dtype

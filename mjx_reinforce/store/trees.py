"""The structure of a pytree as JSON and back, without pickle: leaves are shapes or random keys."""

import dataclasses
import importlib
from typing import Any

import jax
import numpy as np

from mjx_reinforce.types import PyTree, is_key

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

"""Programs of runs on disk, as JAX exports them: a run that was compiled before is not traced.

They lie beside XLA's compiled programs in JAX's cache, under a hash of all that they depend on:
every source file of this package, the versions of others, the settings, the device. What a run
begins with (its seeds) and when it ends are inputs of its programs.
"""

import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import export

from mjx_reinforce import envs
from mjx_reinforce.engines.native import objects
from mjx_reinforce.engines.native.available import made_for, platform
from mjx_reinforce.engines.native.cpu import seam
from mjx_reinforce.engines.native.gpu.seam import PTX
from mjx_reinforce.settings.config import Config, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.store.provenance import provenance, version
from mjx_reinforce.store.trees import describe_tree, rebuild
from mjx_reinforce.training.resume import recordable
from mjx_reinforce.training.state import Budget, Parts, eval_keys_shape
from mjx_reinforce.types import PyTree, plain

_PROGRAMS = ("start", "advance", "look")


def key_of(config: Config, share: slice = slice(None)) -> str | None:
    """Returns a name for all that the programs of a run depend on, for all seeds or a share.

    None where nothing is kept: on what is neither a CPU nor a GPU, of an environment of the user's,
    and where JAX is to look for NaNs, which it cannot in a program that is not traced.
    """
    looks = any(jax.config.values[name] for name in ("jax_debug_nans", "jax_debug_infs"))
    if looks or objects.folder() is None or not envs.is_ours(config.env):
        return None
    if platform() not in ("cpu", "gpu"):
        return None
    made_by = provenance()
    del made_by["git_commit"]  # the sources say it better
    # Of the budgets, ``block_length`` says what changes a program.
    inputs = marked(Mark.NOT_COMPILED)
    settings = {k: v for k, v in recordable(config).items() if k not in inputs}
    known = {
        "settings": settings | {"block": config.block_length},
        "share": (share.start, share.stop),
        "sources": objects.source_digest("mjx_reinforce"),
        "made_by": made_by,
        "numpy": version("numpy"),
        "machine_code": made_for() if config.engine in ("auto", "native") else "",
        "jax": {name: str(value) for name, value in jax.config.values.items()},
        "variables": {k: v for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_"))},
    }
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def keep(key: str, facts: dict[str, Any], parts: Parts) -> Parts:
    """Returns programs that are written to disk when they are traced.

    A program that JAX cannot export, such as one that calls Python, is not kept.

    Args:
      key: of ``key_of``.
      facts: what else a run needs, in JSON's types.
      parts: its programs.
    """
    try:
        whole = {"facts": facts, "like": describe_tree(parts.like), "rides": parts.rides}
    except TypeError:
        return parts
    _write_program(key, "facts", json.dumps(whole).encode())
    shapes, actor = _leaves(parts.like), _leaves(parts.like.train_states.actor)
    seed, count = (jax.ShapeDtypeStruct(x, np.uint32) for x in ((), (2,)))
    given = {
        "start": (seed, seed),
        "advance": (shapes, (count,) * len(Budget._fields), jax.ShapeDtypeStruct((), bool)),
        "look": (actor, eval_keys_shape(parts.like)),
    }
    return parts._replace(
        **{
            name: functools.partial(_export, key, name, getattr(parts, name), given[name])
            for name in _PROGRAMS
        }
    )


def read_programs(key: str) -> tuple[dict[str, Any], Parts] | None:
    """Returns the facts and the programs of a run; None unless all of them are on disk."""
    read = {name: _read_program(key, name) for name in ("facts", *_PROGRAMS)}
    found = {name: content for name, content in read.items() if content is not None}
    if len(found) < len(read) or not all(map(seam.restore, found.values())):
        return None
    whole = json.loads(found["facts"])
    programs = {name: functools.partial(_program, found[name]) for name in _PROGRAMS}
    return whole["facts"], Parts(rebuild(whole["like"]), **programs, rides=whole["rides"])


def _program(content: bytes) -> Callable[..., Any]:
    return export.deserialize(bytearray(content)).call


def _export(
    key: str, name: str, part: Callable[[], Callable[..., Any]], given: tuple[Any, ...]
) -> Callable[..., Any]:
    """Returns a program as it is kept, or as it was where JAX cannot export it."""
    program = part()
    unsafe = [export.DisabledSafetyCheck.custom_call(x) for x in (*seam.targets(), PTX)]
    try:
        exported = export.export(jax.jit(program), disabled_checks=unsafe)(*given)
        # That list names all code in memory, also of other tasks; ``seam.restore`` would load it.
        own = dataclasses.replace(exported, disabled_safety_checks=())
        content = bytes(own.serialize())
    except (ValueError, NotImplementedError):
        return program
    _write_program(key, name, content)
    return _program(content)


def _leaves(tree: PyTree) -> list[jax.ShapeDtypeStruct]:
    """Returns the shapes of the leaves, with the data of keys in their place."""
    return jax.tree.leaves(jax.eval_shape(plain, tree))


def _read_program(key: str, name: str) -> bytes | None:
    folder = objects.folder()
    return None if folder is None else objects.read_object(folder, f"{key}-{name}")


def _write_program(key: str, name: str, content: bytes) -> None:
    folder = objects.folder()
    if folder is not None:
        objects.write_object(folder, f"{key}-{name}", content)

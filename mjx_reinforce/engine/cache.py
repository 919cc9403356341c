"""Whole programs on disk, beside the machine code that they call."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import seam
from mjx_reinforce.engine.gpu import seam as gpu_seam
from mjx_reinforce.engine.play.available import made_for, platform


class Cache(NamedTuple):
    """A folder of programs; only what nobody but this user and root may have written is read.

    folder: where they are
    """

    folder: Path

    @classmethod
    def find(cls) -> "Cache | None":
        """Returns the one beside the programs that JAX keeps; None where nothing may be kept.

        That is where JAX keeps nothing, on what is neither a CPU nor a GPU, and where JAX is to
        look for NaNs or kernels are to be described: neither can be in a program that is not
        traced.
        """
        folder = objects.folder()
        has_checks = any(jax.config.values[name] for name in ("jax_debug_nans", "jax_debug_infs"))
        if has_checks or objects.is_described() or platform() not in ("cpu", "gpu"):
            return None
        if folder is None:
            return None
        return cls(folder)

    def made_by(self, *packages: str) -> dict[str, Any]:
        """Returns what programs depend on: sources of packages, the machine, what JAX is told."""
        return {
            "sources": objects.source_digest(*packages),
            "machine_code": made_for(),
            "jax": {name: str(value) for name, value in jax.config.values.items()},
            "variables": {k: v for k, v in os.environ.items() if k.startswith(("JAX_", "XLA_"))},
        }

    def read(self, name: str) -> bytes | None:
        """Returns what is kept under a name; None if there is nothing, or it is damaged."""
        return objects.read_object(self.folder, name)

    def write(self, name: str, content: bytes) -> None:
        """Keeps something under a name, and forgets what was used longest ago if it is too much."""
        objects.write_object(self.folder, name, content)

    def keep(
        self, name: str, program: Callable[..., Any], given: tuple[Any, ...]
    ) -> Callable[..., Any]:
        """Returns a program as it is kept, or as it was where JAX cannot export it.

        Args:
          name: for ``load``.
          program: a function of arrays that returns lists, tuples and dicts of arrays.
          given: its arguments, or their shapes.
        """
        # JAX exports no custom call unless it knows that the target stays what it is. Ours is
        # machine code that is kept beside the program, and ``load`` brings it back.
        targets = (*seam.targets(), *gpu_seam.targets())
        checks = [export.DisabledSafetyCheck.custom_call(x) for x in targets]
        try:
            exported = export.export(jax.jit(program), disabled_checks=checks)(*given)
            # That list names all code in memory, also of other tasks; ``load`` would ask for it.
            exported = dataclasses.replace(exported, disabled_safety_checks=())
            content = bytes(exported.serialize())
        except (ValueError, NotImplementedError):
            return program
        self.write(name, content)
        return _program(content)

    def load(self, name: str) -> Callable[..., Any] | None:
        """Returns a program of ``keep``, its machine code in memory; None unless all is there."""
        content = self.read(name)
        if content is None or not (seam.restore(content) and gpu_seam.restore(content)):
            return None
        return _program(content)


def _program(content: bytes) -> Callable[..., Any]:
    return lambda *arguments: export.deserialize(bytearray(content)).call(*arguments)

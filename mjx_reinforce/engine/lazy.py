"""Public names that are imported on first use: the stub beside a package says where each is."""

import ast
from pathlib import Path


def homes(package: str) -> dict[str, str]:
    """Returns the public names of a package, and the module that has each.

    Args:
      package: its ``__file__``; beside it ``__init__.pyi`` has the imports that type checkers read.
    """
    stub = ast.parse(Path(package).with_suffix(".pyi").read_text("utf-8"))
    return {
        alias.name: node.module
        for node in stub.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }

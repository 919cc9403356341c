"""How large the repository is; ``python tests/helpers/sizes.py [FOLDER]`` prints it.

Code is what is neither a docstring nor a comment nor blank, in Python and in C++; words are those
of ``docs/``.
"""

import ast
import re
import sys
import tomllib
from pathlib import Path

#: A function that takes more lines, its docstring apart, is long.
_LONG = 60


def code(path):
    """Returns how many lines of code a file of Python or C++ has."""
    text = path.read_text("utf-8")
    if path.suffix != ".py":
        lines = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL).splitlines()
        return sum(bool(line.strip()) for line in lines)
    return len(code_lines(text))


def code_lines(text):
    """Returns the numbers of the lines of Python that are code."""
    lines = {
        number
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    }
    docstrings = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant | ast.JoinedStr):
            lines |= _lines(node)
        docstring = _docstring(node)
        if docstring is not None:
            docstrings |= _lines(docstring)
    return lines - docstrings


def _lines(node):
    """Returns the numbers of the lines that a node is on."""
    return set(range(node.lineno, node.end_lineno + 1))


def _docstring(node):
    """Returns the expression that is a node's docstring, None without one."""
    documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
    return node.body[0] if documented and ast.get_docstring(node) else None


def package_files(root, *suffixes):
    """Returns the files of the package and the environments whose names end so."""
    return [
        path
        for folder in ("mjx_reinforce", "envs")
        for path in sorted((root / folder).rglob("*"))
        if path.suffix in suffixes
        and "mjx_reinforce/envs/" not in path.as_posix()  # a link to the folder at the top
    ]


def sizes(root):
    """Returns each size by its name."""
    parts = {
        "package": package_files(root, ".py", ".h"),
        "experiments": [*(root / "experiments").rglob("*.py")],
        "tests": [*(root / "tests").rglob("*.py")],
    }
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    groups = ast.parse((root / "mjx_reinforce/settings/groups.py").read_text("utf-8"))
    return {
        **{f"{name}_code": sum(map(code, paths)) for name, paths in parts.items()},
        "package_files": len(parts["package"]),
        "dependencies": len(project["dependencies"]),
        "settings": sum(
            isinstance(field, ast.AnnAssign)
            for group in groups.body
            if isinstance(group, ast.ClassDef)
            for field in group.body
        ),
        "docs_words": sum(
            len(path.read_text("utf-8").split()) for path in (root / "docs").rglob("*.md")
        ),
        "long_functions": sum(
            len([*_long_functions(path)]) for path in parts["package"] if path.suffix == ".py"
        ),
    }


def _long_functions(path):
    """Yields the functions of a file that are long without their docstring."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef):
            docstring = _docstring(node)
            less = docstring.end_lineno - docstring.lineno + 1 if docstring else 0
            if node.end_lineno - node.lineno + 1 - less > _LONG:
                yield f"{path.name}:{node.name}"


if __name__ == "__main__":
    where = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2]
    for name, size in sizes(where).items():
        print(f"{name:20} {size:7,}")

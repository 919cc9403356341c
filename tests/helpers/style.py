"""How plainly the code reads; ``python tests/helpers/style.py [FOLDER...]`` prints it by folder.

With folders, it prints also where each of them departs from what tests/test_names.py asks.
"""

import ast
import collections
import functools
import itertools
import sys
from typing import NamedTuple

from places import ROOT
from sizes import code_lines, package_files

#: Pronouns, participles, and other words that do not say what a value is.
_WORDS = """
    all both each everyone everything anything something some someone one other others rest same it
    them its own mine ours theirs these those this that which what who whose thing things stuff
    here there where now then again more less
    asked begun done found given got heard kept known left made meant said seen taken told tried
    used wanted
    """
VAGUE = frozenset(_WORDS.split())
#: A function of more lines of code than these has a docstring.
UNDOCUMENTED_LINES = 6


class Departure(NamedTuple):
    """A place in a file: ``kind`` is one of the counts in ``Style``."""

    line: int
    kind: str
    name: str = ""


class Style(NamedTuple):
    """Counts of one file, of a folder, or of all.

    code: lines of it
    names: how many are bound, by assignments, loops, and parameters
    vague: those of them in ``VAGUE``
    double_bindings: assignments of a tuple to a tuple
    conditional_expressions: ``x if condition else y``
    comments: whole lines in functions, but for those of constants (``#:``)
    undocumented: functions of more than six lines without a docstring
    """

    code: int = 0
    names: int = 0
    vague: int = 0
    double_bindings: int = 0
    conditional_expressions: int = 0
    comments: int = 0
    undocumented: int = 0

    def per(self, number, count):
        """Returns how often something is in so many lines of code."""
        return number * count / max(self.code, 1)


class Module(NamedTuple):
    """A file of Python as a tree, and the numbers of its lines of code and those of comments."""

    tree: ast.Module
    code: set[int]
    comments: set[int]


@functools.cache
def read(path):
    """Returns the ``Module`` in a file, without comments of constants (``#:``)."""
    text = path.read_text("utf-8")
    code = code_lines(text)
    comments = {
        number
        for number, line in enumerate(text.splitlines(), start=1)
        if line.lstrip().startswith("#") and not line.lstrip().startswith("#:")
    }
    return Module(ast.parse(text), code, comments - code)


def bound_names(module):
    """Yields the names that a module binds, and their lines."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.arg) and node.arg not in ("self", "cls"):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id != "_":
            yield node.lineno, node.id


def functions(module):
    """Yields the functions of a module, nested ones too, and the numbers of their lines."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node, range(node.lineno, node.end_lineno + 1)


def departures(path):
    """Yields the places of a file that do not read plainly."""
    module = read(path)
    for line, name in bound_names(module):
        if name.strip("_").lower() in VAGUE:
            yield Departure(line, "vague", name)
    for node in ast.walk(module.tree):
        if isinstance(node, ast.IfExp):
            yield Departure(node.lineno, "conditional_expressions")
        elif isinstance(node, ast.Assign) and _is_double(node):
            yield Departure(node.lineno, "double_bindings")
    for node, lines in functions(module):
        long = len(module.code.intersection(lines)) > UNDOCUMENTED_LINES
        if long and not ast.get_docstring(node):
            yield Departure(node.lineno, "undocumented", node.name)


def _is_double(node):
    """Returns whether an assignment binds several names to as many expressions."""
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def measure(paths):
    """Returns the ``Style`` of some files together."""
    counts = collections.Counter()
    for path in paths:
        module = read(path)
        inside = set().union(*(lines for _, lines in functions(module)))
        counts["code"] += len(module.code)
        counts["names"] += len([*bound_names(module)])
        counts["comments"] += len(module.comments & inside)
        counts.update(departure.kind for departure in departures(path))
    return Style(**counts)


def folders(root=ROOT):
    """Returns the folders of the package and the environments, and the files of each."""
    files = collections.defaultdict(list)
    for path in package_files(root, ".py"):
        files[path.parent.relative_to(root).as_posix()].append(path)
    return dict(sorted(files.items()))


def main(chosen):
    """Prints a row of each folder, and the places in those that were chosen."""
    files = folders()
    print(f"{'':34} code  vague  double  conditional  comments  undocumented")
    print(f"{'':34}          %    /1000        /1000      /100")
    everywhere = [*itertools.chain.from_iterable(files.values())]
    for name, paths in {**files, "all": everywhere}.items():
        style = measure(paths)
        print(
            f"{name:34}{style.code:5}{100 * style.vague / max(style.names, 1):7.1f}"
            f"{style.per(1000, style.double_bindings):8.1f}"
            f"{style.per(1000, style.conditional_expressions):13.1f}"
            f"{style.per(100, style.comments):10.1f}{style.undocumented:14}"
        )
    for path in [path for folder in chosen for path in files[folder.rstrip("/")]]:
        for line, kind, name in sorted(departures(path)):
            print(f"{path.relative_to(ROOT)}:{line}: {kind.replace('_', ' ')} {name}".rstrip())


if __name__ == "__main__":
    main(sys.argv[1:])

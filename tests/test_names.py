"""Names: those in double backticks exist, and those of the code are nouns; how plainly it reads."""

import ast
import functools
import io
import itertools
import re
import tokenize

import mujoco
import pytest
import style
from places import ROOT
from sizes import package_files

#: Placeholders of commands and formulas, and names of other programs that no file of ours has.
OUTSIDE = """
    DIR ID NAME RUN RUN_OR_SWEEP VALUE sum_n sum_t seed_0
    Acc EpisodeWrapper JaxprEqn Linear MjxEnv SummaryWriter Vel binomtest custom_vjp do_simulation
    TensorDict VecEnv bootstrap_on_timeout nohup np_random platform_dependent simple tip
    wrap_env_fn
    __future__ annotations
    """
#: Functions and variables in the source of C MuJoCo, to which comments on our physics point.
C_MUJOCO = """
    MakeHessian PrimalPrepare PrimalUpdateGrad actrange axisdir bestdistmax clcorner clipHalfPlane
    frictionCost frictionCostDif getsolparam gtol mjBOXBOX_EDGEBIAS mjPrimalPnt mjd_actuator_vel
    mjd_passive_vel updateBracket warmstart wrap_
    """
#: What others' names follow.
LIBRARIES = ("gymnasium", "jax", "mjx", "mujoco")
#: How names of files end.
SUFFIXES = {"csv", "html", "json", "npz", "py", "pyi", "toml"}
FILES = package_files(ROOT, ".py", ".pyi", ".h", ".ll")
#: The folders whose files have names.
FOLDERS = ("envs", "experiments", "mjx_reinforce", "tests")


@functools.cache
def tokens(path):
    """Returns the names, strings and comments of a file of Python."""
    kinds = tokenize.NAME, tokenize.STRING, tokenize.COMMENT
    text = io.StringIO(path.read_text("utf-8"))
    return [token for token in tokenize.generate_tokens(text.readline) if token.type in kinds]


@functools.cache
def names(path):
    """Returns the names in the code of a file: those of Python, and the strings of one word."""
    text = path.read_text("utf-8")
    if path.suffix in (".h", ".ll"):
        return set(re.findall(r"\w+", text))
    words = {token.string for token in tokens(path) if token.type == tokenize.NAME}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and re.fullmatch(r"[\w.:/-]+", str(node.value)):
            words.update(re.split(r"\W+", str(node.value)))
    return words


@functools.cache
def definitions(path, kind):
    """Returns the fields and functions in the bodies of a file's classes, or of the module."""
    nodes = [node for node in ast.walk(style.read(path).tree) if isinstance(node, kind)]
    members = [member for node in nodes for member in node.body]
    fields = {member.target.id for member in members if isinstance(member, ast.AnnAssign)}
    return fields | {member.name for member in members if isinstance(member, ast.FunctionDef)}


def prose(path):
    """Yields what stands in double backticks in a Python file or a page, and the line before it."""
    if path.suffix == ".md":
        for line, words in enumerate(path.read_text("utf-8").splitlines(), start=1):
            yield from ((line, code) for code in re.findall("(?<!`)``([^`]+)``(?!`)", words))
        return
    for token in tokens(path):
        if token.type != tokenize.NAME:
            for code in re.findall("``(.+?)``", token.string, re.DOTALL):
                yield token.start[0], code


@pytest.mark.slow
def test_names_in_double_backticks_exist():
    """Somewhere in the code; of a module and a class of ours, there."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    known = {part for path in [*paths, *ROOT.iterdir()] for part in re.split(r"\W+", path.name)}
    known = known.union(OUTSIDE.split(), C_MUJOCO.split(), dir(mujoco.MjData), dir(mujoco.MjModel))
    known = known.union(*map(names, FILES))
    modules = dict.fromkeys(("", *LIBRARIES), known)
    for path in [*FILES, *(ROOT / "experiments").rglob("*.py")]:
        for module in path.relative_to(ROOT).with_suffix("").parts:
            modules.setdefault(module, set()).update(names(path), {path.stem, path.parent.name})
    python = [path for path in FILES if path.suffix == ".py"]
    fields = SUFFIXES.union(*(definitions(path, ast.ClassDef) for path in python))
    # After a name that is no module: whatever is no function of a module.
    others = known.difference(*(definitions(path, ast.Module) for path in python))
    missing = []
    for path in [*python, ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]:
        for line, code in prose(path):
            for dotted in re.findall(r"(?<![\w.])[^\W\d]\w*(?:\.[^\W\d]\w*)*", code):
                for owner, name in itertools.pairwise(["", *dotted.split(".")]):
                    # Letters are sizes, and mj_ and the like begin names of C MuJoCo.
                    checked = len(name) > 1 and not re.match("mj[cu]?_", name)
                    exists = name in fields or name in modules.get(owner, others)
                    if checked and not exists:
                        missing.append(f"{path.relative_to(ROOT)}:{line}: {dotted}")
    assert missing == []


@pytest.mark.slow
def test_names_of_the_code_are_nouns():
    """In every folder, of a hundred names at most 1.5 are pronouns, participles, or the like."""
    vague = {}
    for folder, paths in style.folders().items():
        counts = style.measure(paths)
        # A folder of a few names may have one.
        if counts.vague > max(1, 0.015 * counts.names):
            vague[folder] = f"{counts.vague} of {counts.names}"
    assert vague == {}


@pytest.mark.slow
def test_the_code_reads_plainly():
    """``python tests/helpers/style.py FOLDER`` prints the places."""
    counts = style.measure(package_files(ROOT, ".py"))
    assert counts.per(1000, counts.double_bindings) <= 3
    assert counts.per(1000, counts.conditional_expressions) <= 15
    assert counts.per(100, counts.comments) >= 4.5


def test_functions_of_more_than_a_few_lines_have_docstrings():
    missing = [
        f"{path.relative_to(ROOT)}:{place.line}: {place.name}"
        for path in package_files(ROOT, ".py")
        for place in style.departures(path)
        if place.kind == "undocumented"
    ]
    assert missing == []

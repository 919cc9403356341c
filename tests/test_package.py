"""The package's shape: imports point one way, the heavy ones wait, the README runs."""

import ast
import collections
import functools
import graphlib
import json
import re
import subprocess
import sys
import tomllib

import pytest
import setuptools
from places import ROOT
from saved_runs import make_run
from sizes import sizes as measured_sizes

import mjx_reinforce

TESTS = ROOT / "tests"
PACKAGE = ROOT / "mjx_reinforce"
#: Folders and root modules from the ground up; a file imports from its own folder and those before.
ORDER = [
    "engine",
    "registry",
    "envs",
    "files",
    "learning",
    "published",
    "console",
    "settings",
    "gym",
    "export",
    "statistics",
    "reports",
    "training",
    "setup",
    "playing",
    "report",
    "runs",
    "sweep",
    "train",
    "watch",
    "templates",
    "new",
    "__main__",
]
#: The floors of the engine, the same way.
FLOORS = [
    "lazy",
    "counts",
    "base",
    "memory",
    "checks",
    "contract",
    "devices",
    "objects",
    "scalar",
    "episode",
    "physics",
    "llvm",
    "cpu",
    "team",
    "gpu",
    "play",
    "cache",
    "vector",
]
#: Commands of folders, found where ``python -m`` looks for them. They use what comes later.
COMMANDS = {"envs.__main__", "export.__main__"}
#: Who may know that our environments exist; all others take any environment as an argument.
MAY_IMPORT_ENVS = {
    *("envs", "settings", "training", "setup", "runs", "playing"),
    *("gym", "train", "watch", "templates", "new", "__main__"),
}

#: What a user writes, and what the checker is asked; its last line is wrong.
TYPED = """import jax
import mjx_reinforce as mr
env = mr.envs.make("CartPole-v1")
reveal_type(env)
learner = mr.reinforce(env)
state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
reveal_type(metrics)
reveal_type(state.replace(progress=state.progress))
mr.reinforce(env, num_episodez=3)
"""


def modules(root, parent):
    """Dotted names below the package, and their files; a package is named as its folder."""
    for path in sorted(root.rglob("*.py")):
        if "envs" not in path.relative_to(root).parts:  # a link to the folder at the top
            parts = (*parent, *path.relative_to(root).with_suffix("").parts)
            yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


FILES = dict([*modules(PACKAGE, ()), *modules(ROOT / "envs", ("envs",))])


def folder(module):
    """The first part of a name."""
    return "__main__" if module in COMMANDS else module.partition(".")[0]


@functools.cache
def imported(path):
    """The package's own modules that a file imports, at its top or in its functions."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mjx_reinforce"):
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [
                n if n.removeprefix("mjx_reinforce.") in FILES else node.module for n in inside
            ]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if "mjx_reinforce." in alias.name]
        modules += [name.removeprefix("mjx_reinforce.") for name in names if "." in name]
    return modules


def test_imports_point_one_way():
    arrows = [(name, other) for name, path in FILES.items() if name for other in imported(path)]
    assert len(arrows) > len(FILES)
    assert [
        f"{name} imports {other}"
        for name, other in arrows
        if ORDER.index(folder(other)) > ORDER.index(folder(name))
        or (folder(other) == "envs" and folder(name) not in MAY_IMPORT_ENVS)
    ] == []


def test_imports_in_the_engine_point_one_way():
    """From a floor to those before it."""
    inside = {name: path for name, path in FILES.items() if name.startswith("engine.")}
    arrows = [
        (name.split(".")[1], other.split(".")[1])
        for name, path in inside.items()
        for other in imported(path)
        if other != "engine"
    ]
    assert len(arrows) > len(inside)
    assert {name.split(".")[1] for name in inside} == {*FLOORS}
    assert [
        f"{floor} imports {other}"
        for floor, other in arrows
        if FLOORS.index(other) > FLOORS.index(floor)
    ] == []


def test_no_imports_in_a_circle():
    """Within a folder too: every file can be read after those it imports."""
    graph = {name: set(imported(path)) - {name} for name, path in FILES.items() if name}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_folders_are_small():
    """A stranger sees at once what is in one."""
    sizes = collections.Counter(p.parent for p in FILES.values() if p.name != "__init__.py")
    assert {str(folder): n for folder, n in sizes.items() if n > 14} == {}


def test_lines_of_cpp_fit():
    """As ruff holds those of Python to 100 columns."""
    lines = [
        f"{path.name}:{number}"
        for path in sorted(ROOT.glob("mjx_reinforce/**/*.h"))
        for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1)
        if len(line) > 100
    ]
    assert lines == []


@pytest.mark.slow
def test_no_size_is_above_its_ceiling():
    """Each size that has a ceiling is at most that ceiling."""
    ceilings = tomllib.loads((TESTS / "ceilings.toml").read_text("utf-8"))
    sizes = measured_sizes(ROOT)
    assert ceilings.keys() <= sizes.keys()
    assert {name: sizes[name] for name in ceilings if sizes[name] > ceilings[name]} == {}


def test_the_wheel_has_every_package():
    """Found as setuptools finds them; nothing beside ours, such as the ``envs`` at the top."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    found = setuptools.find_packages(str(ROOT), include=listed["packages"]["find"]["include"])
    packages = {
        name if path.name == "__init__.py" else name.rpartition(".")[0]
        for name, path in FILES.items()
    }
    assert set(found) == {f"mjx_reinforce.{name}".strip(".") for name in packages}


def test_the_wheel_has_every_file_that_is_no_module():
    """Tables, templates and policies, which modules read beside them."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    packed = {
        path
        for package, patterns in listed["package-data"].items()
        for pattern in patterns
        for path in PACKAGE.joinpath(*package.split(".")[1:]).glob(pattern)
    }
    ours = {path for path in PACKAGE.rglob("*") if path.is_file()} | {
        *(PACKAGE / "envs/assets").iterdir()
    }
    assert {path for path in ours if path.suffix not in (".py", ".pyc")} == packed


def run(code):
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout


def test_import_is_light():
    loaded = run(
        "import sys, mjx_reinforce, mjx_reinforce.envs, mjx_reinforce.settings.config\n"
        "print([m for m in ('jax', 'brax', 'mujoco', 'flax', 'scipy') if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_the_engine_stands_by_itself():
    """It is imported in an instant; all its names load JAX, and of this package the engine."""
    late = ("flax", "optax", "tyro", "rich", "matplotlib", "brax", "mujoco", "gymnasium")
    instant, others, ours = run(
        "import sys, mjx_reinforce.engine as engine\n"
        "print('jax' in sys.modules)\n"
        "for name in engine.__all__: getattr(engine, name)\n"
        f"print([m for m in {late} if m in sys.modules])\n"
        "ours = [m for m in sys.modules if m.startswith('mjx_reinforce.')]\n"
        "print([m for m in ours if m.split('.')[1] != 'engine'])"
    ).splitlines()
    assert (instant, others, ours) == ("False", "[]", "[]")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "runs.command_line", "export.__main__", "new"])
def test_what_reads_a_command_line_is_light(command):
    """So that --help, and what is refused, take no second."""
    loaded = run(f"import sys, mjx_reinforce.{command}\nprint('jax' in sys.modules)")
    assert loaded.strip() == "False"


@pytest.mark.slow
def test_pages_films_and_logs_wait():
    """What draws and logs is imported when something is drawn or logged."""
    late = ("vl_convert", "jinja2", "tensorboardX", "matplotlib", "PIL")
    loaded = run(
        "import sys, mjx_reinforce.train, mjx_reinforce.watch, mjx_reinforce.runs.command_line\n"
        "import mjx_reinforce.runs.results, mjx_reinforce.runs.saving\n"
        "import mjx_reinforce.setup.ready\n"
        f"print([m for m in {late} if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


@pytest.mark.slow
def test_every_public_name_exists():
    run("import mjx_reinforce as m\nfor name in m.__all__: getattr(m, name)")


@pytest.mark.slow
def test_readme_python_runs(tmp_path):
    """Every Python block of the README, in order, in one program, beside a trained run."""
    make_run(tmp_path / "pendulum", "InvertedPendulum-v5")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert blocks
    code = "\n".join(blocks)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, cwd=tmp_path)


def test_type_checkers_see_the_public_names():
    """They read the stub, which says where each is imported from, and that all of it is public."""
    tree = ast.parse((ROOT / "mjx_reinforce" / "__init__.pyi").read_text("utf-8"))
    (public,) = (node.value for node in tree.body if isinstance(node, ast.Assign))
    assert ast.literal_eval(public) == mjx_reinforce.__all__
    nodes = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    modules = {alias.asname for node in nodes if not node.module for alias in node.names}
    assert modules == set(mjx_reinforce._MODULES)
    imports = [node for node in nodes if node.module]
    assert {node.module.removeprefix("mjx_reinforce.") for node in imports} <= set(FILES)
    assert mjx_reinforce._HOME.keys() == {alias.name for node in imports for alias in node.names}


@pytest.mark.slow
def test_type_checkers_know_the_types(tmp_path):
    """From another folder, as they see what is installed: ``pip install -e .`` too."""
    (tmp_path / "own.py").write_text(TYPED)
    command = ["-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "own.py"]
    done = subprocess.run([sys.executable, *command], capture_output=True, cwd=tmp_path)
    said = json.loads(done.stdout)["generalDiagnostics"]
    known = [re.findall('type of "(.*)" is "(.*)"', one["message"], re.I) for one in said]
    assert [types[0] for types in known if types] == [
        ("env", "MujocoEnv"),
        ("metrics", "dict[str, Array]"),
        ("state.replace(progress=state.progress)", "TrainState"),
    ]
    errors = [one["message"] for one in said if one["severity"] == "error"]
    assert errors == ['No parameter named "num_episodez"']


TEST_FILES = {path.stem: path for path in sorted(TESTS.rglob("test_*.py"))}


def test_test_files_are_in_folders_of_the_package():
    """And what tests a module of the root, or all of it, is in none."""
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TEST_FILES.values()}
    inside = {str(path.parent.relative_to(PACKAGE)) for path in PACKAGE.glob("engine/**/*.py")}
    assert folders <= {".", *ORDER, *inside, "commands", "experiments"}


def test_no_test_file_imports_another():
    """What several use is in tests/helpers."""
    arrows = []
    for name, path in TEST_FILES.items():
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            arrows += [(name, each.partition(".")[0]) for each in names]
    assert [arrow for arrow in arrows if arrow[1] in {*TEST_FILES, "conftest"}] == []

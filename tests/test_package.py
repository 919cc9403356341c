"""The package's shape: imports point one way, the heavy ones wait, the README runs."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Modules from the ground up; each may import only from earlier levels.
LEVELS = [
    {"__init__", "registry", "types", "networks", "statistics", "fused", "truncated_normal"},
    {
        "distributions",
        "normals",
        "bounded",
        "estimators",
        "gradients",
        "rollouts",
        "normalize",
        "control",
        "envs",
    },
    {"policies", "kernel", "engines", "updates", "learner", "ars", "evaluation"},
    {"checkpoint", "config", "presets", "build", "records", "report", "display", "runlog"},
    {"train", "watch"},
]


def imported(path):
    """The package's own modules that a file imports, at its top or in its functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mjx_reinforce"):
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if "mjx_reinforce." in a.name)


def level(module):
    return next(i for i, names in enumerate(LEVELS) if module in names)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "mjx_reinforce").glob("*.py")), ids=lambda p: p.stem
)
def test_imports_point_one_way(path):
    for module in imported(path):
        assert level(module) <= level(path.stem), f"{path.stem} imports {module}"
        if module == "envs":
            assert path.stem in ("train", "watch", "config", "__init__")


@pytest.mark.parametrize("path", sorted((ROOT / "envs").glob("*.py")), ids=lambda p: p.stem)
def test_envs_import_no_trainer_module(path):
    assert set(imported(path)) <= {"types", "registry", "fused", "envs"}


def run(code):
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout


def test_import_is_light():
    loaded = run(
        "import sys, mjx_reinforce, mjx_reinforce.envs, mjx_reinforce.config\n"
        "print([m for m in ('jax', 'brax', 'mujoco', 'flax', 'scipy') if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_every_public_name_exists():
    run("import mjx_reinforce as m\nfor name in m.__all__: getattr(m, name)")


def test_readme_python_runs(tmp_path):
    """Every Python block of the README, in order, in one program."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert blocks
    code = "\n".join(blocks)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, cwd=tmp_path)

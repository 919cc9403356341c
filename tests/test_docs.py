"""The pages of docs/ and the examples of the public names run, and each public name has a page."""

import doctest
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from c_programs import needs_compiler
from command_lines import run_command
from exports import run_export
from places import PYTHONPATH
from saved_runs import make_run

import mjx_reinforce
from mjx_reinforce import envs
from mjx_reinforce.console.commands import COMMANDS
from mjx_reinforce.envs import parts
from mjx_reinforce.registry import load_definition
from mjx_reinforce.training.rows import COLUMNS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PUBLIC = {name: getattr(mjx_reinforce, name) for name in mjx_reinforce.__all__}
del PUBLIC["__version__"]
TASK_NAMES = ("names", "make", "register", "from_playground", "for_brax")
TASKS = {f"envs.{name}": getattr(envs, name) for name in TASK_NAMES}
PARTS = {f"envs.parts.{name}": getattr(parts, name) for name in parts.__all__}
#: Comment before a block that no test runs, with the reason.
NOT_RUN = "<!-- not run: "


def page(name):
    return (DOCS / name).read_text("utf-8")


def blocks(text, language):
    """Returns the code of a page, without the blocks that a comment excuses."""
    found = re.findall(
        rf"({NOT_RUN}[^\n]*-->\n+)?^```{language}\n(.*?)^```", text, flags=re.S | re.M
    )
    return [code for excuse, code in found if not excuse]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PUBLIC, *TASKS])
def test_example_runs(name, monkeypatch):
    """Every public name has an example in its docstring, and it gives what it says."""
    monkeypatch.setattr(envs, "_TABLE", dict(envs._TABLE))  # one adds a task
    it = (PUBLIC | TASKS)[name]
    (example,) = doctest.DocTestFinder(recurse=False).find(it, name, globs={})
    assert example.examples, f"{name} has no example"
    failed, _ = doctest.DocTestRunner(optionflags=doctest.REPORT_NDIFF).run(example)
    assert not failed


def test_every_public_name_has_a_page():
    """Once among the pages of the API, and on the page that has them all."""
    pages = "\n".join(path.read_text("utf-8") for path in (DOCS / "api").glob("*.md"))
    shown = re.findall(r"^::: mjx_reinforce\.(.+)$", pages, re.M)
    assert sorted(shown) == sorted([*PUBLIC, *TASKS, *PARTS])
    named = set(re.findall(r"`(?:envs\.)?(\w+)[`(]", page("all.md")))
    assert {*PUBLIC, *(name.removeprefix("envs.") for name in TASKS)} <= named
    assert {*parts.__all__} <= set(re.findall(r"`(\w+)\(", page("own_task.md")))


def test_every_public_function_has_types():
    """Each argument is annotated, and so is what is returned."""
    for name, it in (PUBLIC | TASKS | PARTS).items():
        if inspect.isfunction(it):
            signature = inspect.signature(it)
            typed = [each.annotation for each in signature.parameters.values()]
            assert inspect.Signature.empty not in [*typed, signature.return_annotation], name


#: A task whose physics takes seconds to trace, and one that takes none; both have the same spaces.
EASIER = {"InvertedPendulum-v5": "ContinuousCartPole-v0"}
#: What is tested of a page or notebook, in place of what its reader trains.
SMALLER = {
    "engine.md": EASIER,
    "own_parts.md": EASIER,
    "own_task.md": {"make_vec(Walk(), num_envs=8)": 'make_vec(Walk(), 8, engine="mujoco")'},
    "ppo.py": EASIER | {"64, 64, 60, 4, 4": "8, 16, 2, 1, 2"},
    "python.md": EASIER | {"env_steps=20_000), num_seeds=8": "env_steps=2_000), num_seeds=2"},
    "reinforce.py": {"16, 500, 0.99, 60": "16, 50, 0.99, 3"},
    "robot.py": {"env_steps=6_000_000": "env_steps=6_400", "num_seeds=2": "num_seeds=1"},
    "seeds.py": EASIER | {"SEEDS = 1000": "SEEDS = 50", "env_steps=12_000": "env_steps=2_000"},
    "tasks.py": {
        "num_seeds=2)": "env_steps=2000, num_seeds=2)",
        '"Reacher-v5", "Swimmer-v5", "Hopper-v5", "HalfCheetah-v5"': '"ContinuousCartPole-v0"',
    },
    "vector.md": {"HalfCheetah-v5": "InvertedPendulum-v5", "num_envs=512": "num_envs=8"},
}


def run_smaller(name, code, folder):
    """Runs the code of a page as a program, with the numbers of a test."""
    for said, instead in SMALLER.get(name, {}).items():
        assert said in code, said
        code = code.replace(said, instead)
    settings = os.environ | {"PYTHONPATH": PYTHONPATH, "MPLBACKEND": "agg"}
    command = [sys.executable, "-W", "ignore", "-c", code]
    subprocess.run(command, check=True, cwd=folder, env=settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [path.name for path in sorted(DOCS.glob("*.md")) if blocks(path.read_text("utf-8"), "python")],
)
def test_python_of_page_runs(name, tmp_path):
    """Every Python block of a page, in order, in one program, beside a trained run."""
    make_run(tmp_path / "pendulum", "InvertedPendulum-v5")
    run_smaller(name, "\n".join(blocks(page(name), "python")), tmp_path)


@needs_compiler
def test_c_of_policies_runs(tmp_path, monkeypatch):
    """The page's program, by its line for the compiler, beside the header of its command."""
    run = make_run(tmp_path / "pendulum", "InvertedPendulum-v5")
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(page("policies.md"), "c")
    (commands,) = [x for x in blocks(page("policies.md"), "sh") if ".h\n" in x]
    (tmp_path / "robot.c").write_text(code)
    export, compile_program = commands.splitlines()
    run_export(monkeypatch, *export.removeprefix("python -m mjx_reinforce.export ").split())
    subprocess.run(compile_program.split(), check=True)
    printed = subprocess.run("./robot", check=True, capture_output=True, text=True).stdout
    expected = mjx_reinforce.load(run).act(np.array([0.0, 0.1, 0.0, 0.0]))
    assert float(printed) == pytest.approx(expected[0], abs=1e-6)


#: What Stable-Baselines3's classes ask of a ``VecEnv``, in place of a package that needs torch.
STAND_IN = """
import sys, types
class VecEnv:
    def __init__(self, num_envs, observation_space, action_space):
        self.num_envs, self.metadata, self._seeds = num_envs, {}, [None] * num_envs
        (self.render_mode,) = set(self.get_attr("render_mode"))
    def _get_indices(self, indices):
        return range(self.num_envs)
    def _reset_seeds(self):
        pass
names = "stable_baselines3", "common", "monitor", "vec_env"
base, common, monitor, vec_env = map(types.ModuleType, names)
base.PPO, base.common, monitor.Monitor, vec_env.VecEnv = None, common, object, VecEnv
sys.modules |= {"stable_baselines3": base, "stable_baselines3.common": common}
sys.modules |= {f"stable_baselines3.common.{x.__name__}": x for x in (monitor, vec_env)}
"""
#: As ``VecVideoRecorder`` films it.
FILMED = """
filmed = Environments("InvertedPendulum-v5", 2, render_mode="rgb_array")
assert (filmed.render_mode, filmed.metadata["render_fps"]) == ("rgb_array", 25)
filmed.reset()
(before,) = filmed.get_images()
for _ in range(5):
    filmed.step_async(np.ones((2, 1)))
    filmed.step_wait()
(after,) = filmed.get_images()
assert before.shape == after.shape == (240, 320, 3)
assert np.any(before != after)
filmed.close()
"""


@pytest.mark.slow
def test_the_vec_env_of_the_page_is_filmed(tmp_path):
    """The page's class for Stable-Baselines3, on a stand-in for what it is derived from."""
    (code,) = re.findall(
        r"^import numpy as np\nfrom stable.*?(?=^PPO)", page("vector.md"), re.S | re.M
    )
    run_smaller("the VecEnv", STAND_IN + code + FILMED, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(DOCS.glob("notebooks/*.py")), ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path):
    """As a program, from its first cell to its last; it draws its picture."""
    run_smaller(path.name, path.read_text("utf-8"), tmp_path)
    assert (tmp_path / f"{path.stem}.png").exists()
    assert path.with_suffix(".png").stat().st_size < 100_000


def test_flags_of_pages_exist(capfd):
    """What the pages say on command lines is what the commands know."""
    for entry, _ in COMMANDS.values():
        run_command("--help", command=load_definition(entry))
    known = set(re.findall(r"--[a-z][a-z-]+", capfd.readouterr().out))
    said = {}
    for path in sorted(DOCS.glob("*.md")):
        for code in blocks(path.read_text("utf-8"), "sh"):
            for line in code.replace("\\\n", " ").splitlines():
                if re.search(rf"mjx_reinforce\.({'|'.join(COMMANDS)})\b", line):
                    said |= dict.fromkeys(re.findall(r"(?<= )--[a-z][a-z-]+", line), path.name)
    assert len(said) > 10
    assert {flag: page for flag, page in said.items() if flag not in known} == {}


def test_links_of_pages_are_files():
    """As GitHub shows the pages: each relative link is a file of the repository."""
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]:
        for link in re.findall(r"\]\(([^)#\s]+)", path.read_text("utf-8")):
            if "://" not in link:
                assert (path.parent / link).exists(), f"{path.name}: {link}"


def table(name, heading):
    """Returns the rows of the first table below a heading, without its own first line."""
    text = page(name).partition(f"\n## {heading}\n")[2]
    lines = re.search(r"(?:^\|.*\n)+", text, re.M)
    assert lines, heading
    return [[x.strip() for x in line.strip("|\n").split("|")] for line in lines[0].splitlines()[2:]]


def test_the_columns_of_metrics_are_explained_in_their_order():
    explained = [row[0].strip("`") for row in table("first_run.md", "Columns of metrics.csv")]
    assert explained == list(COLUMNS)


def test_thresholds_are_those_of_the_tasks():
    said = {row[0].strip("`"): row[1:] for row in table("settings.md", "Thresholds of the tasks")}
    assert list(said) == envs.names()
    for name, (threshold, horizon) in said.items():
        env = envs.make(name)
        known = "none" if env.reward_threshold is None else f"{env.reward_threshold:,g}"
        assert (threshold, horizon) == (known, f"{env.max_episode_steps:,}")


def test_pages_name_experiments_that_exist():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]
    for path in [*pages, *(ROOT / "experiments").rglob("*.py"), ROOT / "experiments/README.md"]:
        text = path.read_text("utf-8")
        for name in re.findall(r"python -m (experiments\.[\w.]*\w)", text):
            place = ROOT / name.replace(".", "/")
            assert place.with_suffix(".py").exists() or (place / "__main__.py").exists(), name
        for name in re.findall(r"(?<![\w/])experiments/[\w./-]*\w", text):
            assert (ROOT / name).exists(), f"{path.name}: {name}"


def test_pictures_and_films_are_small():
    """A clone and a page load quickly."""
    most = {".png": 100_000, ".gif": 300_000}
    sizes = {path: path.stat().st_size for path in DOCS.rglob("*") if path.suffix in most}
    assert {path.name: size for path, size in sizes.items() if size > most[path.suffix]} == {}

"""Mutation testing: how many small changes of the arithmetic do the quick tests notice?

    pip install -e ".[mutation]"
    python -m experiments.checks.mutation                 # every mutant: about an hour on two cores
    python -m experiments.checks.mutation --sample 40 estimators updates

mutmut changes one operator, number or argument at a time; `pyproject.toml` says in which files,
and which tests it runs. This works in a copy of the checkout and draws the sample, the same one
for the same seed. It prints the score of every file and the difference of every survivor.
mutmut changes functions alone: module constants need tests that state their numbers.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path

from experiments.kit.places import ROOT

#: Compiled programs are kept: most mutants change one program of a test's many.
ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "XLA_FLAGS": "--xla_backend_optimization_level=0",
}
#: Exit codes of a test run that noticed: failed, not even collected, time over, crashed.
NOTICED = {1, 3, 255, 36, -24, 24, 152, -9, -11}


def copy_checkout(target: Path) -> None:
    """Copies what git tracks or would add."""
    listed = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    names = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True).stdout
    archive = subprocess.run(
        ["tar", "c", "--null", "-T", "-"], cwd=ROOT, input=names, check=True, capture_output=True
    ).stdout
    subprocess.run(["tar", "x"], cwd=target, input=archive, check=True)


def mutmut(folder: Path, *arguments: str) -> str:
    """Runs mutmut in a folder and returns what it printed."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    environment = cache | ENVIRONMENT | os.environ
    command = [sys.executable, "-m", "mutmut", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout[-3000:] + done.stderr[-3000:])
    return done.stdout


def read(folder: Path) -> dict[str, dict[str, int | None]]:
    """Returns module -> mutant -> exit code of its tests, None if they did not run."""
    records = sorted((folder / "mutants").rglob("*.py.meta"))
    return {_name(record): json.loads(record.read_text())["exit_code_by_key"] for record in records}


def _name(record: Path) -> str:
    """Returns the name of a module, of a package that of its folder."""
    name = record.name.removesuffix(".py.meta")
    return record.parent.name if name == "__init__" else name


def draw(mutants: list[str], sample: int | None, seed: int) -> list[str]:
    """Returns all mutants, or a seeded sample of them."""
    if sample is None or sample >= len(mutants):
        return mutants
    return sorted(random.Random(seed).sample(mutants, sample))


def main() -> None:
    """Tests the mutants and prints the table and the survivors."""
    parser = argparse.ArgumentParser(description="Tests mutants of the arithmetic.")
    parser.add_argument("modules", nargs="*", help="by file name; all by default")
    parser.add_argument("--sample", type=int, help="mutants a module; all by default")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="keep the copy and go on there next time")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="mutation-"))
    folder.mkdir(exist_ok=True)
    copy_checkout(folder)
    # The mutants are made, and the tests that reach each function found, before the first runs.
    mutmut(folder, "run", "mjx_reinforce.learning.normalize.x_init__mutmut_1")
    chosen = {
        module: draw(list(codes), arguments.sample, arguments.seed)
        for module, codes in read(folder).items()
        if not arguments.modules or module in arguments.modules
    }
    names = [name for drawn in chosen.values() for name in drawn]
    mutmut(folder, "run", "--max-children", str(arguments.processes), *names)
    report(folder, chosen)


def report(folder: Path, chosen: dict[str, list[str]]) -> None:
    """Prints a line for every module and what every survivor changed."""
    codes = read(folder)
    survivors = []
    print("| module | mutants | tested | killed | survived |\n|---|---|---|---|---|")
    for module, drawn in chosen.items():
        survived = [name for name in drawn if codes[module][name] not in NOTICED]
        killed = len(drawn) - len(survived)
        score = f"{killed} ({killed / len(drawn):.0%})"
        print(f"| {module} | {len(codes[module])} | {len(drawn)} | {score} | {len(survived)} |")
        survivors += [(name, codes[module][name]) for name in survived]
    for name, code in survivors:
        print(f"\n{name} (exit code {code})\n{mutmut(folder, 'show', name)}")


if __name__ == "__main__":
    main()

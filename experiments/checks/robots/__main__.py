"""Which robots run, and how fast: models that others wrote, beside C MuJoCo, and docs/robots.md.

    python -m experiments.checks.robots equality ROWS.csv FOLDER --engine mujoco
    python -m experiments.checks.robots equality ROWS.csv FOLDER          # by the engine of auto
    python -m experiments.checks.robots speed ROWS.csv FOLDER
    python -m experiments.checks.robots page ROWS.csv
    python -m experiments.checks.robots cpu-page ROWS.csv
    python -m experiments.checks.robots teams TEAMS.csv FOLDER
    python -m experiments.checks.robots gpu GPU.csv FOLDER --listed TEAMS.csv --seconds 560
    python -m experiments.checks.robots gpu-page GPU.csv FOLDER --listed TEAMS.csv

FOLDER has a folder for each package, such as pip has unpacked. Each model is judged by a process of
its own, with limits of time and memory. ROWS.csv gets a row each, and a model that has its row is
skipped, so a run can be cut off and continued. ``page`` writes docs/robots.csv and docs/robots.md;
``cpu-page`` writes docs/robots_cpu.csv and the page, of rows of ``speed`` with a C++ compiler.
``teams`` asks which models the device code of teams covers, compares what it covers with C MuJoCo,
and prints the counts; its rows, of other columns (see teams.py), have a file of their own. ``gpu``
times these models on a GPU, beside MuJoCo Warp where it is installed, and is to be called again
until none is left; ``gpu-page`` writes docs/robots_gpu.csv and the page.
"""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import tyro

from experiments.checks.robots import gpu, models, page, teams
from experiments.checks.robots.judging import Question, judged
from experiments.kit import rows

#: Columns of the rows; what a phase does not measure is empty.
COLUMNS = ("phase", "asked", "package", "model", "mechanism", "stubs", "actuators", "verdict")
COLUMNS += ("auto", "engine", "why", "error", "cause", "seconds", "steps_per_s", "ratio")
COLUMNS += ("ratio_by_clock",)
#: Verdicts of what no engine plays.
_NOT_PLAYED = ("no model", "same mechanism", "no actuators")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Judge models that others wrote."""

    phase: tyro.conf.Positional[
        Literal["equality", "speed", "page", "cpu-page", "teams", "gpu", "gpu-page"]
    ]
    """What to do."""
    output: tyro.conf.Positional[Path]
    """The rows."""
    folder: tyro.conf.Positional[Path] = Path()
    """The models: a folder for each package."""
    engine: Literal["auto", "mujoco"] = "auto"
    """Whose equality is judged."""
    listed: Path | None = None
    """A CSV file with the columns package and model: no other is judged. Of gpu, rows of teams."""
    seconds: float = 180.0
    """A model may take so long; of gpu, all of them together."""
    commit: str = ""
    """Of the code that gpu measures."""
    gigabytes: float = 32.0
    """A model may reserve so much memory, most of which the arenas of large models never touch."""


def todo(settings: Settings, known: list[dict[str, Any]]) -> Iterator[tuple[str, str, Path]]:
    """Yields the package, name and path of each model that has no row yet.

    The others' rows are by the same engine: ``auto`` need not play again what it leaves to C
    MuJoCo and that has played already.
    """
    folder = settings.folder.resolve()
    paths = models.files(folder)
    if settings.listed:
        paths = [folder / row["package"] / row["model"] for row in rows.read(settings.listed)]
    finished = set()
    for row in known:
        is_same = settings.engine == row["asked"]
        is_same |= row["auto"] == "mujoco" and settings.engine in ("auto", "mujoco")
        if row["verdict"] in _NOT_PLAYED or (row["phase"] == settings.phase and is_same):
            finished.add((row["package"], row["model"]))
    for path in paths:
        package, *parts = path.relative_to(folder).parts
        if (package, "/".join(parts)) not in finished:
            yield package, "/".join(parts), path


def measure(settings: Settings) -> None:
    """Judges every model that has no row yet, and appends its row."""
    known: list[dict[str, Any]] = []
    if settings.output.exists():
        known = rows.read(settings.output)
    question = Question(settings.phase, settings.engine, settings.seconds, settings.gigabytes)
    mechanisms = {
        row["mechanism"]: f"{row['package']}/{row['model']}"
        for row in known
        if row["mechanism"]
        and row["verdict"] != "same mechanism"
        and (row["phase"], row["asked"]) == (settings.phase, settings.engine)
    }
    start_time = time.monotonic()
    models_left = [*todo(settings, known)]
    for count, (package, name, path) in enumerate(models_left, start=1):
        key = {"phase": settings.phase, "asked": settings.engine, "package": package, "model": name}
        row = dict.fromkeys(COLUMNS, "") | judged(question, path, mechanisms) | key
        rows.append(settings.output, [row], COLUMNS)
        mechanisms.setdefault(row["mechanism"], f"{package}/{name}")
        passed = time.monotonic() - start_time
        left = passed / count * (len(models_left) - count)
        shown = (row[name] for name in ("verdict", "engine", "error", "ratio", "cause"))
        print(
            f"{count} of {len(models_left)}, {left / 60:.0f} min left: {package} {name}:",
            *shown,
            flush=True,
        )


def main(settings: Settings) -> None:
    """Does what is asked for."""
    if settings.phase == "page":
        page.write(rows.read(settings.output))
    elif settings.phase == "cpu-page":
        page.write_cpu(rows.read(settings.output))
    elif settings.phase in ("gpu", "gpu-page"):
        if settings.listed is None:
            raise ValueError(f"{settings.phase} needs --listed, the rows of teams")
        if settings.phase == "gpu":
            gpu.measure(
                settings.output, settings.folder, settings.listed, settings.seconds, settings.commit
            )
        else:
            gpu.write(page.GPU_CSV, settings.listed, settings.output, settings.folder)
            page.fill()
    elif settings.phase == "teams":
        teams.measure(settings.output, settings.folder, settings.seconds)
    else:
        measure(settings)


if __name__ == "__main__":
    main(tyro.cli(Settings))

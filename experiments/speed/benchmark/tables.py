"""Writes what README.md and docs/benchmarks.md say of speed from docs/benchmarks.csv.

``python -m experiments.speed.benchmark.tables`` replaces what stands between ``<!-- NAME -->`` and
``<!-- end -->``, where NAME is one of `TABLES`. A number is the median of a row's repetitions, the
greatest where several batches were tried; a ratio is of rows of one call.
"""

import functools
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from experiments.kit.markdown import filled, listed, table
from experiments.kit.places import DOCS, ROOT
from experiments.speed.benchmark.rows import RAW, TRAINED, read, speed

PAGES = (ROOT / "README.md", DOCS / "benchmarks.md")
#: The tasks that are compared in words.
FEW = ("InvertedPendulum-v5", "Reacher-v5", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5")
OTHERS = (
    *("InvertedDoublePendulum-v5", "Swimmer-v5", "Pusher-v5", "Humanoid-v5"),
    *("HumanoidStandup-v5", "experiments.examples.quadruped:Quadruped", "CartPole-v1"),
)
#: Numbers of episodes of which an env step's milliseconds are shown.
SMALL = (1, 32, 256)


class Raw(NamedTuple):
    """The rows of each kind of call (`all.py`), of its last date for each task.

    gpu: on a GPU, and C MuJoCo on its machine
    cpu: on two cores
    envpool: on two cores, where EnvPool is installed
    """

    gpu: list[dict[str, Any]]
    cpu: list[dict[str, Any]]
    envpool: list[dict[str, Any]]


def last_calls(rows: list[dict[str, Any]]) -> Raw:
    """Sorts rows by the kind of their call, and keeps each task's last call of a kind.

    Few episodes have calls of their own (``--batches``), and so a last one.
    """
    on_gpu = {row["date"] for row in rows if row["device"] != "cpu"}
    beside = {row["date"] for row in rows if row["engine"] == "EnvPool"}

    def place(row: dict[str, Any]) -> int:
        """Returns the field of ``Raw`` that a row is in."""
        if row["date"] in beside:
            return 2
        return int(row["date"] not in on_gpu)

    def kind(row: dict[str, Any]) -> tuple[str, int, bool]:
        return row["task"], place(row), row["batch"] in SMALL

    last = {kind(row): row["date"] for row in sorted(rows, key=_date)}
    now = [row for row in rows if row["date"] == last[kind(row)]]
    return Raw(*([row for row in now if place(row) == number] for number in range(3)))


def _date(row: dict[str, Any]) -> str:
    return row["date"]


def best(
    rows: list[dict[str, Any]],
    task: str,
    engine: str,
    precision: str = "",
    *,
    trained: bool = False,
    batch: int | None = None,
) -> dict[str, Any] | None:
    """Returns the fastest row of a task and an engine.

    Args:
      rows: all rows.
      task: its name.
      engine: its name.
      precision: of the row, if given.
      trained: whether a trained policy plays.
      batch: how many episodes or worlds; by default any number that is not of ``SMALL``.
    """
    fit = [row for row in rows if row["task"] == task and row["engine"] == engine]
    fit = [row for row in fit if precision in ("", row["precision"])]
    fit = [row for row in fit if (row["what"] == TRAINED) == trained]
    if batch is None:
        fit = [row for row in fit if row["batch"] not in SMALL]
    else:
        fit = [row for row in fit if row["batch"] == batch]
    return max(fit, key=speed, default=None)


def rate(row: dict[str, Any] | None) -> str:
    """Returns a row's speed with three digits: "1.35e8"; nothing where there is no row."""
    if row is None:
        return ""
    mantissa, exponent = f"{speed(row):.2e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def ratio(one: dict[str, Any] | None, other: dict[str, Any] | None) -> str:
    """Returns how many times as fast one row is as another."""
    return "" if one is None or other is None else times(speed(one) / speed(other))


def times(x: float) -> str:
    """Returns a ratio with two digits, more where it is above a hundred."""
    return f"{x:.1f}" if x < 10 else f"{x:,.0f}"


def at(row: dict[str, Any] | None) -> str:
    """Returns a row's episodes or worlds and their steps: "33,792 x 200"."""
    return "" if row is None else f"{row['batch']:,} x {row['steps']}"


def card(row: dict[str, Any] | None) -> str:
    """Returns the model of a row's GPU: "H200"."""
    return "" if row is None else row["device"].split()[1]


def tasks_of(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the tasks that rows have, in the order of the tables."""
    have = dict.fromkeys(row["task"] for row in rows)
    known = FEW + OTHERS
    return [task for task in (*known, *(x for x in have if x not in known)) if task in have]


def short(task: str) -> str:
    """Returns the name of a task for people: its class, or the folder and name of its model."""
    _, is_file, file = task.partition("xml_file=")
    if is_file:
        path = Path(file)
        robot = [part for part in path.parts[:-1] if part != "xmls"][-1:]
        return " ".join((*robot, path.stem))
    return task.rpartition(":")[2]


def origin(rows: list[dict[str, Any]]) -> str:
    """Returns where and when rows were measured, in a line."""

    def every(key: str) -> str:
        return listed(dict.fromkeys(row[key] for row in rows))

    cards = dict.fromkeys(row["device"] for row in rows if row["device"] != "cpu")
    commits = listed(dict.fromkeys(row["commit"][:8] or "not noted" for row in rows))
    days = listed(dict.fromkeys(row["date"][:10] for row in rows))
    line = f"{listed(cards or ['CPU alone'])}; {every('machine')}; JAX {every('jax')}; {days}"
    return f"{line}; commit {commits}."


def span(name: str, pairs: list[tuple[str, Any, Any]]) -> str:
    """Returns "1.5 (Ant) to 30 (Hopper) times ..." over tasks that have both rows."""
    found = [(speed(a) / speed(b), task) for task, a, b in pairs if a and b]
    if not found:
        return f"{name}: not measured"
    (low, slow), (high, fast) = min(found), max(found)
    words = [f"{times(x)} ({task.partition('-v')[0]})" for x, task in ((low, slow), (high, fast))]
    return f"{words[0]} to {words[1]} times {name}"


def readme(raw: Raw) -> str:
    """The line of README.md."""
    on_gpu, warp = (best(raw.gpu, FEW[2], engine) for engine in ("native", "MuJoCo Warp"))
    on_cpu, equal = (best(raw.cpu, FEW[2], "native", x) for x in ("float32", "float64"))
    other = best(raw.cpu, FEW[2], "C MuJoCo")
    return textwrap.fill(
        f"On one {card(on_gpu)}, HalfCheetah with an untrained policy runs {rate(on_gpu)} env "
        f"steps per second, {ratio(on_gpu, warp)} times as many as under random actions in MuJoCo "
        f"Warp. On two CPU cores, it runs {rate(on_cpu)}, {ratio(on_cpu, other)} times as many as "
        f"in C MuJoCo ({ratio(equal, other)} in float64).",
        110,
    )


def words(raw: Raw) -> str:
    """How many times as fast as others, in a sentence."""
    warp, equal, single = [], [], []
    for task in FEW:
        gpu, other = best(raw.gpu, task, "native"), best(raw.gpu, task, "MuJoCo Warp")
        cpu, double = (best(raw.cpu, task, "native", x) for x in ("float32", "float64"))
        c_mujoco = best(raw.cpu, task, "C MuJoCo")
        warp.append((task, gpu, other))
        single.append((task, cpu, c_mujoco))
        equal.append((task, double, c_mujoco))
    return textwrap.fill(
        f"On two cores, `native` plays the first six tasks {span('as fast as C MuJoCo', equal)} in"
        f" float64, and {span('as fast', single)} in float32, which training uses. On the GPU, it"
        f" plays them {span('as fast as MuJoCo Warp', warp)}.",
        110,
    )


def gpu(raw: Raw) -> str:
    """All tasks on a GPU."""
    rows = []
    for task in tasks_of(raw.gpu):
        native, warp, plain = (
            best(raw.gpu, task, engine) for engine in ("native", "MuJoCo Warp", "plain MJX")
        )
        cells = (short(task), card(native), rate(native), at(native), rate(warp), rate(plain))
        rows.append((*cells, ratio(native, warp)))
    header = ("task", "on", "native", "episodes x steps", "MuJoCo Warp", "plain MJX")
    return f"{origin(raw.gpu)}\n\n{table((*header, 'native / Warp'), rows)}"


def trained(raw: Raw) -> str:
    """Tasks on a GPU that a trained policy plays, too."""
    rows = []
    for task in tasks_of(raw.gpu):
        policy = best(raw.gpu, task, "native", trained=True)
        if policy is not None:
            native, warp = (best(raw.gpu, task, engine) for engine in ("native", "MuJoCo Warp"))
            cells = (short(task), rate(native), rate(policy), rate(warp), at(warp))
            rows.append((*cells, ratio(native, warp), ratio(policy, warp)))
    header = ("task", "untrained", "trained", "MuJoCo Warp", "worlds x steps")
    return table((*header, "untrained / Warp", "trained / Warp"), rows)


def latency(raw: Raw) -> str:
    """How long an env step of few episodes takes on a GPU (ms)."""

    def milliseconds(row: dict[str, Any] | None) -> str:
        """Returns how long an env step of all its episodes takes."""
        return "" if row is None else f"{1e3 * row['batch'] / speed(row):.3g}"

    rows = []
    for task in tasks_of(raw.gpu):
        for batch in SMALL:
            native, warp = (
                best(raw.gpu, task, engine, batch=batch) for engine in ("native", "MuJoCo Warp")
            )
            if native is not None:
                cells = (milliseconds(native), milliseconds(warp), ratio(native, warp))
                rows.append((short(task), str(batch), *cells))
    return table(("task", "episodes", "native, ms", "MuJoCo Warp, ms", "Warp / native"), rows)


def cpu(raw: Raw) -> str:
    """All tasks on two cores of a CPU."""
    rows = []
    for task in tasks_of(raw.cpu):
        single, double = (best(raw.cpu, task, "native", x) for x in ("float32", "float64"))
        c_mujoco, gymnasium = (best(raw.cpu, task, x) for x in ("C MuJoCo", "Gymnasium"))
        cells = (at(single), rate(single), rate(double), rate(c_mujoco))
        ratios = (ratio(double, c_mujoco), ratio(single, c_mujoco))
        rows.append((short(task), *cells, *ratios, rate(gymnasium)))
    header = (
        *("task", "episodes x steps", "native, float32", "native, float64", "C MuJoCo, float64"),
        *("float64 / C", "float32 / C", "Gymnasium"),
    )
    return f"{origin(raw.cpu)}\n\n{table(header, rows)}"


def envpool(raw: Raw) -> str:
    """Tasks that EnvPool has, too."""
    rows = []
    for task in tasks_of(raw.envpool):
        single, double = (best(raw.envpool, task, "native", x) for x in ("float32", "float64"))
        c_mujoco, pool = (best(raw.envpool, task, x) for x in ("C MuJoCo", "EnvPool"))
        cells = (rate(single), rate(double), rate(c_mujoco), rate(pool))
        rows.append((short(task), *cells, ratio(double, pool), ratio(single, pool)))
    header = ("task", "native, float32", "native, float64", "C MuJoCo", "EnvPool")
    shown = table((*header, "float64 / EnvPool", "float32 / EnvPool"), rows)
    return f"{origin(raw.envpool)}\n\n{shown}"


TABLES: dict[str, Callable[[Raw], str]] = {
    "speed": readme,
    "speed in words": words,
    "speed on a GPU": gpu,
    "speed with trained policies": trained,
    "milliseconds": latency,
    "speed on two cores": cpu,
    "speed beside EnvPool": envpool,
}


def page(text: str, raw: Raw) -> str:
    """Returns a page with its tables made again."""
    return filled(text, {name: functools.partial(make, raw) for name, make in TABLES.items()})


def main() -> None:
    """Writes."""
    raw = last_calls(read(RAW))
    for path in PAGES:
        path.write_text(page(path.read_text(encoding="utf-8"), raw), encoding="utf-8")


if __name__ == "__main__":
    main()

"""docs/robots.csv, a row for each model, and the tables of docs/robots.md."""

import collections
import os.path
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from experiments.checks.robots import gpu
from experiments.checks.robots.playing import EQUAL
from experiments.kit import rows
from experiments.kit.markdown import filled, table
from experiments.kit.places import ROOT

CSV = ROOT / "docs" / "robots.csv"
GPU_CSV = ROOT / "docs" / "robots_gpu.csv"
CPU_CSV = ROOT / "docs" / "robots_cpu.csv"
PAGE = ROOT / "docs" / "robots.md"
#: Columns of docs/robots.csv.
COLUMNS = ("package", "model", "engine", "why", "verdict", "error", "cause", "in_c_mujoco")
COLUMNS += ("steps_per_s", "ratio")
#: Columns of docs/robots_cpu.csv: of the rows of ``speed``.
_CPU_COLUMNS = ("package", "model", "stubs", "engine", "why", "verdict", "cause", "steps_per_s")
_CPU_COLUMNS += ("ratio", "ratio_by_clock")
#: Verdicts of files that are no robot for a policy, and what the page says of them.
_NOT_PLAYED = {
    "no model": "C MuJoCo does not load them: parts of other files, or files that are missing",
    "same mechanism": "the same mechanism as another file",
    "no actuators": "without actuators, which a policy needs",
}
_VERDICTS = {
    "equal": f"equal to C MuJoCo to {EQUAL:.0e}".replace("e-0", "e-"),
    "optimum": "equal to the optimum, before which C MuJoCo stops",
    "chaos": "as far from C MuJoCo as C MuJoCo is from itself after a start 1e-12 apart",
    "differing": "differ otherwise",
    "refused": "refused in words",
    "crashed": "end in an error",
    "too long": "take too long",
    "not judged": "not judged",
}
#: The longest texts of docs/robots.csv.
_MAX_WHY = 60
_MAX_CAUSE = 80


def merged(raw_rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns a row for each model: of ``auto``'s engine, the engine ``mujoco``, and the speed."""
    models: dict[tuple[str, str], dict[str, Any]] = collections.defaultdict(dict)
    for row in raw_rows:
        models[row["package"], row["model"]] |= {
            kind: row
            for kind in ("speed", "auto", "mujoco")
            if kind == row["phase"] or (row["phase"] == "equality" and kind in _engines(row))
        }
    return [_merged(each) for _, each in sorted(models.items())]


def _engines(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Returns for which engines that may be asked for a row of equality holds."""
    if row["auto"] == "mujoco" or row["verdict"] in _NOT_PLAYED:
        return "auto", "mujoco"
    return (row["asked"],)


def _merged(each: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the row of docs/robots.csv of the rows of a model."""
    judged = [each[name] for name in ("auto", "mujoco") if name in each]
    row = dict.fromkeys(COLUMNS, "") | {name: judged[0][name] for name in ("package", "model")}
    row["verdict"] = "not judged"
    if "auto" in each:
        row |= {name: each["auto"][name] for name in ("engine", "why", "verdict", "error", "cause")}
    if row["verdict"] in _NOT_PLAYED:
        return row | {"cause": ""}
    if "mujoco" in each:
        in_c = each["mujoco"]
        row["in_c_mujoco"] = in_c["error"] if in_c["verdict"] == "equal" else in_c["verdict"]
    speed = each.get("speed", {})
    if speed.get("verdict") == "measured":
        row |= {name: speed[name] for name in ("engine", "steps_per_s", "ratio")}
    elif speed:  # why it is not measured
        row["steps_per_s"] = f"{speed['verdict']}: {speed['cause']}"
    row["why"] = _short(row["why"].rpartition(" cores: ")[2], _MAX_WHY)
    causes = [text for text in (row["cause"], judged[0]["stubs"]) if text]
    row["cause"] = _short("; ".join(causes), _MAX_CAUSE)
    return row


def _short(text: str, size: int) -> str:
    """Returns the beginning of a text, up to the end of a word."""
    if len(text) <= size:
        return text
    return text[:size].rpartition(" ")[0] + " ..."


def totals(models: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of how many files there are of each kind."""
    counts = collections.Counter(row["verdict"] for row in models)
    num_robots = len(models) - sum(counts[kind] for kind in _NOT_PLAYED)
    lines = [["files", str(len(models))]]
    lines += [[words, str(counts[kind])] for kind, words in _NOT_PLAYED.items()]
    lines += [["**robots: all others**", f"**{num_robots}**"]]
    return table(["", "count"], lines)


def equality(models: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of how many robots are as C MuJoCo has them, by engine."""
    played = [row for row in models if row["verdict"] not in _NOT_PLAYED]
    in_c = collections.Counter(
        row["in_c_mujoco"] if row["in_c_mujoco"] in _VERDICTS else "equal" for row in played
    )
    kinds = [(row["engine"] == "mujoco", row["verdict"]) for row in played]
    counts = collections.Counter(kinds)
    lines = []
    for kind, words in _VERDICTS.items():
        numbers = (in_c[kind], counts[True, kind], counts[False, kind])
        if any(numbers):
            lines.append([words, *map(str, numbers)])
    header = ["", "`--engine mujoco`", "`auto` takes `mujoco`", "`auto` takes another"]
    return table(header, lines)


def engines(models: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of the engines that ``auto`` takes, and how fast they are."""
    groups = collections.defaultdict(list)
    for row in models:
        if row["engine"] and row["ratio"]:
            groups[row["engine"]].append(float(row["ratio"]))
    lines = []
    for name, ratios in sorted(groups.items()):
        low, *_, high = statistics.quantiles(ratios, n=10) if len(ratios) > 1 else ratios * 2
        numbers = (statistics.median(ratios), low, high)
        lines.append([f"`{name}`", str(len(ratios)), *(f"{number:.2f}" for number in numbers)])
    header = ["engine", "robots", "median ratio", "a tenth are below", "a tenth are above"]
    return table(header, lines)


def robots(models: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of the robots of each package."""
    groups = collections.defaultdict(list)
    for row in models:
        if row["verdict"] not in _NOT_PLAYED:
            groups[row["package"]].append(row)
    return "\n\n".join(text for package, each in groups.items() for text in _package(package, each))


def _package(package: str, models: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yields the heading and the table of a package."""
    folder = os.path.commonpath([os.path.dirname(row["model"]) for row in models])
    yield f"### {package}"
    lines = []
    for row in models:
        equal = row["error"] or row["verdict"]
        if row["verdict"] != "equal" or row["cause"]:
            equal = ", ".join(row[name] for name in ("verdict", "error", "cause") if row[name])
        speed = row["steps_per_s"]
        if row["ratio"]:
            speed = f"{int(speed):,}"
        name = os.path.relpath(row["model"], folder or ".")
        cells = (name, row["engine"], row["why"], equal, speed, row["ratio"])
        lines.append([cell.replace("|", "/").replace("<", "&lt;") for cell in cells])
    yield table(["model", "engine", "why", "from C MuJoCo", "env steps/s", "ratio"], lines)


def cpu_robots(timed: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table of robots that were timed with a C++ compiler, by their ratio."""
    lines = []
    for row in sorted(timed, key=lambda row: float(row["ratio"] or "inf")):
        speed = f"{row['verdict']}: {row['cause']}"
        if row["ratio"]:
            speed = f"{int(row['steps_per_s']):,}"
        name = row["model"] + (f" ({row['stubs']})" if row["stubs"] else "")
        lines.append([name, _compiler(row), speed, row["ratio"], row["ratio_by_clock"]])
    ratios = ("ratio by seconds of the CPU", "ratio by the clock")
    return table(["model", "machine code by", "env steps/s", *ratios], lines)


def _compiler(row: Mapping[str, Any]) -> str:
    """Returns what made the machine code that played a robot."""
    if "C++" in row["why"]:
        return "C++"
    names = {"native": "LLVM", "mujoco": "C MuJoCo's own", "vmap": "XLA"}
    return names.get(row["engine"], "")


def page(text: str, models: Sequence[Mapping[str, Any]]) -> str:
    """Returns docs/robots.md with the tables of these models."""
    makers = {"totals": totals, "equality": equality, "engines": engines, "robots": robots}
    tables = {name: lambda maker=maker: maker(models) for name, maker in makers.items()}
    of_gpu, of_cpu = map(rows.read, (GPU_CSV, CPU_CSV))
    tables |= {"cpu_robots": lambda: cpu_robots(of_cpu)}
    tables |= {"gpu": lambda: gpu.summary(of_gpu), "gpu_robots": lambda: gpu.robots(of_gpu)}
    tables["gpu_speeds"] = lambda: gpu.speeds(of_gpu)
    return filled(text, tables)


def write(raw_rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes docs/robots.csv and the tables of docs/robots.md."""
    rows.write(CSV, merged(raw_rows))
    fill()


def write_cpu(raw_rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes docs/robots_cpu.csv, of rows of ``speed`` in their order, and its table."""
    rows.write(CPU_CSV, [{name: row[name] for name in _CPU_COLUMNS} for row in raw_rows])
    fill()


def fill() -> None:
    """Writes the tables of docs/robots.md anew, from the rows beside it."""
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page(text, rows.read(CSV)), encoding="utf-8")

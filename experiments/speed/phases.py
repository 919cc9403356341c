"""What the lanes of a GPU do while teams play: the cycles of each phase of a step.

    ROBOT="experiments.checks.robots.gpu:Robot xml_file=menagerie/unitree_go2/scene.xml"
    python -m experiments.speed.phases "$ROBOT" --batch 33792 --steps 25 --groups 2 4 6

A task is played by its kernel as it is, with each number of groups and of warps in turn, and by one
that counts cycles and events (``phases.h``), whose places are found in the text of the device code.
Such a kernel is slower; its shares of cycles are what counts. Each kernel has a process of its own.
All compile at once, and play one by one.
"""

import concurrent.futures
import ctypes
import dataclasses
import fcntl
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro

from experiments.kit.markdown import percent, table
from experiments.speed.benchmark import ours, rows
from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import cubin, nvrtc, seam
from mjx_reinforce.engine.play import teams

#: Counters of so many blocks, as many as a GPU has multiprocessors.
_BLOCKS = 160
#: Bytes of shared memory that ``phases.h`` needs.
_ROOM = 1_024
#: Geoms by the enum of ``device/rounds.h``.
_KINDS = ("plane", "round", "ellipsoid", "cylinder", "box", "mesh")
_PAIRS = [f"{first}-{second}" for first in _KINDS for second in _KINDS]
#: Phases, some of them by the kinds of the two geoms.
_OF_A_STEP = (
    *("task", "integration", "meeting", "kinematics", "dynamics"),
    *("bounding spheres", "boxes around geoms", "queue", "closed forms", "contacts"),
    *("convex, poses", "Newton, begin", "Newton, push", "Newton, add rows", "Newton, solve"),
    *("Newton, change along", "Newton, line search", "Newton, move", "Newton, end"),
)
_OF_A_PAIR = ("GJK", "EPA", "more contacts")
PHASES = [*_OF_A_STEP, *(f"{phase}, {pair}" for phase in _OF_A_PAIR for pair in _PAIRS)]
#: What is counted.
_EVENTS_OF_A_STEP = (
    *("physics steps", "near by spheres", "look at 32", "looked at", "contacts"),
    *("Newton steps", "lengths"),
)
_EVENTS_OF_A_PAIR = ("GJK", "GJK steps", "EPA", "EPA steps")
EVENTS = [
    *_EVENTS_OF_A_STEP,
    *(f"{event}, {pair}" for event in _EVENTS_OF_A_PAIR for pair in _PAIRS),
]
_PAIR = " + 6 * M.geom_kind[two.side[0].geom] + M.geom_kind[two.side[1].geom]"
#: What the device code has, some of it in both of Newton's methods -> what takes its place, which
#: is @ there: [phase] ends a phase, and {event: times} counts.
_EDITS = (
    ("place_fixed(t, M, s);\n  bool sound = true;", "[task] @"),
    (
        "  team.meet();\n  const Team t = team.anew();\n",
        "[integration] @ [meeting] {physics steps: lane0}",
    ),
    ("  actuate(t, M, s);\n  t.sync();", "[kinematics] @"),
    ("  collide(t, M, s);\n", "[dynamics] @ [queue]"),
    ("newton(t, M, s), lane = t.lane;", "@ [Newton, end] {Newton steps: lane0 * steps}"),
    ("add_to(near, t, is_near, item);", "@ [bounding spheres] {near by spheres: is_near}"),
    ("take_from(near, t);\n          t.sync();", "@ [boxes around geoms]"),
    ("  if (has_item) {\n", "[queue] {look at 32: lane0} {looked at: has_item} @"),
    ("  unsigned touching_lanes[MOST_TOUCHES];", "[closed forms] @"),
    ("num_contacts += count(touching_lanes[n]);", "@ [contacts]"),
    ("  if (lane == 0) s.num_contacts", "{contacts: lane0 * num_contacts} @"),
    ("  const int contacts = touch_solids(M, two, touch);", "[convex, poses] @ [more contacts|]"),
    ("approach(M, two, is_swollen ? real(0) : reach, s);", "@ [GJK|] {GJK|: 1}"),
    ("find_corner(M, two, direction, c);\n", "@ {GJK steps|: 1}"),
    ("  const Corner &u = p.corner[face.corner[0]]", "[EPA|] @"),
    ("  const real enough = two.have_corners ? SAME_DEPTH", "{EPA|: 1} @"),
    ("add_corner(M, two, p, deepest.nearest);", "@ {EPA steps|: 1}"),
    ("begin_step(t, M, s, search, damps);\n    if", "[Newton, begin] @"),
    ("load_rows(t, s, h);\n    if", "[Newton, push] @"),
    ("    find_direction(t, s, search, h);\n    if", "[Newton, add rows] @"),
    ("if (damps) break;\n", "[Newton, solve] @"),
    ("    // A whole step that changes no row", "[Newton, change along] @"),
    ("    move_along(t, s, search, length);\n    if", "[Newton, line search] @"),
    ("if (settled && NOSLIP) no_slip", "[Newton, move] @"),
    ("    sum = bend_at(t, M, s, search, length);\n  }", "{lengths: lane0} @"),
    ("  bool running = false, asks = true;\n", "@ phase_begin();"),
    ("if (!t.meet(running)) break;", "[task] @ [meeting]"),
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Count the cycles of the phases of a step of teams on a GPU."""

    tasks: tyro.conf.Positional[tuple[str, ...]]
    """Tasks of ``experiments.speed.benchmark``, in one word each."""
    batch: int = 33_792
    """Episodes."""
    steps: int = 25
    """Of an episode."""
    repeats: int = 3
    """Timed runs of a kernel, after one that warms up."""
    groups: tuple[int, ...] = (2,)
    """Groups of warps that meet (GROUPS of device/block.h)."""
    warps: tuple[int, ...] = (0,)
    """Warps of a block; 0 are the kernel's own number."""
    at_once: int = 8
    """Processes that compile at once."""
    worker: str = ""
    """The kernel of this process, as JSON."""


def _counter(found: re.Match[str]) -> str:
    """Returns C++ that ends a phase or counts an event; a name with | is one for each pair."""
    phase, event, times = found.groups()
    names = PHASES if phase else EVENTS
    name = phase or event
    by_pairs = name.endswith("|")
    number = str(names.index(f"{name[:-1]}, {_PAIRS[0]}" if by_pairs else name)) + _PAIR * by_pairs
    if phase:
        return f"phase_end({number});"
    times = times.replace("lane0", "int(t.lane == 0)")
    return f"if ({times}) phase_event({number}, {times});"


def counting(text: str) -> str:
    """Returns the text of a kernel that plays, with counters.

    Raises:
      ValueError: the text does not have a place, as the device code has changed.
    """
    for place, template in _EDITS:
        if place not in text:
            raise ValueError(f"the device code does not have {place!r} any more: mend _EDITS")
        edited = re.sub(r"\[(.+?)\]|\{(.+?): (.+?)\}", _counter, template)
        text = text.replace(place, edited.replace("@", place))
    header = Path(__file__).with_suffix(".h").read_text("utf-8")
    sizes = f"#define PHASES {len(PHASES)}\n#define EVENTS {len(EVENTS)}\n"
    ends = "__device__ unsigned long long phase_sizes[] = {TEAMS, sizeof(State), sizeof(Fixed)};"
    return f"{sizes}#define PHASE_BLOCKS {_BLOCKS}\n{header}{text}\n{ends}\n"


class _Driver:
    """NVIDIA's driver, which remembers the library that it loaded last."""

    def __init__(self, cuda: Any):
        self.cuda = cuda
        self.library = ctypes.c_void_p()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.cuda, name)

    def cuLibraryLoadData(self, library: Any, *arguments: Any) -> int:  # noqa: N802
        status = self.cuda.cuLibraryLoadData(library, *arguments)
        self.library = library._obj
        return status

    def counters(self, name: str) -> ctypes.Array[ctypes.c_ulonglong]:
        """Returns an array of the kernel, and makes it zero."""
        place = ctypes.c_void_p()
        size = ctypes.c_size_t()
        asked = ctypes.byref(place), ctypes.byref(size), self.library, name.encode()
        if status := self.cuda.cuLibraryGetGlobal(*asked):
            raise RuntimeError(f"cuLibraryGetGlobal returned {status}")
        numbers = (ctypes.c_ulonglong * (size.value // 8))()
        if status := self.cuda.cuMemcpyDtoH_v2(numbers, place, size):
            raise RuntimeError(f"cuMemcpyDtoH returned {status}")
        self.cuda.cuMemsetD8_v2(place, 0, size)
        return numbers

    def enter(self) -> None:
        """Makes XLA's context that of this thread."""
        context = ctypes.c_void_p()
        self.cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0)
        self.cuda.cuCtxSetCurrent(context)


class _Compiler:
    """Takes the places of NVRTC and of the driver in ``cubin``: it edits the kernel that plays.

    log: what NVRTC said of it
    driver: what has it, once ``is_ready``
    """

    def __init__(self, groups: int, counts: bool):
        self.groups = groups
        self.counts = counts
        self.log = ""
        self.driver = _Driver(None)
        self.is_ready = threading.Event()
        self._image = b""
        self._compile = nvrtc.compile
        self._in_memory = cubin._in_memory

    def compile(self, capability: str, text: str) -> tuple[str, bytes]:
        """Compiles a kernel."""
        if "t.next(next)" not in text:
            return self._compile(capability, text)
        text = text.replace("GROUPS = 2,", f"GROUPS = {self.groups},")
        text = counting(text) if self.counts else text
        self.log, self._image = self._compile(capability, text)
        return self.log, self._image

    def in_memory(self, cuda: Any, image: bytes, num_bytes: int) -> ctypes.c_void_p:
        """Loads a kernel."""
        driver = _Driver(cuda)
        handle = self._in_memory(cast("ctypes.CDLL", driver), image, num_bytes)
        if image == self._image:
            self.driver = driver
            self.is_ready.set()
        return handle


def work(settings: Settings, kernel: Mapping[str, Any]) -> dict[str, Any]:
    """Plays by one kernel, once no other process plays; returns what was measured.

    Args:
      settings: of the call.
      kernel: task, groups, warps, whether it counts, and the file that is locked while it plays.

    Raises:
      RuntimeError: teams do not play the task, or the kernel is not compiled in ten minutes.
    """
    compiler = _Compiler(kernel["groups"], kernel["counts"])
    nvrtc.compile = compiler.compile
    cubin._in_memory = compiler.in_memory
    objects.folder = lambda: None  # kernels of other texts have these keys there
    if kernel["warps"]:
        teams.FEW_WARPS = teams.MANY_WARPS = kernel["warps"]
    if kernel["counts"]:
        whole = teams._shared_memory()
        teams._shared_memory = lambda: whole - _ROOM
    candidate = ours.rollout_of(kernel["task"], "native", settings.steps)(settings.batch)
    if not compiler.is_ready.wait(600):
        raise RuntimeError(f"no team plays {kernel['task']}: {candidate.row['settings']}")
    result: dict[str, Any] = {
        "log": " ".join(re.findall(r"\d+ bytes \w+ \w+|Used.*", compiler.log))
    }
    with open(kernel["lock"], "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        candidate.run()
        if not kernel["counts"]:
            (row,) = rows.measure([candidate], settings.repeats)
            return result | {"env_steps_per_second": rows.speed(row)}
        driver = compiler.driver
        driver.enter()
        driver.counters("phase_cycles")
        driver.counters("phase_events")
        candidate.run()
        for name, names in (("cycles", PHASES), ("events", EVENTS)):
            sums = np.reshape(driver.counters(f"phase_{name}"), (_BLOCKS, -1)).sum(0)
            result[name] = dict(zip(names, sums.tolist(), strict=True))
        result["sizes"] = list(driver.counters("phase_sizes"))
    return result


def _started(settings: Settings, kernel: Mapping[str, Any]) -> dict[str, Any]:
    """Measures a kernel in a process of its own; returns its error where it fails."""
    command = [sys.executable, "-m", "experiments.speed.phases", *settings.tasks]
    for name in ("batch", "steps", "repeats"):
        command += [f"--{name}", str(getattr(settings, name))]
    command += ["--worker", json.dumps(kernel)]
    environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        return {"error": done.stderr[-1500:]}
    return json.loads(done.stdout.splitlines()[-1])


def report(cycles: Mapping[str, int], events: Mapping[str, int]) -> str:
    """Returns what was counted, as Markdown: shares of cycles, and events a physics step."""
    all_cycles = sum(cycles.values())
    steps = max(1, events["physics steps"])
    sums = {
        f"{phase}, all": sum(n for name, n in cycles.items() if name.startswith(f"{phase}, "))
        for phase in _OF_A_PAIR
    }
    counted = [(name, n) for name, n in {**cycles, **sums}.items() if n > 0.0005 * all_cycles]
    counted.sort(key=lambda item: -item[1])
    lines = [[name, percent(n / all_cycles, 1), f"{n / steps:,.0f}"] for name, n in counted]
    shares = table(["phase", "share of cycles", "cycles a physics step"], lines)
    counts = [[name, f"{n / steps:.4f}"] for name, n in events.items() if n]
    return f"{shares}\n\n{table(['event', 'a physics step'], counts)}"


def main() -> None:
    """Prints what is measured, of each kernel as soon as it is."""
    settings = tyro.cli(Settings, prog="python -m experiments.speed.phases", description=__doc__)
    if reason := seam.kernels_unavailable():
        sys.exit(f"no kernel runs here: {reason}")
    if settings.worker:
        print(json.dumps(work(settings, json.loads(settings.worker))))
        return
    began = time.monotonic()
    choices = [
        {"groups": g, "warps": w, "counts": False} for g in settings.groups for w in settings.warps
    ]
    choices.insert(0, {"groups": settings.groups[0], "warps": settings.warps[0], "counts": True})
    with (
        tempfile.NamedTemporaryFile() as lock,
        concurrent.futures.ThreadPoolExecutor(settings.at_once) as pool,
    ):
        kernels = [{"task": t, "lock": lock.name, **c} for t in settings.tasks for c in choices]
        futures = {pool.submit(_started, settings, kernel): kernel for kernel in kernels}
        for future in concurrent.futures.as_completed(futures):
            kernel = futures[future]
            result = future.result()
            named = ", ".join(f"{name} {kernel[name]}" for name in ("groups", "warps"))
            print(f"\n{kernel['task']}: {named}; after {time.monotonic() - began:.0f} s")
            print(result.get("error") or result["log"])
            if "cycles" in result:
                print("teams of a block, bytes of a state, of the model:", *result["sizes"])
                print(report(result["cycles"], result["events"]))
            elif "error" not in result:
                print(f"{result['env_steps_per_second']:,.0f} env steps/s")
            sys.stdout.flush()


if __name__ == "__main__":
    main()

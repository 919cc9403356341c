"""How much faster is a sweep on two GPUs than on one? Prints a table of wall times.

``python -m experiments.speed.sweep_scaling --devices 1 2`` trains 1,024 seeds of 16 configurations
of InvertedPendulum on the first GPU, then on the first two, each in a process of its own with
nothing compiled before. Scaling is the time of training on one device, over that on D times D.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

OVER = ["--over", "learning-rate", "3e-3", "1e-2", "2e-2", "3e-2"]
OVER += ["--over", "discount", "0.97", "0.98", "0.99", "0.995"]


def measure(devices: int, arguments: list[str], folder: Path) -> dict[str, Any]:
    """Returns the times of a sweep on so many devices (s), from its own account and our clock."""
    output = folder / f"{devices}-devices"
    visible = ",".join(map(str, range(devices)))
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = os.environ | {
        "CUDA_VISIBLE_DEVICES": visible,
        "XLA_FLAGS": flags.strip(),  # where there are no GPUs
        "XDG_CACHE_HOME": str(folder / f"cache-{devices}"),
    }
    command = [sys.executable, "-m", "mjx_reinforce.sweep", *OVER, *arguments]
    began = time.monotonic()
    subprocess.run([*command, "--output", str(output)], check=True, env=environment)
    wall = time.monotonic() - began
    return json.loads((output / "sweep.json").read_text()) | {"wall_seconds": wall}


def main() -> None:
    """Measures, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--num-seeds", default="1024")
    settings, others = parser.parse_known_args()  # any other flag is the sweep's
    arguments = ["--num-seeds", settings.num_seeds, *others]
    with tempfile.TemporaryDirectory(prefix="scaling-") as folder:
        times = {n: measure(n, arguments, Path(folder)) for n in settings.devices}
    columns = ("compile_seconds", "run_seconds", "statistics_seconds", "wall_seconds")
    first = times[settings.devices[0]]
    print("| devices | compiling (s) | training (s) | statistics (s) | wall (s) | scaling |")
    print("|---|---|---|---|---|---|")
    for count, row in times.items():
        cells = ["" if row[name] is None else f"{row[name]:.2f}" for name in columns]
        speedup = first["run_seconds"] / row["run_seconds"]
        scaling = speedup * settings.devices[0] / count
        print(f"| {count} | {' | '.join(cells)} | {100 * scaling:.1f} % |")
    print(f"on {first['device']}, {len(first['configurations'])} configurations", end=" ")
    print(f"of {first['num_seeds']:,} seeds")


if __name__ == "__main__":
    main()

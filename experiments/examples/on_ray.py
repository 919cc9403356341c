"""Shares of a run as Ray tasks, one for each GPU of a cluster, and one report of all seeds.

``pip install -e ".[ray]"``, then ``python experiments/examples/on_ray.py DIR --num-seeds
1024 --share 128 --gpus 1 --env Hopper-v5``; other flags are those of ``python -m
mjx_reinforce.train``. All machines must see DIR. A share that was interrupted goes on: start the
same command again.
"""

import argparse
import subprocess
import sys
from pathlib import Path

try:
    import ray  # pyright: ignore[reportMissingImports]  # not among the dependencies
except ImportError as error:
    raise SystemExit(f"error: this needs Ray ({error}): pip install ray") from error


def train(place: Path, seeds: str, flags: list[str]) -> None:
    """Trains a share in a process of its own, on the GPUs that Ray gives it."""
    begun = ["--resume", str(place)] if (place / "config.json").exists() else None
    command = begun or ["--seeds", seeds, "--output", str(place), *flags]
    subprocess.run([sys.executable, "-m", "mjx_reinforce.train", *command], check=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=lambda text: Path(text).absolute())
    parser.add_argument("--num-seeds", type=int, required=True)
    parser.add_argument("--share", type=int, required=True, help="seeds of a task")
    parser.add_argument("--gpus", type=float, default=0, help="of a task")
    parser.add_argument("--cpus", type=float, default=1, help="of a task")
    given, flags = parser.parse_known_args()
    task = ray.remote(num_cpus=given.cpus, num_gpus=given.gpus)(train)
    firsts = range(0, given.num_seeds, given.share)
    seeds = [f"{i}:{min(i + given.share, given.num_seeds)}" for i in firsts]
    places = [given.directory / each.replace(":", "-") for each in seeds]
    ray.get([task.remote(*share, flags) for share in zip(places, seeds, strict=True)])
    report = ["--output", str(given.directory / "report.html"), "--overwrite"]
    command = [sys.executable, "-m", "mjx_reinforce.report", *map(str, places), *report]
    subprocess.run(command, check=True)

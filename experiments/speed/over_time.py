r"""Measures the speed of a task, appends a row to docs/speed.jsonl and draws docs/speed.png.

python -m experiments.speed.over_time --env HalfCheetah-v5
python -m experiments.speed.over_time --no-measure    # draws alone
"""

import dataclasses
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import tyro

from experiments.kit.pictures import save_picture
from experiments.kit.places import DOCS, ROOT
from mjx_reinforce import envs, mlp_policy, normal, rollout
from mjx_reinforce.console.jax_setup import configure_jax


@dataclasses.dataclass(frozen=True)
class Settings:
    """Measures the speed of a task, and draws all that was measured."""

    env: str = "HalfCheetah-v5"
    """The task; its actions are continuous."""
    engine: str = "auto"
    """What plays."""
    num_episodes: int = 512
    """Episodes that are played at once."""
    horizon: int = 100
    """Their time limit in env steps."""
    repetitions: int = 5
    """Calls that are timed; their median counts."""
    measure: bool = True
    """Whether to measure, before drawing."""


def engine_speed(settings: Settings) -> tuple[float, float]:
    """Returns env steps a second, and the seconds until the first call had returned."""
    env = envs.make(settings.env)
    family = normal(env.action_space)
    policy = mlp_policy(env.observation_size, family, (16, 32))
    params = policy.init(jax.random.key(0))

    @jax.jit
    def play(key):
        return rollout(
            env,
            policy.apply,
            params,
            family,
            key,
            num_episodes=settings.num_episodes,
            horizon=settings.horizon,
            engine=settings.engine,
        ).mask.sum()

    begin = time.perf_counter()
    play(jax.random.key(1)).block_until_ready()
    compiling = time.perf_counter() - begin
    speeds = []
    for key in jax.random.split(jax.random.key(2), settings.repetitions):
        begin = time.perf_counter()
        steps = int(play(key))
        speeds.append(steps / (time.perf_counter() - begin))
    return sorted(speeds)[len(speeds) // 2], compiling


def seconds_of(*arguments: str) -> float:
    """Returns how long a new Python takes."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin


def commit() -> str:
    """Returns the commit of the package, and whether its files have changed since."""
    git = ("git", "-C", str(ROOT))
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], stdout=subprocess.PIPE, text=True)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "mjx_reinforce", "envs"])
    return head.stdout.strip() + "-dirty" * (changed.returncode != 0)


def measure(settings: Settings) -> dict[str, object]:
    """Returns a row of docs/speed.jsonl."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # nothing is compiled beforehand
        configure_jax()
        speed, compiling = engine_speed(settings)
        importing = seconds_of("-c", "import mjx_reinforce, mjx_reinforce.train")
        train = ("-m", "mjx_reinforce.train", "--env", settings.env, "--env-steps", "2000")
        os.environ["XDG_CACHE_HOME"] = f"{folder}/another"
        first = seconds_of(*train, "--eval-episodes", "2", "--output", f"{folder}/run")
    device, cores = jax.devices()[0].device_kind, len(os.sched_getaffinity(0))
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": f"{device}, {platform.machine()}, {cores} cores",
        "load": round(os.getloadavg()[0], 1),
        "commit": commit(),
        "jax": jax.__version__,
        "engine": settings.engine,
        "env": settings.env,
        "env_steps_per_second": round(speed),
        "compile_seconds": round(compiling, 2),
        "import_seconds": round(importing, 2),
        "first_result_seconds": round(first, 2),
    }


def draw(rows: list[dict], path: Path) -> None:
    """Draws env steps a second and the seconds of a first result, a line for a task and machine."""
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    lines = sorted({(row["env"], row["engine"], row["machine"]) for row in rows})
    for key in lines:
        ours = [row for row in rows if (row["env"], row["engine"], row["machine"]) == key]
        for ax, name in zip(axes, ("env_steps_per_second", "first_result_seconds"), strict=True):
            ax.plot(
                [row["commit"] for row in ours],
                [row[name] for row in ours],
                "o-",
                label=", ".join(key),
            )
    for ax, label in zip(axes, ("env steps a second", "first result (s)"), strict=True):
        ax.set_ylabel(label)
        ax.tick_params(axis="x", rotation=30)
    axes[0].set_yscale("log")
    axes[1].set_ylim(bottom=0)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", fontsize="small")
    save_picture(fig, path, dpi=90)


def main(settings: Settings, docs: Path = DOCS) -> None:
    """Appends a row, if asked for, and draws all."""
    file = docs / "speed.jsonl"
    if settings.measure:
        row = measure(settings)
        print(json.dumps(row, indent=1))
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(row) + "\n")
    draw([json.loads(line) for line in file.read_text("utf-8").splitlines()], docs / "speed.png")


if __name__ == "__main__":
    main(tyro.cli(Settings))

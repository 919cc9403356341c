"""Models that others ship, as they are: what plays them, how fast, how far from C MuJoCo.

The 39 models of dm_control's suite, MuJoCo Playground's, brax, Gymnasium and MJX, each in a process
of its own with a time limit. The packages need not be installed:

    pip install --no-deps --target SITE dm_control playground brax gymnasium
    python -m experiments.studies.shipped_models --site SITE

writes docs/shipped_models.csv and docs/shipped_models.md.
"""

import dataclasses
import datetime
import importlib.metadata
import json
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import tyro

from experiments.kit import rows as kit
from experiments.kit.places import DOCS

SUITE, PLAYGROUND = "dm_control/suite", "mujoco_playground/_src"
_DM_CONTROL = (
    *("acrobot", "ball_in_cup", "cartpole", "cheetah", "dog", "finger", "fish", "hopper"),
    *("humanoid", "humanoid_CMU", "lqr", "manipulator", "pendulum", "point_mass", "quadruped"),
    *("reacher", "stacker", "swimmer", "walker"),
)
_PLAYGROUND = (
    *("acrobot", "ball_in_cup", "cartpole", "cheetah", "finger", "fish", "hopper", "humanoid"),
    *("manipulator", "pendulum", "point_mass", "reacher", "swimmer", "walker"),
)
#: Name -> file below SITE, or below the folder of mujoco.mjx.
MODELS = {
    **{f"dm_control {name}": f"{SUITE}/{name}.xml" for name in _DM_CONTROL},
    **{
        f"Playground {name}": f"{PLAYGROUND}/dm_control_suite/xmls/{name}.xml"
        for name in _PLAYGROUND
    },
    "Playground go1": f"{PLAYGROUND}/locomotion/go1/xmls/scene_mjx_feetonly_flat_terrain.xml",
    "Playground op3": f"{PLAYGROUND}/locomotion/op3/xmls/scene_mjx_feetonly.xml",
    "Playground leap hand": f"{PLAYGROUND}/manipulation/leap_hand/xmls/scene_mjx_cube.xml",
    "brax ant": "brax/envs/assets/ant.xml",
    "Gymnasium swimmer": "gymnasium/envs/mujoco/assets/swimmer.xml",
    "MJX Shadow hand": "test_data/shadow_hand/scene_right.xml",
}
#: An env step lasts about so long (s).
_DURATION = 0.02
_EPISODES, _STEPS = 256, 20
_COLUMNS = (
    *("model", "contacts", "engine", "compile_seconds", "env_steps_per_second"),
    *("error_float64", "error_float32", "why"),
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Play the models that others ship."""

    site: Path
    """Where their packages are."""
    limit: float = 300
    """Seconds for a model in one precision."""
    only: tuple[str, ...] = ()
    """Models; by default all. The others keep their rows."""
    worker: bool = False
    """Play one model in this process and print what was found as JSON, line by line."""


def main(settings: Settings) -> None:
    """Plays the models and writes the table."""
    if settings.worker:
        play(MODELS[settings.only[0]], settings.site)
        return
    path = DOCS / "shipped_models.csv"
    rows = {}
    if settings.only and path.exists():
        rows = {row["model"]: row for row in kit.read(path)}
    for name in settings.only or MODELS:
        rows[name] = row_of(name, settings)
        print(rows[name], flush=True)
        in_order = [rows[model] for model in MODELS if model in rows]
        kit.write(path, in_order)
        path.with_suffix(".md").write_text(page(in_order, settings), encoding="utf-8")


def row_of(name: str, settings: Settings) -> dict[str, Any]:
    """Returns what a model's processes found, in single precision and then in double."""
    single = found(name, settings, "0")
    row = {"model": name, **single}
    if "error" in row:
        row["error_float32"] = f"{row.pop('error'):.1e}"
        double = found(name, settings, "1")
        row["error_float64"] = f"{double['error']:.1e}" if "error" in double else double["why"]
    return {column: row.get(column, "") for column in _COLUMNS}


def found(name: str, settings: Settings, double: str) -> dict[str, Any]:
    """Returns what one process found until its end or the time limit."""
    command = [sys.executable, "-W", "ignore", "-m", "experiments.studies.shipped_models"]
    command += ["--worker", "--only", name, "--site", str(settings.site)]
    environment = {**os.environ, "JAX_ENABLE_X64": double, "JAX_ENABLE_COMPILATION_CACHE": "0"}
    try:
        ended = subprocess.run(
            command, env=environment, capture_output=True, timeout=settings.limit, check=False
        )
        printed, problem = ended.stdout, ""
        if ended.returncode:
            problem = ended.stderr.decode().strip().splitlines()[-1]
    except subprocess.TimeoutExpired as error:
        printed, problem = error.stdout or b"", f"not done after {settings.limit:.0f} s"
    lines = [line for line in printed.decode().splitlines() if line.startswith("{")]
    facts = json.loads(lines[-1]) if lines else {}
    if problem:
        facts["why"] = "; ".join(filter(None, (facts.get("why"), problem)))
    return facts


def play(file: str, site: Path) -> None:
    """Plays a model and prints what is known of it, more and more, as lines of JSON."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    from mjx_reinforce import mlp_policy, normal, reinforce
    from mjx_reinforce.envs import models
    from mjx_reinforce.envs.base import MujocoEnv

    if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        as_shipped = models.load_model
        models.load_model = lambda file: _to_the_optimum(as_shipped(file))

    class Shipped(MujocoEnv):
        """A model from its first key frame or reference pose, with small noise, for no reward."""

        def initial(self, rng):
            model = self.mj_model
            pose = jnp.asarray(model.key_qpos[0] if model.nkey else model.qpos0)
            return pose + 0.01 * jax.random.normal(rng, pose.shape), jnp.zeros(model.nv)

        def outcome(self, before, data, action):
            return jnp.zeros(()), False, {}

    parent = Path(mjx.__file__).parent if file.startswith("test_data") else site
    options = {"xml_file": str(parent / file), "max_episode_steps": _STEPS}
    try:
        env = Shipped(**options, reward_threshold=None, frame_skip=1)
        skip = max(1, round(_DURATION / env.mj_model.opt.timestep))
        env = Shipped(**options, reward_threshold=None, frame_skip=skip)
        facts: dict[str, Any] = {"contacts": env.num_contacts}
        print(json.dumps(facts), flush=True)
        policy = mlp_policy(env.observation_size, normal(env.action_space), (16, 32))
        learner = reinforce(env, policy=policy, num_episodes=_EPISODES, horizon=_STEPS)
    except ValueError as error:
        print(json.dumps({"engine": "refused", "why": str(error).replace(f"{site}/", "")}))
        return
    facts |= {"engine": learner.engine.name, "why": learner.engine.why}
    print(json.dumps(facts), flush=True)
    state, roll = learner.init(jax.random.key(0)), jax.jit(learner.play)
    began = time.perf_counter()
    compiled = roll.lower(state, jax.random.key(1), True).compile()
    seconds = learner.engine.seconds + time.perf_counter() - began
    print(json.dumps(facts | {"compile_seconds": round(seconds, 1)}), flush=True)
    trajectory = compiled(state, jax.random.key(1), True)
    rates = []
    for key in (2, 3):
        began = time.perf_counter()
        steps = int(compiled(state, jax.random.key(key), True).mask.sum())
        rates.append(steps / (time.perf_counter() - began))
    facts["compile_seconds"] = round(seconds, 1)
    facts["env_steps_per_second"] = float(f"{max(rates):.2g}")
    facts["error"], more = error_of(env, trajectory)
    if more:
        facts["why"] += (
            f"; in {more} of {_EPISODES} episodes more contacts touch than its max_contact_points "
            "keeps, which is not compared"
        )
    print(json.dumps(facts))


def _to_the_optimum(model: Any) -> Any:
    """Returns a model whose solver goes on; models made for MJX stop it after a few iterations."""
    model.opt.iterations, model.opt.ls_iterations = 100, 50
    model.opt.tolerance = model.opt.ls_tolerance = 0
    return model


def error_of(env: Any, trajectory: Any) -> tuple[float, int]:
    """Returns the largest error after the first env step, relative where C's number is above 1.

    Also returns in how many episodes C MuJoCo has more contacts than the model asks MJX to keep.
    """
    import mujoco
    import numpy as np

    model: Any = env.mj_model
    starts, actions, ends = (
        np.asarray(x, float)
        for x in (trajectory.observation[0], trajectory.action[0], trajectory.observation[1])
    )
    largest, more = 0.0, 0
    for start, action, end in zip(starts, actions, ends, strict=True):
        data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
        data.qpos[:], data.qvel[:], data.ctrl[:] = start[: model.nq], start[model.nq :], action
        most = 0
        for _ in range(env.frame_skip):
            mujoco.mj_step(model, data)  # pyright: ignore[reportAttributeAccessIssue]
            most = max(most, data.ncon)
        if most > env.num_contacts:
            more += 1
            continue
        want = np.concatenate([data.qpos, data.qvel])
        largest = max(largest, float(np.max(np.abs(end - want) / np.maximum(np.abs(want), 1))))
    return largest, more


def page(rows: list[dict[str, Any]], settings: Settings) -> str:
    """Returns the table for people."""
    versions = ", ".join(
        f"{name} {importlib.metadata.version(name)}" for name in ("jax", "mujoco", "mujoco-mjx")
    )
    played = sum(row["engine"] == "native" for row in rows)
    text = (
        f"{len(rows)} of {len(MODELS)} models as their packages have them, {played} of these in "
        "machine code. "
        f"`python -m experiments.studies.shipped_models` made this on {datetime.date.today()} with "
        f"{versions}, on {os.cpu_count()} CPU cores on which other programs ran: times and speeds "
        "are rough. "
        "An env step is about 0.02 s of physics steps, from the first key frame or the "
        "reference pose with small noise, under an untrained 16-32 policy. The error is the largest"
        f" of qpos and qvel after one env step of {_EPISODES} episodes against C MuJoCo in double "
        "precision, relative where a number is greater than one: in float32 with the solver's "
        "options in the model, in float64 with solvers that go on to the optimum (models made for "
        "MJX stop them after a few iterations, C's and ours at different points). Episodes in "
        "which more contacts touch than max_contact_points keeps are not compared. A process had "
        f"{settings.limit:.0f} s."
    )
    lines = [
        "# Models that others ship",
        "",
        textwrap.fill(text, 110),
        "",
        "| model | contacts | engine | compiled in (s) | env steps/s | error float64 | float32 |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [row[column] for column in _COLUMNS[:-1]]
        if row["env_steps_per_second"] != "":
            cells[4] = f"{float(row['env_steps_per_second']):.1e}"
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += ["", "Those that machine code does not play, and what was not done in time:", ""]
    lines += [
        f"- **{row['model']}**: {row['why']}"
        for row in rows
        if row["engine"] != "native" or "not done" in row["why"]
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(tyro.cli(Settings))

"""Mechanisms crossed with options and starts, simulated by us and by C MuJoCo.

Compiling is the cost: mechanisms with the same options are bodies of one model that do not touch
one another, and their starts are a batch. C simulates each alone, and its solver goes on to the
optimum. The error of a cell (a mechanism from one start) is the largest of what MuJoCo computes, in
double precision: relative where a number is greater than one. What is not simulated is refused, in
words.
"""

import csv
import dataclasses
import importlib
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax

from experiments.checks.mechanisms import MOTOR, Mechanism, Start, mechanisms
from mjx_reinforce import normal
from mjx_reinforce.engines import rollouts
from mjx_reinforce.engines.native import rollout as native
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.physics import step as physics

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

FRAME_SKIP = 2
STEPS = 20
#: What is equal.
EQUAL = 1e-9
#: What is compared; of bodies, all but the world.
FIELDS = (
    *("time", "qpos", "qvel", "act", "qacc", "sensordata", "xpos", "xquat", "subtree_com", "cvel"),
    *("ten_length", "actuator_length", "actuator_force", "qfrc_bias", "qfrc_passive"),
    *("qfrc_actuator", "qfrc_constraint"),
)
BODIES = ("xpos", "xquat", "subtree_com", "cvel")
ENGINES = {"vmap": rollouts.rollout, "native": native.rollout}
#: So many mechanisms with contacts are kept apart by the bits of contype.
BITS = 31


class Cell(NamedTuple):
    """A mechanism from one start: the largest error, and the field that has it or the refusal."""

    axis: str
    case: str
    mechanism: str
    start: str
    error: float
    words: str


class Shown(MujocoEnv):
    """A model that shows what MuJoCo computes, from a start, forever."""

    begin: tuple[Any, Any]

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Shown."""

        frame_skip: int = FRAME_SKIP
        max_episode_steps: int = STEPS
        reward_threshold: float | None = None

    settings: Settings

    def initial(self, rng: jax.Array) -> tuple[Any, Any]:
        """Returns the start."""
        return self.begin

    def observe(self, data: Any) -> jax.Array:
        """Returns all fields, one after the other."""
        return jnp.concatenate([jnp.ravel(x) for x in fields(data)])

    def outcome(self, before: Any, data: Any, action: jax.Array) -> tuple[Any, Any, dict]:
        """Earns nothing."""
        return jnp.zeros(()), False, {}


def fields(data: Any) -> list[Any]:
    """Returns each field of a simulation."""
    whole = [getattr(data, name) for name in FIELDS]
    return [x[1:] if name in BODIES else x for name, x in zip(FIELDS, whole, strict=True)]


def control(time: Any, start: Any, first: Any = 0, xp: Any = np) -> Any:
    """Returns the control [A], that of the start in slow motion."""
    return start * xp.cos(9 * time + xp.arange(start.shape[-1]) - first)


def by_c(xml: str, start: Start, steps: int) -> list[np.ndarray]:
    """Returns each field by C MuJoCo after every env step, [T, ...], whose solver goes on."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.tolerance, model.opt.ls_tolerance, model.opt.iterations = 0, 0, 200
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], ctrl = start
    shown = []
    for _ in range(steps):
        data.ctrl[:] = control(data.time, ctrl)
        mujoco.mj_step(model, data, FRAME_SKIP)
        shown.append([np.array(x, ndmin=1).ravel() for x in fields(data)])
    return [np.stack(field) for field in zip(*shown, strict=True)]


def merged(together: Sequence[Mechanism]) -> Any:
    """Returns a model, an ``MjSpec``, of a pendulum and of mechanisms that do not touch."""
    spec = mujoco.MjSpec.from_string(MOTOR.replace("<option/>", together[0].option))
    contacts = 0
    for i, mechanism in enumerate(together):
        child = mujoco.MjSpec.from_string(mechanism.xml)
        geoms = [geom for geom in child.geoms if geom.contype or geom.conaffinity]
        for geom in geoms:
            geom.contype = geom.conaffinity = 1 << contacts
        contacts += bool(geoms)
        spec.attach(child, prefix=f"{i}/", frame=spec.worldbody.add_frame())
    return spec


def programs(all_of_them: Sequence[Mechanism]) -> Iterator[list[Mechanism]]:
    """Yields mechanisms that one model has: of one axis, one option, one solver."""
    groups: dict[Any, list[Mechanism]] = {}
    for each in all_of_them:
        # Rows of friction lead to another solver.
        key = each.axis, each.option, "frictionloss" in each.xml, len(each.starts)
        groups.setdefault(key, []).append(each)
    for group in groups.values():
        size = BITS if "freejoint" in group[-1].xml else len(group)
        yield from (group[i : i + size] for i in range(0, len(group), size))


def load(together: Sequence[Mechanism]) -> tuple[Any, Any]:
    """Returns the model of these mechanisms, and MJX's; raises ValueError as ``make`` does."""
    model = models.load_model(merged(together))
    return model, models.to_mjx(model, "it")


def refusal(each: Mechanism) -> str:
    """Returns why ``make`` refuses a mechanism, or nothing."""
    try:
        load([each])
    except ValueError as error:
        return str(error)
    return ""


def by_us(model: Any, in_mjx: Any, starts: Any, first: Any, steps: int) -> list[np.ndarray]:
    """Returns each field after every env step from every start, [S, T, ...], by no engine."""

    def play(start: Start) -> list[jax.Array]:
        qpos, qvel, act, ctrl = start

        def step(data: Any, _: None) -> tuple[Any, list[jax.Array]]:
            data = data.replace(ctrl=control(data.time, ctrl, first, jnp))
            data = lax.fori_loop(
                0, FRAME_SKIP, lambda _, x: physics.like(physics.step(in_mjx, x), x), data
            )
            return data, fields(data)

        data = models.make_data(model).replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl)
        return lax.scan(step, data, None, steps)[1]

    shown = jax.jit(jax.vmap(play))(starts)
    return [np.asarray(x).reshape(*x.shape[:2], -1) for x in shown]


def by_engine(engine: str, model: Any, starts: Any, first: Any) -> list[np.ndarray]:
    """Returns each field after every env step from the first start, [1, T, ...], in an engine."""
    env = Shown(xml_file=model)
    *env.begin, _, ctrl = (jnp.asarray(x[0]) for x in starts)
    distribution = normal(env.action_space, rescale=False)

    def act(constants: jax.Array, observation: jax.Array) -> jax.Array:
        time = observation[..., :1]
        action = jnp.broadcast_to(control(time, ctrl, first, jnp), (*time.shape[:-1], ctrl.size))
        fixed = jnp.broadcast_to(constants, (*time.shape[:-1], constants.size))
        return jnp.concatenate([action, fixed], axis=-1)

    @jax.jit
    def play(constants: jax.Array) -> jax.Array:
        lengths: Any = {"num_episodes": 1, "horizon": STEPS + 1, "deterministic": True}
        played = ENGINES[engine](env, act, constants, distribution, jax.random.key(0), **lengths)
        return played.observation[1:, 0]

    shown = np.asarray(play(jnp.asarray(distribution.constants, jnp.result_type(float))))
    sizes = [x.size for x in fields(models.make_data(env.mj_model))]
    return [x[None] for x in np.split(shown, np.cumsum(sizes)[:-1], axis=1)]


def compare(together: Sequence[Mechanism], engine: str = "alone") -> Iterator[Cell]:
    """Yields the cells of mechanisms that one model has, from every start."""
    try:
        model, in_mjx = load(together)
    except ValueError:
        refused = {each: words for each in together if (words := refusal(each))}
        for each, words in refused.items():
            yield from (Cell(*each.words, start, np.nan, words) for start in each.starts)
        if together := [each for each in together if each not in refused]:
            yield from compare(together, engine)
        return
    first = np.zeros(model.nu)
    base = mujoco.MjModel.from_xml_string(MOTOR)
    rest = (base.qpos0, np.zeros(base.nv), np.zeros(base.na), np.zeros(base.nu))
    names = list(together[0].starts)
    starts = [
        [np.concatenate(x) for x in zip(rest, *(list(e.starts.values())[s] for e in together))]
        for s in range(len(names))
    ]
    place, used = 0, base.nu
    for each in together:
        size = next(iter(each.starts.values()))[3].size
        first[used : used + size], used = used, used + size
    stacked = [np.stack(x) for x in zip(*starts, strict=True)]
    steps = together[0].steps
    if engine == "alone":
        shown = by_us(model, in_mjx, stacked, first, steps)
    else:
        shown = by_engine(engine, model, stacked, first)
    done = [x[0].size for x in by_c(MOTOR, rest, 1)]
    done[0] = 0
    for each in together:
        sizes = []
        for s, (name, start) in enumerate(each.starts.items()):
            theirs = by_c(each.xml, start, steps)
            sizes = [x.shape[1] for x in theirs]
            errors = [
                np.max(
                    np.abs(x[s, :, at : at + y.shape[1]] - y) / np.maximum(1, np.abs(y)),
                    initial=0.0,
                )
                for x, y, at in zip(shown, theirs, done, strict=True)
            ]
            worst = int(np.argmax(errors))
            yield Cell(*each.words, name, float(errors[worst]), FIELDS[worst])
        done = [at + size for at, size in zip(done, sizes, strict=True)]
        done[0] = 0


@dataclasses.dataclass(frozen=True)
class Settings:
    """Simulate mechanisms of all kinds, and compare with C MuJoCo."""

    engine: Literal["alone", "vmap", "native"] = "alone"
    """What simulates them: the step itself, many at once; or an engine, one by one."""
    only: tuple[str, ...] = ()
    """Axes or names of mechanisms, by default all."""
    output: Path = Path("docs/own_models.csv")
    """A row for each mechanism under each option: the worst start, or the refusal."""


def kind(cell: Cell) -> str:
    """Returns whether a cell is equal, refused or differs."""
    return "refused" if np.isnan(cell.error) else "equal" if cell.error < EQUAL else "differing"


def worst(cells: Sequence[Cell]) -> Iterator[tuple[Cell, int]]:
    """Yields of each mechanism under each option the cell of the largest error, and how many."""
    for _, group in groupby(cells, key=lambda cell: cell[:3]):
        of_one = list(group)
        yield max(of_one, key=lambda cell: np.nan_to_num(cell.error, nan=np.inf)), len(of_one)


def main(settings: Settings) -> None:
    """Prints how many cells are equal on each axis, and those that differ; writes all."""
    jax.config.update("jax_enable_x64", True)
    wanted = set(settings.only)
    chosen = [x for x in mechanisms() if not wanted or wanted & {x.axis, x.name}]
    cells = []
    for together in programs(chosen):
        began = time.process_time()
        parts = [together] if settings.engine == "alone" else [[each] for each in together]
        found = [cell for part in parts for cell in compare(part, settings.engine)]
        cells += found
        seconds, counts = time.process_time() - began, Counter(map(kind, found))
        print(f"{together[0].axis} {together[0].case}: {dict(counts)}, {seconds:.0f} s", flush=True)
        for cell in filter(lambda cell: kind(cell) == "differing", found):
            print(f"  {cell.mechanism}, {cell.start}: {cell.error:.0e} of {cell.words}", flush=True)
    print(
        f"{len(cells)} cells: {dict(Counter(map(kind, cells)))}, {time.process_time():.0f} s of CPU"
    )
    with settings.output.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(
            ("axis", "option", "mechanism", "starts", "worst", "error", "field or refusal")
        )
        for cell, starts in worst(cells):
            rows.writerow((*cell[:3], starts, cell.start, f"{cell.error:.1e}", cell.words))


if __name__ == "__main__":
    main(tyro.cli(Settings))

"""Mechanisms crossed with options and starts, simulated by us and by C MuJoCo.

Compiling is the cost: mechanisms with the same options are bodies of one model that do not touch
one another, and their starts are a batch. C simulates each alone, and its solver goes on to the
optimum; on the axis of few iterations C simulates all together, with the options of the file. The
error of a cell (a mechanism from one start) is the largest of what MuJoCo computes, in double
precision: relative where a number is greater than one. Of the axis ``forces``, each kind of sensor
is a cell. What is not simulated is refused, in words of ours; any other error ends the program.
"""

import csv
import dataclasses
import functools
import importlib
import random
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax
from mujoco import mjx

from experiments.checks.mechanisms import FORCES, MOTOR, Mechanism, Start, failures, mechanisms
from mjx_reinforce import normal
from mjx_reinforce.engine.physics import step as physics
from mjx_reinforce.engine.physics.mjx_internals import Simulation
from mjx_reinforce.engine.physics.sensors import rne_postconstraint
from mjx_reinforce.engine.play import native
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.refusals import UnsupportedError

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

#: What counts as equal.
EQUAL = 1e-9
#: What is compared; of bodies, all but the world.
BODIES = ("xpos", "xquat", "subtree_com", "cvel", "cacc", "cfrc_ext", "cfrc_int")
FIELDS = (
    *BODIES,
    *("qpos", "qvel", "act", "qacc", "sensordata", "ten_length", "actuator_length"),
    *("actuator_force", "qfrc_bias", "qfrc_passive", "qfrc_actuator", "qfrc_constraint"),
)
#: Passes of XLA that make loops faster, which run for a few steps.
_PASSES = (
    "simplify-while-loops",
    "while-loop-constant-sinking",
    "while-loop-invariant-code-motion",
)
#: How XLA compiles what runs once.
_QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_disable_hlo_passes": ",".join(_PASSES),
}
#: The lot by which CI's part of the matrix is drawn, and so many mechanisms of a program.
_SEED = 62
_SAMPLED = 10
#: So many mechanisms with contacts are kept apart by the bits of contype.
BITS = 31


@dataclasses.dataclass(frozen=True)
class Settings:
    """Simulate mechanisms of all kinds, and compare with C MuJoCo."""

    native: bool = False
    """Simulate each mechanism alone, by machine code, from its first start."""
    sample: bool = False
    """Simulate the part that CI does: all that ever failed, and others by lot."""
    jobs: int = 1
    """Programs at a time, each in a process of its own."""
    only: tuple[str, ...] = ()
    """Axes, options or names of mechanisms, by default all."""
    output: Path = Path("docs/own_models.csv")
    """A row for each mechanism under each option: the worst start, or the refusal."""


class Cell(NamedTuple):
    """A mechanism from one start: the largest error, and the field that has it or the refusal."""

    axis: str
    option: str
    mechanism: str
    start: str
    error: float
    words: str

    @property
    def verdict(self) -> str:
        """Whether it is equal, refused or differs."""
        if np.isnan(self.error):
            return "refused"
        return "equal" if self.error < EQUAL else "differing"


class Shown(MujocoEnv):
    """A model that shows what MuJoCo computes, from a start on, forever."""

    contact_forces = True

    def __init__(self, model: Any, start: Start, steps: int):
        """Takes a model, and where it starts."""
        super().__init__(
            xml_file=model, frame_skip=1, max_episode_steps=steps, reward_threshold=None
        )
        self.start = start

    def initial(self, rng: jax.Array) -> tuple[Any, Any]:
        """Returns the start."""
        return jnp.asarray(self.start[0]), jnp.asarray(self.start[1])

    def observe(self, data: Any) -> jax.Array:
        """Returns the time, and all fields, one after the other."""
        return jnp.concatenate([jnp.ravel(x) for x in (data.time, *fields(data))])

    def outcome(self, before: Any, data: Any, action: jax.Array) -> tuple[Any, Any, dict]:
        """Earns nothing."""
        return jnp.zeros(()), False, {}


def fields(data: Any) -> list[Any]:
    """Returns each field of a simulation."""
    return [getattr(data, name)[name in BODIES :] for name in FIELDS]


def control(start: Any, time: Any, xp: Any = np) -> Any:
    """Returns the control [A], that of the start in slow motion."""
    return start * xp.cos(9 * time)


def by_c(each: Mechanism, start: Start) -> list[np.ndarray]:
    """Returns each field by C MuJoCo after every step, [T, ...], whose solver goes on."""
    model = mujoco.MjModel.from_xml_string(each.xml)
    model.opt.tolerance, model.opt.ls_tolerance, model.opt.iterations = 0, 0, 200
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-12, 200
    return by_c_as_is(model, start, each.steps)


def by_c_as_is(model: Any, start: Start, steps: int) -> list[np.ndarray]:
    """Returns each field by C MuJoCo after every step, [T, ...], with the model's own options."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], ctrl = start
    shown = []
    for _ in range(steps):
        data.ctrl[:] = control(ctrl, data.time)
        mujoco.mj_step(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        shown.append([x.flatten() for x in fields(data)])
    return [np.stack(field) for field in zip(*shown, strict=True)]


def by_us(model: Any, starts: Start, steps: int) -> list[np.ndarray]:
    """Returns each field after every step from every start, [S, T, ...], by no engine."""
    in_mjx = models.to_mjx(model, "it")
    forward = functools.partial(physics.forward, in_mjx)
    if in_mjx.opt.integrator == mjx.IntegratorType.RK4:  # which calls it four times
        forward = jax.jit(forward)

    def begin(qpos: Any, qvel: Any, act: Any) -> Any:
        return models.make_data(model).replace(qpos=qpos, qvel=qvel, act=act)

    def step(data: Any, ctrl: Any) -> tuple[Any, list[jax.Array]]:
        given = data.replace(ctrl=control(ctrl, data.time, jnp))
        data = physics.like(physics.step(in_mjx, given, forward), data)
        return data, fields(Simulation(rne_postconstraint(in_mjx, data)))

    def play(start: Start) -> list[jax.Array]:
        # A step of all starts is traced once; a loop that is batched would be traced thrice.
        data = jax.vmap(begin)(*start[:3])
        return lax.scan(lambda data, _: jax.vmap(step)(data, start[3]), data, None, steps)[1]

    shown = jax.jit(play, compiler_options=_QUICK)(starts)
    return [np.asarray(x).swapaxes(0, 1).reshape(*x.shape[1::-1], -1) for x in shown]


def by_machine_code(model: Any, start: Start, steps: int) -> list[np.ndarray]:
    """Returns each field after every step, [1, T, ...], without activations at the start."""
    env = Shown(model, start, steps)
    distribution = normal(env.action_space, rescale=False)

    def act(constants: jax.Array, observation: jax.Array) -> jax.Array:
        action = control(jnp.asarray(start[3]), observation[..., :1], jnp)
        fixed = jnp.broadcast_to(constants, (*action.shape[:-1], constants.size))
        return jnp.concatenate([action, fixed], axis=-1)

    @jax.jit
    def play(constants: jax.Array) -> jax.Array:
        lengths: Any = {"num_episodes": 1, "horizon": steps + 1, "deterministic": True}
        key = jax.random.key(0)
        episodes = native.native_rollout(env, act, constants, distribution, key, **lengths)
        return episodes.observation[1:, 0]

    shown = np.asarray(play(jnp.asarray(distribution.constants, jnp.result_type(float))))
    sizes = [1, *(x.size for x in fields(models.make_data(model)))]
    return [x[None] for x in np.split(shown, np.cumsum(sizes)[:-1], axis=1)[1:]]


def load(parts: Sequence[Mechanism]) -> Any:
    """Returns one model of mechanisms that do not touch."""
    spec = mujoco.MjSpec.from_string(f"<mujoco>{parts[-1].option}</mujoco>")
    contacts = 0
    for i, each in enumerate(parts):
        child = mujoco.MjSpec.from_string(each.xml)
        geoms = [geom for geom in child.geoms if geom.contype or geom.conaffinity]
        for geom in geoms:
            geom.contype = geom.conaffinity = 1 << contacts
        contacts += bool(geoms)
        spec.attach(child, prefix=f"{i}/", frame=spec.worldbody.add_frame())
    return models.load_model(spec)


def refusal(model: Any) -> str:
    """Returns why ``make`` refuses a model, or nothing; raises errors that are not ours."""
    try:
        models.to_mjx(model, "it")
    except UnsupportedError as error:  # any other is a mistake, and ends this program
        return str(error)
    return ""


def programs(chosen: Iterable[Mechanism]) -> Iterator[list[Mechanism]]:
    """Yields mechanisms that one model has: of one axis and one option."""
    groups: dict[Any, list[Mechanism]] = {}
    for each in chosen:
        groups.setdefault((each.axis, each.case, each.option), []).append(each)
    for group in groups.values():
        size = len(group) if group[0].axis == "actuators" else BITS
        yield from (group[i : i + size] for i in range(0, len(group), size))


def sample() -> list[list[Mechanism]]:
    """Returns programs that take two cores at most four minutes: always the same ones.

    They are all that ever failed, and mechanisms by lot of one program of each axis, in which the
    axis ``forces`` counts twice.
    """
    lot, axes = random.Random(_SEED), {}
    for together in programs(mechanisms()):
        axes.setdefault(together[0].axis, []).append(together)
    few = []
    for axis, of_axis in axes.items():
        count, sizes = 2 if axis == "forces" else 1, [len(together) for together in of_axis]
        for together in lot.sample(of_axis, count, counts=sizes):
            few += lot.sample(together, min(len(together), _SAMPLED))
    return list(programs(list(dict.fromkeys((*failures(), *few)))))


def compare(together: Sequence[Mechanism], native: bool = False) -> Iterator[Cell]:
    """Yields the cells of mechanisms that one model has, from every start."""
    model = mujoco.MjModel.from_xml_string(MOTOR)
    rest = model.qpos0, np.zeros(model.nv), np.zeros(0), np.zeros(model.nu)
    motor = Mechanism(
        "", "", "", MOTOR, lambda _: dict.fromkeys(together[0].starts, rest), together[0].steps
    )
    parts = [motor, *together]
    model = load(parts)
    if refusal(model):
        refused = {each: words for each in together if (words := refusal(load([motor, each])))}
        for each, words in refused.items():
            yield from (Cell(*each.title, start, np.nan, words) for start in each.starts)
        if left := [each for each in together if each not in refused]:
            yield from compare(left, native)
        return
    each_start = zip(*(each.starts.values() for each in parts), strict=True)
    starts: Any = [tuple(map(np.concatenate, zip(*x, strict=True))) for x in each_start]
    if native:
        shown = by_machine_code(model, starts[0], motor.steps)
    else:
        stacked: Any = tuple(map(np.stack, zip(*starts, strict=True)))
        shown = by_us(model, stacked, motor.steps)
    as_is = together[0].axis == "iterations"
    stopped = [by_c_as_is(model, start, motor.steps) for start in starts if as_is]
    for each in parts:
        sizes = []
        for k, (name, start) in enumerate(list(each.starts.items())[: len(shown[0])]):
            ours, theirs = [x[k] for x in shown], by_c(each, start)
            sizes = [field.shape[1] for field in theirs]
            if as_is:
                theirs = [x[:, :n] for x, n in zip(stopped[k], sizes, strict=True)]
            if each is not motor:
                errors = [
                    np.max(np.abs(x[:, :n] - y) / np.maximum(1, np.abs(y)), axis=0)
                    for x, y, n in zip(ours, theirs, sizes, strict=True)
                ]
                yield from cells(each, name, errors)
        shown = [x[..., n:] for x, n in zip(shown, sizes, strict=True)]
        stopped = [[x[:, n:] for x, n in zip(c, sizes, strict=True)] for c in stopped]


def cells(each: Mechanism, start: str, errors: Sequence[np.ndarray]) -> Iterator[Cell]:
    """Yields the cells of a mechanism from a start, given the errors of each field's numbers."""
    names = np.repeat(FIELDS, [len(x) for x in errors])
    names[names == "sensordata"] = each.readings
    error = np.nan_to_num(np.concatenate(errors), nan=np.inf)
    if each.axis != "forces":
        readings = {"": error >= 0}
    else:
        readings = {name: chosen for name in FORCES if np.any(chosen := names == name)}
        readings["motion"] = ~np.isin(names, FORCES)
    for reading, chosen in readings.items():
        worst = np.argmax(error[chosen])
        yield Cell(
            *each.title, named(start, reading), float(error[chosen][worst]), names[chosen][worst]
        )


def named(start: str, reading: str) -> str:
    """Returns what a cell is called after: its start, and what is read if not all is."""
    return f"{start}, {reading}" if reading else start


def summarized(cells: Sequence[Cell]) -> Iterator[tuple[Any, ...]]:
    """Yields of each mechanism under each option how many starts, and the one that is worst."""
    yield "axis", "option", "mechanism", "starts", "worst start", "error", "field or refusal"
    for title, group in groupby(cells, key=lambda cell: cell[:3]):
        starts = list(group)
        worst = max(starts, key=lambda cell: np.nan_to_num(cell.error, nan=np.inf))
        yield *title, len(starts), worst.start, f"{worst.error:.1e}", worst.words


def played(settings: Settings, number: int) -> tuple[list[Cell], float]:
    """Returns the cells of a program of those chosen, and the seconds of processor time."""
    jax.config.update("jax_enable_x64", True)
    began = time.process_time()
    together = chosen(settings)[number]
    parts = [[each] for each in together] if settings.native else [together]
    shown = [cell for part in parts for cell in compare(part, settings.native)]
    return shown, time.process_time() - began


def chosen(settings: Settings) -> list[list[Mechanism]]:
    """Returns the programs that are asked for."""
    if settings.sample:
        return sample()
    wanted = set(settings.only)
    return list(
        programs([x for x in mechanisms() if not wanted or wanted & {x.axis, x.case, x.name}])
    )


def main(settings: Settings) -> None:
    """Prints the counts of each program and the cells that differ, and writes all."""
    began = time.monotonic()
    numbers, everything, spent = range(len(chosen(settings))), [], 0.0
    with ProcessPoolExecutor(settings.jobs, mp_context=get_context("spawn")) as processes:
        play = functools.partial(played, settings)
        for shown, seconds in processes.map(play, numbers):
            counts = Counter(cell.verdict for cell in shown)
            print(f"{' '.join(shown[0][:2])}: {dict(counts)}, {seconds:.0f} s", flush=True)
            for cell in shown:
                if cell.verdict == "differing":
                    print(f"  {cell.mechanism}, {cell.start}: {cell.error:.0e} of {cell.words}")
            everything += shown
            spent += seconds
    counts = Counter(cell.verdict for cell in everything)
    passed = f"{time.monotonic() - began:.0f} s, {spent:.0f} s of CPU"
    print(f"{len(everything)} cells: {dict(counts)}; {passed}")
    with settings.output.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(summarized(everything))


if __name__ == "__main__":
    main(tyro.cli(Settings))

"""Models of one feature each, simulated by us and by C MuJoCo.

The largest error of what MuJoCo computes, after 20 env steps of two physics steps each, in double
precision: relative where a number is greater than one. C's solver goes on to the optimum. A model
that is not simulated is refused, in words.
"""

import csv
import dataclasses
import importlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax

from experiments.checks.feature_models import MODELS
from mjx_reinforce import normal
from mjx_reinforce.engines import rollouts
from mjx_reinforce.engines.native import rollout as native
from mjx_reinforce.envs.base import MujocoEnv

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

FRAME_SKIP = 2
STEPS = 20
#: What is compared; the sensors' data too.
FIELDS = (
    *("time", "qpos", "qvel", "act", "qacc", "sensordata", "xpos", "xquat", "subtree_com", "cvel"),
    *("ten_length", "actuator_length", "actuator_force", "qfrc_bias", "qfrc_passive"),
    *("qfrc_actuator", "qfrc_constraint"),
)
ENGINES = {"vmap": rollouts.rollout, "native": native.rollout}


class Shown(MujocoEnv):
    """A model that shows what MuJoCo computes, from the pose of the model on, forever."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Shown."""

        frame_skip: int = FRAME_SKIP
        max_episode_steps: int = STEPS
        reward_threshold: float | None = None

    settings: Settings

    def initial(self, rng: jax.Array) -> tuple[Any, Any]:
        """Returns the pose of the model, in motion."""
        return jnp.asarray(self.mj_model.qpos0), jnp.asarray(velocity(self.mj_model))

    def observe(self, data: Any) -> jax.Array:
        """Returns all fields, one after the other."""
        return jnp.concatenate([jnp.ravel(getattr(data, name)) for name in FIELDS])

    def outcome(self, before: Any, data: Any, action: jax.Array) -> tuple[Any, Any, dict]:
        """Earns nothing."""
        return jnp.zeros(()), False, {}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Simulate models of one feature each, and compare with C MuJoCo."""

    engine: tuple[str, ...] = ("vmap", "native")
    """What simulates them."""
    only: tuple[str, ...] = ()
    """Names of models, by default all."""
    output: Path = Path("docs/own_models.csv")
    """A row for each model and engine: the error and where it is, or the refusal."""


def velocity(model: Any) -> np.ndarray:
    """Returns the velocities [nv] at the start."""
    return 0.3 * np.cos(1 + np.arange(model.nv))


def control(qpos: Any, size: int, xp: Any = np) -> Any:
    """Returns the control [size], which moves as positions [..., nq] do."""
    return xp.sin(7 * qpos.sum(-1)[..., None] + 1 + xp.arange(size))


def expected(model: Any) -> list[np.ndarray]:
    """Returns each field by C MuJoCo after every env step, [T, ...], whose solver goes on."""
    model.opt.tolerance, model.opt.ls_tolerance, model.opt.iterations = 0, 0, 200
    data = mujoco.MjData(model)
    data.qvel[:] = velocity(model)
    steps = []
    for _ in range(STEPS):
        data.ctrl[:] = control(data.qpos, model.nu)
        mujoco.mj_step(model, data, FRAME_SKIP)
        steps.append([np.array(getattr(data, name), ndmin=1).ravel() for name in FIELDS])
    return [np.stack(field) for field in zip(*steps, strict=True)]


def simulated(engine: str, env: Shown) -> np.ndarray:
    """Returns what the model shows after every env step, [T, O]; "alone" is ``env.step`` itself."""
    if engine == "alone":
        return np.asarray(alone(env))
    distribution = normal(env.action_space, rescale=False)

    def act(constants: jax.Array, observation: jax.Array) -> jax.Array:
        action = acted(env, observation)
        fixed = jnp.broadcast_to(constants, (*action.shape[:-1], constants.size))
        return jnp.concatenate([action, fixed], axis=-1)

    @jax.jit
    def play(constants: jax.Array) -> jax.Array:
        lengths: Any = {"num_episodes": 1, "horizon": STEPS + 1, "deterministic": True}
        played = ENGINES[engine](env, act, constants, distribution, jax.random.key(0), **lengths)
        return played.observation[1:, 0]

    return np.asarray(play(jnp.asarray(distribution.constants, jnp.result_type(float))))


def alone(env: Shown) -> jax.Array:
    """Simulates one episode by no engine, which compiles soonest: the start takes no physics."""

    def step(state: Any, _: None) -> tuple[Any, jax.Array]:
        qpos = state.pipeline_state.qpos
        state = env.step(state, control(qpos, env.action_size, jnp))
        return state, state.obs

    def play(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        reset = jax.eval_shape(env.set_state, qpos, qvel)
        rest = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), reset)
        start = dataclasses.replace(rest.pipeline_state, qpos=qpos, qvel=qvel)
        return lax.scan(step, dataclasses.replace(rest, pipeline_state=start), None, STEPS)[1]

    return jax.jit(play)(*env.initial(jax.random.key(0)))


def acted(env: Shown, shown: jax.Array) -> jax.Array:
    """Returns the control [..., A] where this is shown [..., O]."""
    return control(shown[..., 1 : 1 + env.mj_model.nq], env.action_size, jnp)  # after time


def compare(name: str, engines: tuple[str, ...]) -> Iterator[tuple[str, float, str]]:
    """Yields an engine, the largest error, and the field that has it, or why it was refused."""
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(True):
        path = Path(folder) / "model.xml"
        path.write_text(MODELS[name], encoding="utf-8")
        try:
            env = Shown(xml_file=str(path))
        except ValueError as error:
            yield from ((engine, np.nan, str(error).replace(str(path), "it")) for engine in engines)
            return
        theirs = expected(mujoco.MjModel.from_xml_path(str(path)))
        for engine in engines:
            try:
                shown = simulated(engine, env)
            except ValueError as error:
                yield engine, np.nan, str(error)
                continue
            ours = np.split(shown, np.cumsum([x.shape[1] for x in theirs])[:-1], axis=1)
            errors = [
                np.max(np.abs(x - y) / np.maximum(1, np.abs(y)), initial=0.0)
                for x, y in zip(ours, theirs, strict=True)
            ]
            worst = int(np.argmax(errors))
            yield engine, float(errors[worst]), FIELDS[worst]


def main(settings: Settings) -> None:
    """Prints a row for each model and engine, and writes them all."""
    rows = [("model", "engine", "error", "field or refusal")]
    for name in settings.only or MODELS:
        for engine, error, words in compare(name, settings.engine):
            rows.append((name, engine, f"{error:.1e}", words))
            print(f"{name:38} {engine:7} {error:8.1e}  {words}", flush=True)
    with settings.output.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings)))

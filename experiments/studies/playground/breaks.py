"""How many episodes break: a run's policies on our engines and in Playground's MJX."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco_playground import registry

import mjx_reinforce as mr
from experiments.kit import rows
from experiments.studies.playground.runs import ROOT
from mjx_reinforce import Policy, envs
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.export.policy_files import load_policy
from mjx_reinforce.learning.policy import act

COLUMNS: tuple[str, ...] = (
    *("date", "commit", "device", "jax", "task", "seed", "model", "implementation"),
    *("episodes", "env_steps", "broken"),
)
#: Env steps of each episode.
ENV_STEPS = 300
AS_IN_THE_FILE = "as in the file"
_C: Any = mujoco  # whose stubs lack the flags
_NO_IMPLICIT_DAMPING = int(_C.mjtDisableBit.mjDSBL_EULERDAMP)


def _implicit_damping(options: Any) -> None:
    options.disableflags &= ~_NO_IMPLICIT_DAMPING


def _many_iterations(options: Any) -> None:
    options.iterations = 100


def _half_the_timestep(options: Any) -> None:
    options.timestep /= 2


#: What is changed of the task's model.
MODELS: dict[str, tuple[Callable[[Any], None], ...]] = {
    AS_IN_THE_FILE: (),
    "100 iterations": (_many_iterations,),
    "implicit damping": (_implicit_damping,),
    "implicit damping, 100 iterations": (_implicit_damping, _many_iterations),
    "half the timestep": (_half_the_timestep,),
}


def count(
    tasks: Sequence[str],
    folder: Path,
    seeds: Sequence[int],
    num_episodes: int,
    models: Sequence[str] = tuple(MODELS),
) -> None:
    """Plays policies with noise, and writes FOLDER/breaks.csv as it goes; what fails is named.

    Args:
      tasks: FOLDER/TASK is a run.
      folder: of the runs.
      seeds: whose policies, of the run's end.
      num_episodes: of each count; MJX plays a quarter, and only the model of the file.
      models: names in ``MODELS``.
    """
    configure_jax()
    for task in tasks:
        for seed in seeds:
            try:
                _count(task, folder, seed, num_episodes, models)
            except (ValueError, RuntimeError, ImportError) as error:
                print(f"{task}, seed {seed}: failed, {error}", flush=True)


def _count(task: str, folder: Path, seed: int, num_episodes: int, models: Sequence[str]) -> None:
    """Plays the policy of a seed, as ``count`` says."""
    policy, actor = load_policy(folder / task / "policy", seed)
    for model in models:
        env = changed(task, MODELS[model])
        counts = {
            engine: (num_episodes, broken_here(env, policy, actor, num_episodes, engine))
            for engine in ("native", "mujoco")
        }
        if model == AS_IN_THE_FILE:
            # Its step is slow on a CPU.
            few = max(1, num_episodes // 4)
            counts["MJX"] = few, broken_in_mjx(env, policy, actor, few)
        _write(folder / "breaks.csv", task, seed, model, counts)


def _write(
    path: Path, task: str, seed: int, model: str, counts: dict[str, tuple[int, int]]
) -> None:
    """Appends a row for each implementation, whose counts are (episodes, broken), and prints it."""
    known = {"date": rows.now(), "commit": rows.commit(), "jax": jax.__version__}
    known |= {"device": jax.local_devices()[0].device_kind, "task": task, "seed": seed}
    lines = []
    for name, (episodes, broken) in counts.items():
        print(f"{task}, seed {seed}, {model}, {name}: {broken} of {episodes} broke", flush=True)
        what = {"model": model, "implementation": name}
        what |= {"episodes": episodes, "env_steps": ENV_STEPS, "broken": broken}
        lines.append(known | what)
    rows.append(path, lines, COLUMNS)


def changed(task: str, changes: Sequence[Callable[[Any], None]]) -> Any:
    """Returns a task of Playground with another model, whose env steps are as long as before.

    Args:
      task: a name of the suite.
      changes: of the model's options, in place.
    """
    env: Any = registry.load(task, config_overrides={"impl": "jax"})
    for change in changes:
        change(env.mj_model.opt)
    env._sim_dt = env.mj_model.opt.timestep
    env._mjx_model = mjx.put_model(env.mj_model, impl="jax")
    return env


def broken_here(env: Any, policy: Policy, actor: Any, num_episodes: int, engine: str) -> int:
    """Returns how many episodes break on an engine of ours."""
    traced = envs.from_playground(env)

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        """Returns which episodes [N] broke."""
        return mr.rollout(
            traced,
            functools.partial(act, policy),
            actor,
            policy.distribution,
            key,
            num_episodes=num_episodes,
            horizon=ENV_STEPS,
            engine=engine,
        ).nonfinite

    return int(np.sum(play(jax.random.key(ROOT + 3))))


def broken_in_mjx(env: Any, policy: Policy, actor: Any, num_episodes: int) -> int:
    """Returns how many episodes break in Playground's own step."""
    step: Callable[..., Any] = jax.vmap(env.step)

    def advance(carry: tuple[Any, jax.Array], key: jax.Array) -> tuple[Any, None]:
        state, is_broken = carry
        outputs = act(policy, actor, state.obs)
        noise = jax.random.normal(key, policy.distribution.mode(outputs).shape)
        action = policy.distribution.sample(outputs, noise)
        state = step(state, policy.distribution.clip(action))
        return (state, is_broken | ~jnp.isfinite(state.data.qvel).all(axis=-1)), None

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        """Returns which episodes [N] broke."""
        start_key, noise_key = jax.random.split(key)
        state = jax.vmap(env.reset)(jax.random.split(start_key, num_episodes))
        start = state.replace(done=jnp.zeros(num_episodes), reward=jnp.zeros(num_episodes))
        keys = jax.random.split(noise_key, ENV_STEPS)
        (_, is_broken), _ = jax.lax.scan(advance, (start, jnp.zeros(num_episodes, bool)), keys)
        return is_broken

    return int(np.sum(play(jax.random.key(ROOT + 3))))

"""Returns of trained policies here, and of the same policies on Playground's own environments."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from mujoco_playground import registry, wrapper

from experiments.kit import rows
from experiments.kit.episodes import own_simulation
from experiments.studies.playground.runs import ROOT
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.export.policy_files import Player, load_seed
from mjx_reinforce.export.run_files import Run, read_run
from mjx_reinforce.learning.policy import act

COLUMNS: tuple[str, ...] = (
    *("date", "commit", "device", "jax", "task", "seed", "implementation", "episode", "return"),
)


def compare(
    tasks: Sequence[str],
    folder: Path,
    num_episodes: int,
    implementation: Literal["jax", "warp"],
) -> None:
    """Plays the best policy of each run on both, and writes FOLDER/agreement.csv as it goes.

    Args:
      tasks: FOLDER/TASK is a run.
      folder: of the runs.
      num_episodes: of each side, from starts of their own.
      implementation: of Playground's physics, its ``impl``.
    """
    configure_jax()
    for task in tasks:
        try:
            run = read_run(folder / task)
            player, _ = load_seed(run, "best", trusted_code=run.env)
            returns = {
                "ours": own_returns(run, player, num_episodes),
                implementation: playground_returns(run, player, num_episodes, implementation),
            }
        except (ValueError, RuntimeError, ImportError) as error:
            print(f"{task}: failed, {error}", flush=True)
            continue
        means = ", ".join(f"{np.mean(x):.1f} {name}" for name, x in returns.items())
        print(f"{task}, seed {player.seed}: {means}", flush=True)
        known = {"date": rows.now(), "commit": rows.commit(), "jax": jax.__version__}
        known |= {"device": jax.local_devices()[0].device_kind, "task": task, "seed": player.seed}
        lines = [
            known | {"implementation": name, "episode": number, "return": f"{x:.7g}"}
            for name, numbers in returns.items()
            for number, x in enumerate(numbers)
        ]
        rows.append(folder / "agreement.csv", lines, COLUMNS)


def own_returns(run: Run, player: Player, num_episodes: int) -> np.ndarray:
    """Returns the returns [N] of a policy's episodes here, without noise."""
    returns = own_simulation(run, player, num_episodes)(player.actor, ROOT + 1)
    return np.asarray(returns, float)


def playground_returns(
    run: Run, player: Player, num_episodes: int, implementation: str
) -> np.ndarray:
    """Returns the returns [N] of a policy's episodes on Playground's environment for training."""
    name = run.env.partition(":")[2]
    task: Any = registry.load(name, config_overrides={"impl": implementation})
    if implementation == "warp":
        # Its kernels would print a line wherever the few iterations of the files are used up.
        task._mjx_model = task.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
    env = wrapper.wrap_for_brax_training(task, episode_length=run.horizon)
    policy = player.policy

    def advance(carry: Any, _: None) -> tuple[Any, None]:
        """Makes an env step; what follows the end of an episode adds nothing."""
        state, total, is_alive = carry
        action = policy.distribution.mode(act(policy, player.actor, state.obs))
        state = env.step(state, policy.distribution.clip(action))
        total = total + jnp.where(is_alive, state.reward, 0)
        return (state, total, is_alive & (state.done == 0)), None

    @jax.jit
    def play(keys: jax.Array) -> jax.Array:
        """Returns the returns [N] of whole episodes."""
        start = env.reset(keys), jnp.zeros(num_episodes), jnp.ones(num_episodes, bool)
        (_, totals, _), _ = jax.lax.scan(advance, start, None, run.horizon)
        return totals

    # As Playground's own programs do, whose environments take keys as words.
    return np.asarray(play(jax.random.split(jax.random.PRNGKey(ROOT + 2), num_episodes)), float)

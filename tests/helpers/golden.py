"""One whole update of a toy by each engine, as kept in tests/engine/play/golden.

``JAX_PLATFORMS=cpu PYTHONPATH=. python tests/helpers/golden.py`` writes these files again: where
the mathematics is changed on purpose, which the commit says.
"""

import jax
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from places import ROOT
from toys import Drifting

from mjx_reinforce import reinforce, train_step

FOLDER = ROOT / "tests" / "engine" / "play" / "golden"
ENGINES = ("vmap", "native")


def updated(engine):
    """Returns what an update changes: parameters, observation statistics, metrics; by name.

    The second update of a run, so that observations are scaled. Plain gradient descent: Adam's
    first steps would have the gradient's sign alone.
    """
    learner = reinforce(
        Drifting(), num_episodes=4, horizon=20, optimizer=optax.sgd(0.01), engine=engine
    )
    before, _ = train_step(learner, jax.jit(learner.init)(jax.random.key(0)))
    start = ravel_pytree(before.actor.params)[0]
    after, metrics = train_step(learner, before)
    moved = ravel_pytree(after.actor.params)[0] - start
    statistics = after.actor.normalizer
    del metrics["simulated_steps"]  # it has to do with the width of the processor's vectors
    numbers = {f"metrics.{name}": value for name, value in metrics.items()}
    numbers |= {"params": moved, "mean": statistics.mean, "m2": statistics.m2}
    return {name: np.asarray(value) for name, value in numbers.items()}


if __name__ == "__main__":
    jax.config.update("jax_default_matmul_precision", "highest")
    FOLDER.mkdir(exist_ok=True)
    for engine in ENGINES:
        np.savez(FOLDER / f"{engine}.npz", **updated(engine))

"""A brax environment under our learner; ours under brax's tools is in test_envs.py."""

import jax
import jax.flatten_util
import numpy as np
import pytest
from brax import envs as brax_envs

from mjx_reinforce import reinforce, train_step


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Brax System")
def test_a_brax_environment_trains():
    env = brax_envs.get_environment("inverted_pendulum", backend="generalized")
    played = []
    for engine in ("vmap", "auto"):
        learner = reinforce(env, num_episodes=8, horizon=30, engine=engine)
        state = learner.init(jax.random.key(0))
        after, metrics = train_step(learner, state)
        assert int(metrics["skipped_update"]) == 0
        before, later = (jax.flatten_util.ravel_pytree(s.actor.params)[0] for s in (state, after))
        assert np.all(np.isfinite(later))
        assert np.any(before != later)
        played.append(int(metrics["env_steps"]))
    assert learner.engine.name == "native"
    assert played[0] == played[1] > 8

"""Every environment trains: from the command line, or up to what XLA would compile.

What compiles in seconds runs, two updates of two short episodes. Of the tasks that compile for
half a minute and more one runs, with contacts; the training step of the others and of older
versions is traced. ``test_parity.py`` compares the compiled physics with Gymnasium's.
"""

import subprocess
import sys

import jax
import pytest

from mjx_reinforce import envs, reinforce

HEAVY = {
    *("Pusher-v5", "Swimmer-v5", "HalfCheetah-v5", "Hopper-v5"),
    *("Walker2d-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5"),
}
SETTINGS = (
    "--num-seeds 1 --num-episodes 2 --horizon 3 --max-updates 2 --eval-every 2 --eval-episodes 1"
)
#: Tasks of the same classes as others, with other numbers.
OLDER = {"InvertedPendulum-v4", "CartPole-v0"}
RUN = [id for id in envs.names() if id not in HEAVY | OLDER]


@pytest.mark.parametrize("id", [*RUN, "Hopper-v5"])
def test_trains(id, tmp_path):
    command = [sys.executable, "-W", "ignore", "-m", "mjx_reinforce.train", "--env", id]
    command += [*SETTINGS.split(), "--output", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "run" / "summary.json").stat().st_size > 0


def shapes(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


@pytest.mark.parametrize("id", sorted((HEAVY | OLDER) - {"Hopper-v5"}))
def test_a_training_step_is_traced(id):
    """The state comes back as it was: it can be trained on, and scanned over."""
    learner = reinforce(envs.make(id), num_episodes=2, horizon=3, engine="vmap")
    state = jax.eval_shape(learner.init, jax.random.key(0))
    after, metrics = jax.eval_shape(learner.step, state)
    assert shapes(after) == shapes(state)
    assert metrics["episode_return"].shape == ()

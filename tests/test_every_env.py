"""Every environment trains from the command line, two updates of two short episodes."""

import os
import subprocess
import sys

import pytest

from mjx_reinforce import envs

#: These compile for half a minute and more; CI trains them on the oldest JAX alone.
HEAVY = {
    *("Pusher", "Swimmer", "HalfCheetah", "Hopper"),
    *("Walker2d", "Ant", "Humanoid", "HumanoidStandup"),
}
#: Nothing here is about speed.
FAST_COMPILE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
SETTINGS = (
    "--num-seeds 1 --num-episodes 2 --horizon 3 --max-updates 2 --eval-every 2 --eval-episodes 1"
)


@pytest.mark.parametrize(
    "id",
    [
        pytest.param(id, marks=pytest.mark.slow) if id.split("-")[0] in HEAVY else id
        for id in envs.names()
    ],
)
def test_trains(id, tmp_path):
    command = [sys.executable, "-W", "ignore", "-m", "mjx_reinforce.train", "--env", id]
    command += [*SETTINGS.split(), "--output", str(tmp_path / "run")]
    environment = os.environ | {"XLA_FLAGS": FAST_COMPILE}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "run" / "summary.json").stat().st_size > 0

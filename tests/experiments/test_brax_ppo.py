"""PPO of brax on the engine, as its example trains it."""

import jax
import pytest

from experiments.examples import brax_ppo


@pytest.mark.slow
def test_it_learns(capsys, monkeypatch):
    """A pendulum falls after some 10 steps, and stays up for longer after a training."""
    # What the example adds to JAX is gone after the test.
    monkeypatch.setattr(jax, "device_put_replicated", None, raising=False)
    monkeypatch.delattr(jax, "device_put_replicated")
    sizes = {"env_steps": 40_000, "num_envs": 16, "batch_size": 16, "reports": 1}
    brax_ppo.main(brax_ppo.Settings(env="InvertedPendulum-v5", **sizes))
    lines = [x for x in capsys.readouterr().out.splitlines() if " steps " in x]
    before, after = (float(line.split()[-1]) for line in lines)
    assert after > 2 * before

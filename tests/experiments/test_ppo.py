"""PPO on the engine alone."""

import ast

import pytest
from places import ROOT

FILE = ROOT / "experiments/examples/ppo.py"


def test_it_takes_the_engine_and_the_environments():
    tree = ast.walk(ast.parse(FILE.read_text("utf-8")))
    found = {
        (node.module, node.names[0].name)
        for node in tree
        if isinstance(node, ast.ImportFrom) and node.module.startswith("mjx_reinforce")
    }
    assert found == {("mjx_reinforce", "envs"), ("mjx_reinforce.engine", "Segment")}


@pytest.mark.slow
def test_it_learns(capsys):
    """A pendulum falls after some ten steps, and stays up for longer after 8,000 of training."""
    from experiments.examples import ppo

    sizes = {"env_steps": 8_192, "num_envs": 16, "num_steps": 64, "minibatches": 4, "reports": 1}
    ppo.main(ppo.Settings(env="InvertedPendulum-v5", **sizes))
    (line,) = capsys.readouterr().out.splitlines()
    assert float(line.split()[-1]) > 100

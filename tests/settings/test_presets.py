"""Every preset: its settings make sense, it trains through the command line, it is the program's.

The physics is that of a toy where it would be MuJoCo's, which takes long to compile.
"""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Survive

from mjx_reinforce import envs
from mjx_reinforce.export.policy_files import build_policy
from mjx_reinforce.runs import command_line
from mjx_reinforce.settings.config import check, check_read_by_policy
from mjx_reinforce.settings.defaults import PRESETS, of_task
from mjx_reinforce.setup.build import build, policy_settings

TINY = ["--num-seeds", "2", "--max-updates", "2", "--horizon", "8"]
TINY += ["--eval-every", "1", "--eval-episodes", "1"]


@pytest.fixture(autouse=True)
def toys(register, run):
    for name in ("InvertedPendulum-v4", "InvertedPendulum-v5", "InvertedDoublePendulum-v5"):
        register(name, Survive)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gymnasium-tutorial", "continuous-cartpole-ars"])
def test_a_preset_trains(name, run, tmp_path):
    arguments = [name, *TINY, "--output", "out"]
    assert run(*arguments) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    assert np.all(np.isfinite(summary["final_returns"]))
    assert not any(summary["nonfinite"])
    episodes = PRESETS[name][1].episodes_per_update
    with np.load(tmp_path / "out" / "returns.npz", allow_pickle=False) as training:
        assert training["episode_return"].shape == training["env_steps"].shape == (2, 2)
        np.testing.assert_array_equal(training["episodes"], [[episodes] * 2, [2 * episodes] * 2])
    for setting in ("algorithm", "learning_rate", "policy"):
        assert config[setting] == getattr(PRESETS[name][1], setting)


@pytest.mark.slow
def test_every_preset_makes_sense():
    """Its update is traced, not compiled."""
    for name, (line, config) in PRESETS.items():
        arguments = [name, "--horizon", "7"]
        if not config.env:
            config = dataclasses.replace(config, env="InvertedPendulum-v5")
            arguments += ["--env", config.env]
        check(config)
        assert 20 < len(line) < 100
        assert command_line.parse(arguments).base == dataclasses.replace(config, horizon=7)
        small = dataclasses.replace(config, num_seeds=1, horizon=7, engine="vmap")
        learner = build(envs.make(config.env), small).learner
        before = jax.eval_shape(learner.init, jax.random.key(0))
        after, _ = jax.eval_shape(learner.step, before)
        assert jax.tree.structure(after) == jax.tree.structure(before), name


def test_no_preset_is_the_default():
    assert command_line.parse([]).base == of_task("InvertedPendulum-v5")


@pytest.mark.parametrize(
    ("name", "std"),
    [
        ("gymnasium-tutorial", lambda x: np.log1p(np.exp(x))),
        ("baseline-truncated-normal", None),
        ("continuous-cartpole", lambda x: 1 / (1 + np.exp(-x))),
    ],
)
def test_network_outputs_mean_what_they_do_in_the_program(name, std):
    """The first is the mean itself; the second gives the std without a shift."""
    config = PRESETS[name][1]
    policy = build_policy(policy_settings(envs.make(config.env), config))
    outputs = jnp.array([0.3, -0.7])
    if std is None:  # a parameter that begins at log 1
        assert policy.distribution.constants == (0.0,)
        assert float(policy.distribution.mode(outputs)[0]) == pytest.approx(0.3)
    else:
        moved = policy.distribution.sample(outputs, jnp.array([2.0]))
        assert float(moved[0]) == pytest.approx(0.3 + 2 * std(-0.7), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["baseline-truncated-normal", "gymnasium-tutorial"])
def test_first_weights_are_pytorchs(name):
    """Uniform within 1 / sqrt(fan-in), biases too; the critic's as well."""
    config = PRESETS[name][1]
    learner = build(envs.make(config.env), config).learner
    state = jax.jit(jax.vmap(learner.init))(jax.random.split(jax.random.key(0), 50))
    params = [state.actor.params["network"]["params"]]
    if name == "baseline-truncated-normal":
        params.append(state.estimator_state.params["params"])
    for layer in [layer for network in params for layer in network.values()]:
        bound = layer["kernel"].shape[-2] ** -0.5
        for x in layer.values():
            assert 0.8 * bound < float(jnp.max(jnp.abs(x))) <= bound


def test_help_lists_presets_and_groups_without_jax():
    code = (
        "import sys\nfrom mjx_reinforce.runs import command_line\n"
        "try: command_line.parse(['--help', 'all'])\n"
        "except SystemExit: print('jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.endswith("False\n")
    for text in (*PRESETS, "policy options", "updates options"):
        assert text in done.stdout


@pytest.mark.parametrize("id", ["Hopper-v5", "CartPole-v1"])
@pytest.mark.parametrize("words", [["--algorithm", "ars"], []])
def test_defaults_that_a_policy_does_not_read_are_not_the_users(id, words):
    """Only what the command line itself says may be refused for doing nothing."""
    arguments = ["--env", id, *words]
    design = command_line.parse(arguments)
    config, default = design.base, design.default
    families = {"ars": "deterministic", "reinforce": "normal"}
    family = "categorical" if id.startswith("CartPole") else families[config.algorithm]
    check_read_by_policy(config, default, family)
    if family != "normal":
        changed = dataclasses.replace(config, initial_std=1.0)
        with pytest.raises(ValueError, match=r"--initial-std 1\.0 would do nothing"):
            check_read_by_policy(changed, default, family)


def test_a_preset_without_a_task_asks_for_one(run, tmp_path, capsys):
    assert run("legged", "--output", "out") == 2
    assert "no environment is named: add --env" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

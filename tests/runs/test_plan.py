"""What a run says before it starts: its defaults, its memory."""

import csv
import dataclasses
import functools
import os
from types import SimpleNamespace

import jax
import pytest
from one_slot import compile_run
from toys import Survive

import mjx_reinforce as mr
from mjx_reinforce import envs
from mjx_reinforce.engine import devices
from mjx_reinforce.engine.base import action_space
from mjx_reinforce.engine.memory import gigabytes
from mjx_reinforce.engine.play import choice
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.runs import command_line, plan
from mjx_reinforce.runs.design import Design, check_design
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import HORIZONS, MINUTES, PRESETS, of_task
from mjx_reinforce.setup import ready, room
from mjx_reinforce.training import slots


@pytest.fixture
def run(run):
    return functools.partial(run, "--env", "Survive-v0")


def updates(path):
    with (path / "metrics.csv").open(newline="") as file:
        return [int(row["update"]) for row in csv.DictReader(file)]


# Defaults.


def test_a_task_has_its_own_defaults_and_a_flag_wins_over_them():
    config = command_line.parse(["--seed", "3", "--env=Ant-v5", "--num-episodes", "9"]).base
    assert (config.env, config.eval_episodes, config.initial_std) == ("Ant-v5", 4, 0.2)
    assert config.env_steps == of_task("Ant-v5").env_steps
    assert config.hidden_sizes == Config().hidden_sizes
    assert config.num_episodes == 9
    config = command_line.parse(
        ["--env-steps", "None", "--env", "Ant-v5", "--eval-episodes", "9"]
    ).base
    assert (config.env_steps, config.eval_episodes) == (None, 9)
    for id in ("InvertedPendulum-v4", "InvertedPendulum-v5"):
        assert of_task(id).hidden_sizes == ()
    assert command_line.parse(["--env", "own:Task"]).base == Config(env="own:Task")


def test_a_preset_keeps_its_settings_on_another_task():
    config = command_line.parse(["baseline-truncated-normal", "--env", "Ant-v5"]).base
    assert config == dataclasses.replace(PRESETS["baseline-truncated-normal"][1], env="Ant-v5")


def test_help_shows_the_defaults_of_the_task(capsys):
    with pytest.raises(SystemExit):
        command_line.parse(["--help", "--env", "Ant-v5"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"(default: {of_task('Ant-v5').env_steps})" in said
    assert "Defaults depend on the task" in said


def test_what_is_known_of_tasks_is_of_ours():
    assert set(MINUTES) < set(HORIZONS) <= set(envs.names())


# Memory.


def test_sizes_are_for_people():
    said = {1: "1 MB", 3e6: "3 MB", 6e7: "0.1 GB", 1.24e9: "1.2 GB", 1.24e12: "1,240 GB"}
    assert {size: gigabytes(size) for size in said} == said


@pytest.mark.parametrize("settings", [{"num_seeds": 2**31}, {"hidden_sizes": (8, 2**31)}])
def test_what_no_memory_holds_is_refused(settings):
    with pytest.raises(ValueError, match=r"must be .*2\^31"):
        check_design(Design(base=Config(**settings)))


WIDE = (100_000, 100_000)


@pytest.mark.parametrize(
    ("settings", "traced", "needed"),
    [
        ({"hidden_sizes": WIDE, "num_seeds": 1}, None, "600"),  # 15 times 40 GB
        ({"hidden_sizes": WIDE, "num_seeds": 4}, (), "600"),  # of a sweep, at least one run
        ({"value_hidden_sizes": WIDE, "estimator": "value-baseline"}, None, "2,080"),
        ({"hidden_sizes": (2000, 2000), "num_seeds": 1000}, None, "241"),
        ({"hidden_sizes": WIDE, "algorithm": "ars", "num_seeds": 1}, None, "200"),
    ],
)
def test_networks_that_do_not_fit_into_memory_are_refused_before_anything_is_written_out(
    monkeypatch, settings, traced, needed
):
    monkeypatch.setattr(devices, "memory_here", lambda: 25e9)
    monkeypatch.setattr(choice, "choose", lambda *_: pytest.fail("an engine is made"))
    with pytest.raises(ValueError, match=r"does not fit into memory: .*lower --num-seeds") as error:
        ready.build_ready(Survive(), Config(num_episodes=4, horizon=8, **settings), traced=traced)
    assert f"it needs about {needed} GB, 25 GB are here" in str(error.value)


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize(
    "settings", [{}, {"optimizer": "sgd"}, {"update": "natural-gradient", "max_kl": 0.01}]
)
def test_what_is_foretold_of_networks_is_no_more_than_xla_says(monkeypatch, settings):
    """Nor less than a third: what XLA adds are copies."""
    sizes = {"num_seeds": 2, "num_episodes": 64, "horizon": 8, "eval_episodes": 1}
    config = Config(engine="vmap", hidden_sizes=(256, 256), **sizes, **settings)
    foretold, said = [], []
    monkeypatch.setattr(room, "_HOST_STATES", 0)
    monkeypatch.setattr(room, "check_room", foretold.append)
    monkeypatch.setattr(slots, "check_room", said.append)
    compile_run(ready.build_ready(Survive(), config).programs(), config)
    assert max(said) / 3 < foretold[0] <= max(said)


def test_a_network_of_python_that_does_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setattr(choice, "choose", lambda *_: pytest.fail("an engine is made"))
    env = Survive()
    policy = mr.mlp_policy(1, mr.normal(action_space(env)), (1_000_000, 1_000_000))
    with pytest.raises(ValueError, match=r"it needs about 12,000 GB"):
        mr.reinforce(env, policy=policy, horizon=8)
    search = mr.mlp_policy(1, mr.deterministic(action_space(env)), (1_000_000, 1_000_000))
    with pytest.raises(ValueError, match=r"it needs about 8,000 GB"):
        mr.ars(env, policy=search, horizon=8)
    network = MLP((1_000_000, 1_000_000), num_outputs=1)
    estimator = mr.value_baseline(horizon=8, network=network)  # and Adam's two moments
    with pytest.raises(ValueError, match=r"it needs about 24,000 GB"):
        mr.reinforce(env, estimator=estimator, horizon=8)


def test_an_update_of_more_steps_than_are_counted_is_refused():
    config = Config(num_episodes=2**20, horizon=2**11)
    with pytest.raises(ValueError, match=r"2,147,483,648 env steps .* lower --num-episodes or"):
        ready.build_ready(Survive(), config)


@pytest.mark.slow
def test_what_does_not_fit_into_memory_is_refused_before_it_runs(
    run, tmp_path, capsys, monkeypatch
):
    """By what XLA says of its programs; a sweep takes narrower slots where these fit."""
    arguments = ["--env", "Survive-v0", "--eval-episodes", "2", "--num-episodes", "64"]
    monkeypatch.setattr(devices, "memory_here", lambda: 3e4)
    assert run(*arguments, "--num-seeds", "2", "--output", "out") == 2
    assert "this does not fit into memory: it needs about 1 MB, 1 MB are" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def described(config):
    """What is said of a run."""
    return plan.describe(plan.make_plan(Design(base=config), {}, Survive(), pytest.fail))


def test_a_plan_says_what_is_known(monkeypatch):
    monkeypatch.setattr(plan, "num_cores", lambda: 3)
    text = described(Config(env="Survive-v0", env_steps=1600, engine="vmap"))
    assert text.startswith("Training 4 seeds of Survive-v0 by reinforce, 1,600 env steps each")
    assert "on 3 CPU cores, with the engine" in text


@pytest.mark.parametrize(
    ("seeds", "episodes", "said"),
    [
        (1, 7, "1 of the 4 devices here (mill)"),
        (1, 6, "3 of the 4 devices here (mill), which share the episodes of an update"),
        (8, 7, "4 of the 4 devices here (mill), which share the seeds"),
    ],
)
def test_a_plan_says_how_many_devices_compute(monkeypatch, seeds, episodes, said):
    devices = [SimpleNamespace(device_kind="mill")]
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    monkeypatch.setattr(jax, "local_devices", lambda: devices)
    config = Config(num_seeds=seeds, num_episodes=episodes)
    division = plan.divide_run(config)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert plan._describe_devices(division) == said


def test_alarms_are_silenced_for_the_command_line_alone(run, monkeypatch):
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    run("--num-seeds", "0")
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    run("--num-seeds", "0")
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"


def test_half_cheetah_warns_of_nothing(capfd):
    envs.make("HalfCheetah-v5")
    assert "deprecated" not in "".join(capfd.readouterr())


def test_a_block_has_room_for_what_the_budget_can_need():
    config = Config(num_episodes=10, env_steps=2005, eval_every=10**6)
    assert config.block_length == 201  # an episode has one step at least
    assert (dataclasses.replace(config, max_updates=150)).block_length == 150
    # The budget does not show in a block that is short anyway.
    short = dataclasses.replace(config, eval_every=100)
    assert short.block_length == (dataclasses.replace(short, max_updates=1)).block_length == 100


@pytest.mark.slow
def test_another_budget_compiles_nothing(run, tmp_path):
    events = []
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    arguments = ["--hidden-sizes", "3", "--num-seeds", "3"]
    assert run(*arguments, "--max-updates", "3", "--output", "first") == 0
    events.clear()
    assert run(*arguments, "--max-updates", "8", "--env-steps", "99999", "--output", "second") == 0
    assert updates(tmp_path / "second")[::3] == [0, 5, 8]
    assert "/jax/compilation_cache/cache_hits" in events
    assert "/jax/compilation_cache/cache_misses" not in events

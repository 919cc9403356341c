"""What a run says before it starts: its defaults, its memory, its signs of life."""

import csv
import dataclasses
import functools
import os
import subprocess
import sys

import jax
import pytest
from toys import Survive

from mjx_reinforce import envs
from mjx_reinforce.engine.memory import gigabytes
from mjx_reinforce.runs import command_line, plan
from mjx_reinforce.settings import tables
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.settings.tables import PRESETS, Task
from mjx_reinforce.store import ready
from mjx_reinforce.training.division import divide_run


@pytest.fixture
def run(run):
    return functools.partial(run, "--env", "Survive-v0")


def updates(path):
    with (path / "metrics.csv").open(newline="") as file:
        return [int(row["update"]) for row in csv.DictReader(file)]


# Defaults.


def test_a_task_has_its_own_defaults_and_a_flag_wins_over_them():
    config = command_line.parse(["--seed", "3", "--env=Ant-v5", "--num-episodes", "9"])
    assert (config.env, config.eval_episodes, config.initial_std) == ("Ant-v5", 4, 0.2)
    assert config.env_steps == of_task("Ant-v5").env_steps
    assert config.hidden_sizes == Config().hidden_sizes
    assert config.num_episodes == 9
    config = command_line.parse(["--env-steps", "None", "--env", "Ant-v5", "--eval-episodes", "9"])
    assert (config.env_steps, config.eval_episodes) == (None, 9)
    for id in ("InvertedPendulum-v4", "InvertedPendulum-v5"):
        assert of_task(id).hidden_sizes == ()
    assert command_line.parse(["--env", "own:Task"]) == Config(env="own:Task")


def test_a_preset_keeps_its_settings_on_another_task():
    config = command_line.parse(["baseline-truncated-normal", "--env", "Ant-v5"])
    assert config == dataclasses.replace(PRESETS["baseline-truncated-normal"][1], env="Ant-v5")


def test_help_shows_the_defaults_of_the_task(capsys):
    with pytest.raises(SystemExit):
        command_line.parse(["--help", "--env", "Ant-v5"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"(default: {of_task('Ant-v5').env_steps})" in said
    assert "Defaults depend on the task" in said


def test_what_was_measured_are_our_tasks():
    assert set(tables.MINUTES) < set(tables.TASKS) <= set(envs.names())


# Memory.

TASK = Task(3, 2, 100, 0.0)
CONFIG = Config(num_seeds=2, hidden_sizes=(4,), num_episodes=8)


def needed_by(**changes):
    return plan.needed(dataclasses.replace(CONFIG, **changes), TASK)


def test_a_network_has_a_weight_for_every_pair_and_a_bias():
    assert (TASK.observation, TASK.action) == (3, 2)
    assert plan.num_parameters(CONFIG, TASK) == (3 + 1) * 4 + (4 + 1) * 4
    assert plan.critic_parameters(CONFIG, TASK) == 0
    critic = dataclasses.replace(CONFIG, estimator="value-baseline", value_hidden_sizes=(5,))
    assert plan.critic_parameters(critic, TASK) == (3 + 1) * 5 + (5 + 1)
    ars = dataclasses.replace(critic, algorithm="ars")
    assert plan.critic_parameters(ars, TASK) == 0


def test_seeds_side_by_side_need_as_much_each():
    assert needed_by(num_seeds=200) == pytest.approx(100 * needed_by())


@pytest.mark.parametrize(
    "more",
    [
        {"num_episodes": 16},
        {"horizon": 200},
        {"hidden_sizes": (64, 64)},
        {"eval_episodes": 100},
        {"estimator": "value-baseline"},
    ],
)
def test_more_of_anything_needs_more(more):
    assert needed_by(**more) > needed_by()


def test_what_a_program_needs_besides_counts():
    total = needed_by()
    plan.check_fits(CONFIG, TASK, total + 10, 10)
    with pytest.raises(ValueError, match="does not fit"):
        plan.check_fits(CONFIG, TASK, total + 9, 10)


def test_sizes_are_for_people():
    said = {1: "1 MB", 3e6: "3 MB", 6e7: "0.1 GB", 1.24e9: "1.2 GB", 1.24e12: "1,240 GB"}
    assert {size: gigabytes(size) for size in said} == said


@pytest.mark.parametrize(
    ("settings", "remedy"),
    [
        ({"num_seeds": 10**6}, "lower --num-seeds"),
        ({"horizon": 10**9}, "or --train-horizon"),
        ({"num_episodes": 10**6}, "--num-episodes"),
        ({"hidden_sizes": (400_000,)}, "lower --hidden-sizes"),
        ({"hidden_sizes": (100_000, 100_000)}, "lower --hidden-sizes"),
        ({"eval_episodes": 10**7}, "lower --eval-episodes"),
        ({"eval_every": 10**9, "env_steps": None, "max_updates": 10**9}, "lower --eval-every"),
        ({"estimator": "value-baseline", "value_hidden_sizes": (10**6,)}, "--value-hidden-sizes"),
        (
            {"value_hidden_sizes": (30_000, 30_000), "num_episodes": 1, "horizon": 2}
            | {"estimator": "value-baseline"},
            "--value-hidden-sizes",
        ),
        ({"estimator": "value-baseline", "value_batch_size": 10**8}, "lower --value-batch-size"),
        ({"num_seeds": 2**31}, "--num-seeds must be less than 2^31, got 2147483648"),
        ({"hidden_sizes": (8, 2**40)}, "--hidden-sizes must be less than 2^31"),
    ],
)
def test_what_cannot_be_is_refused(monkeypatch, settings, remedy):
    monkeypatch.setattr(plan, "host_memory", lambda: 24e9)
    monkeypatch.setattr(plan, "may_have_accelerator", lambda: False)
    with pytest.raises(ValueError, match=r".") as refusal:
        plan.check_memory(Config(**settings))
    assert remedy in str(refusal.value)
    assert str(refusal.value).count("\n") <= 1


def test_a_laptop_holds_every_tasks_defaults(monkeypatch):
    monkeypatch.setattr(plan, "host_memory", lambda: 8e9)
    for id in tables.TASKS:
        plan.check_memory(of_task(id))


def test_the_memory_is_what_xla_says():
    """And not much more; a process takes more besides."""
    pendulum = of_task("InvertedPendulum-v5")
    many = dataclasses.replace(pendulum, num_seeds=1000, max_updates=3, num_episodes=16)
    value = {"algorithm": "baseline-truncated-normal"}
    for config, settings, size, factor in (
        (many, {}, 1.16, 1.7),
        (Config(), {"hidden_sizes": (20_000,)}, 1.28, 1.25),
        (pendulum, value | {"value_hidden_sizes": (20_000,), "num_episodes": 16}, 10.25, 1.2),
        (pendulum, value | {"value_hidden_sizes": (3000, 3000), "num_episodes": 4}, 1.25, 1.2),
    ):
        config = dataclasses.replace(config, **settings)
        needed = plan.needed(config, tables.TASKS[config.env])
        assert size * 1e9 < needed < factor * size * 1e9, settings


def test_a_refusal_comes_before_jax(tmp_path):
    code = (
        "import sys\nfrom mjx_reinforce import train\n"
        "try: train.main()\n"
        "except SystemExit as stop: print(stop.code, 'jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "--num-seeds", "1000000"],
        check=True,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )
    assert done.stdout == "2 False\n"
    assert "does not fit into memory" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_accelerators_memory_counts_where_there_is_one(monkeypatch):
    monkeypatch.setattr(plan, "may_have_accelerator", lambda: True)
    config = Config(env="Survive-v0", num_seeds=10**5, max_updates=1)
    plan.check_memory(config)  # it is not known before JAX is imported
    machine = plan.Hardware("a GPU", 1e8, shared=False)
    monkeypatch.setattr(plan, "this_hardware", lambda: machine)
    env = Survive()
    made = ready.made(env, config)
    with pytest.raises(ValueError, match=r"memory.*0\.1 GB are here"):
        plan.make_plan(made, config)


def test_a_plan_says_what_is_known(monkeypatch):
    monkeypatch.setattr(plan, "this_hardware", lambda: plan.Hardware("3 mills", 1e9, True))
    monkeypatch.setitem(tables.TASKS, "Survive-v0", Task(1, 1, 20, 5e8))
    config = Config(env="Survive-v0", env_steps=1600, engine="vmap")
    made = ready.made(Survive(), config)
    text = plan.make_plan(made, config)
    assert text.startswith("Training 4 seeds of Survive-v0 by reinforce, 1,600 env steps each")
    assert "on 3 mills, with the engine" in text
    assert "0.5 GB of memory" in text


@pytest.mark.parametrize(
    ("seeds", "episodes", "said"),
    [
        (1, 7, "a GPU, the first of the 4 here,"),
        (1, 6, "3 of the 4 devices here (a GPU each), which share the episodes of an update"),
        (8, 7, "4 devices (a GPU each), which share the seeds"),
    ],
)
def test_a_plan_says_how_many_devices_compute(monkeypatch, seeds, episodes, said):
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    config = Config(num_seeds=seeds, num_episodes=episodes)
    assert plan._where(plan.Hardware("a GPU", 1e9, False), divide_run(config)) == said


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

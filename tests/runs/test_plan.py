"""What a run says before it starts: its defaults, its time, its memory, its signs of life."""

import csv
import dataclasses
import functools
import os
import subprocess
import sys
import time

import jax
import pytest
from toys import Survive

from mjx_reinforce import envs
from mjx_reinforce import train as train_module
from mjx_reinforce.console.heartbeat import heartbeat
from mjx_reinforce.runs import command_line, plan
from mjx_reinforce.settings import measured, memory
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import of_task
from mjx_reinforce.settings.measured import Speed, Task
from mjx_reinforce.settings.presets import PRESETS
from mjx_reinforce.store import ready
from mjx_reinforce.training.division import divide_run


@pytest.fixture
def run(run):
    return functools.partial(run, "--env", "Survive-v0")


def updates(path):
    with (path / "metrics.csv").open(newline="") as file:
        return [int(row["update"]) for row in csv.DictReader(file)]


# Defaults.


@pytest.mark.parametrize("arguments", [["--env", "Ant-v5"], ["--seed", "3", "--env=Ant-v5"]])
def test_a_task_has_its_own_defaults(arguments):
    config = command_line.parse(arguments)
    assert (config.env, config.eval_episodes, config.initial_std) == ("Ant-v5", 4, 0.2)
    assert config.env_steps == of_task("Ant-v5").env_steps
    assert config.hidden_sizes == Config().hidden_sizes


def test_a_flag_wins_over_the_tasks_default():
    config = command_line.parse(["--env-steps", "7", "--env", "Ant-v5", "--eval-episodes", "9"])
    assert (config.env_steps, config.eval_episodes) == (7, 9)
    assert command_line.parse(["--env-steps", "None", "--env", "Ant-v5"]).env_steps is None


def test_the_pendulum_has_a_linear_policy():
    for id in ("InvertedPendulum-v4", "InvertedPendulum-v5"):
        assert command_line.parse(["--env", id]).hidden_sizes == ()
    assert command_line.parse(["--hidden-sizes", "32", "32"]).hidden_sizes == (32, 32)


def test_a_task_without_an_entry_has_the_plain_defaults():
    assert command_line.parse(["--env", "own:Task"]) == Config(env="own:Task")


def test_a_preset_keeps_its_settings_on_another_task():
    config = command_line.parse(["baseline-truncated-normal", "--env", "Ant-v5"])
    assert config == dataclasses.replace(PRESETS["baseline-truncated-normal"][1], env="Ant-v5")


def test_help_shows_the_defaults_of_the_task(capsys):
    ant = str(of_task("Ant-v5").env_steps)
    for arguments, default in ((["--help"], "280000"), (["--help", "--env", "Ant-v5"], ant)):
        with pytest.raises(SystemExit):
            command_line.parse(arguments)
        said = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert f"(default: {default})" in said
        assert "Defaults depend on the task" in said


def test_what_was_measured_are_our_tasks():
    assert set(measured.TASKS) == set(measured.CPU) == set(measured.GPU) <= set(envs.names())


# Memory.


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
        ({"algorithm": "ars", "num_directions": 10**6}, "--num-directions or --train-horizon"),
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
    monkeypatch.setattr(memory, "host_memory", lambda: 24e9)
    monkeypatch.setattr(memory, "_may_have_accelerator", lambda: False)
    with pytest.raises(ValueError, match=r".") as refusal:
        memory.check_memory(Config(**settings))
    assert remedy in str(refusal.value)
    assert str(refusal.value).count("\n") <= 1


@pytest.mark.parametrize("id", measured.TASKS)
def test_a_laptop_holds_every_tasks_defaults(monkeypatch, id):
    monkeypatch.setattr(memory, "host_memory", lambda: 8e9)
    memory.check_memory(of_task(id))


def test_the_memory_of_a_thousand_seeds():
    """XLA says 1.16 GB, and what the process took in all was 1.9 GB."""
    config = dataclasses.replace(
        of_task("InvertedPendulum-v5"), num_seeds=1000, max_updates=3, num_episodes=16
    )
    assert 1.16e9 < memory.needed(config, measured.TASKS[config.env]) < 2e9


def test_the_memory_of_a_wide_network():
    """XLA says 1.28 GB for four seeds of 20,000 units."""
    config = dataclasses.replace(Config(), hidden_sizes=(20_000,))
    assert 1.28e9 < memory.needed(config, measured.TASKS[config.env]) < 1.6e9


@pytest.mark.parametrize(
    ("sizes", "episodes", "gigabytes"), [((20_000,), 16, 10.25), ((3000, 3000), 4, 1.25)]
)
def test_the_memory_of_a_value_network(sizes, episodes, gigabytes):
    """As XLA says, for four seeds."""
    settings = {"estimator": "value-baseline", "value_fit": "full-batch"}
    settings |= {"value_hidden_sizes": sizes}
    config = dataclasses.replace(of_task("InvertedPendulum-v5"), num_episodes=episodes, **settings)
    needed = memory.needed(config, measured.TASKS[config.env])
    assert gigabytes * 1e9 < needed < 1.2 * gigabytes * 1e9


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
    monkeypatch.setattr(memory, "_may_have_accelerator", lambda: True)
    config = Config(env="Survive-v0", num_seeds=10**5, max_updates=1)
    memory.check_memory(config)  # it is not known before JAX is imported
    machine = plan.Hardware("a GPU", {}, 1.0, 1e8, shared=False)
    monkeypatch.setattr(plan, "this_hardware", lambda: machine)
    env = Survive()
    made = ready.made(env, config)
    with pytest.raises(ValueError, match=r"memory.*0\.1 GB are here"):
        plan.make_plan(made, config)


# Time.


def test_the_time_of_a_run_by_hand():
    task = Task(observation=4, action=1, horizon=100, useful=0.5, base_memory=0.0)
    speed = Speed("vmap", 10.0, latency=0.01, rate=1000.0)
    config = Config(num_seeds=2, num_episodes=5, env_steps=1000, eval_every=2, eval_episodes=5)
    # 1000 / 0.5 steps a seed, twice that with evaluations, two seeds; 10 at a time take 0.02 s.
    assert plan.training_seconds(config, task, speed) == (pytest.approx(8000 / 10 * 0.02), False)
    native = plan.training_seconds(config, task, speed._replace(engine="native"))
    assert native == (pytest.approx(4000 / 10 * 0.02), False)  # no episode waits for another
    # Two updates of 5 episodes of at most 100 steps are fewer.
    config = dataclasses.replace(config, max_updates=2)
    assert plan.training_seconds(config, task, speed) == (pytest.approx(4000 / 10 * 0.02), True)
    # Cut after 25 steps, they take 250 steps; an evaluation plays 10 episodes, which are whole.
    config = dataclasses.replace(config, train_horizon=25)
    assert plan.training_seconds(config, task, speed) == (pytest.approx(2500 / 10 * 0.02), True)


def test_the_operations_of_networks_by_hand():
    """A policy of 1,282 parameters, a value network of 97: 5 to 16, 16 to 1, with biases."""
    task, plain = Task(4, 1, 50, 1.0, 0.0), Config(estimator="reward-to-go")
    assert memory.operations_per_step(plain, task) == 10 * 1282
    value = dataclasses.replace(
        plain,
        estimator="value-baseline",
        value_hidden_sizes=(16,),
        value_fit="full-batch",
        value_fits=3,
    )
    assert memory.operations_per_step(value, task) == 10 * 1282 + (2 + 6 * 3) * 97
    # 3 minibatches of 400 are 1.5 times the 16 * 50 steps of a rollout.
    fitted = dataclasses.replace(value, value_fit="minibatches", value_batch_size=400)
    assert memory.operations_per_step(fitted, task) == 10 * 1282 + (2 + 6 * 1.5) * 97
    # 50 minibatches of 128 are 8 times the 16 * 50 steps of a rollout.
    drawn = dataclasses.replace(plain, update="minibatches")
    assert memory.operations_per_step(drawn, task) == (4 + 6 * 8) * 1282
    natural = dataclasses.replace(plain, update="natural-gradient", natural_iterations=3)
    assert memory.operations_per_step(natural, task) == (4 + 6 * (1 + 3)) * 1282
    few = dataclasses.replace(natural, num_episodes=2 * 4096 // 50, hidden_sizes=(32, 32))
    assert memory.operations_per_step(few, task) == pytest.approx((4 + 6 * 2.5) * 1282, rel=0.01)
    assert memory.operations_per_step(dataclasses.replace(value, algorithm="ars"), task) == 2 * 1282


#: Env steps of all seeds, and the processor's time that training and evaluating them took (s), on
#: 2026-11-24, beside other programs.
TRAINED = [
    ("ContinuousCartPole-v0", 32, {}, 383_715, 0.21),
    ("ContinuousCartPole-v0", 32, {"value_hidden_sizes": (16,)}, 372_424, 0.48),
    ("ContinuousCartPole-v0", 32, {"value_fits": 10}, 377_492, 2.99),
    ("ContinuousCartPole-v0", 32, {"value_fits": 40}, 126_694, 4.71),
    ("ContinuousCartPole-v0", 16, {"value_hidden_sizes": (256, 256)}, 62_554, 4.56),
    ("ContinuousCartPole-v0", 32, {"hidden_sizes": (128, 128)}, 379_775, 2.10),
    ("ContinuousCartPole-v0", 32, {"update": "minibatches"}, 241_520, 0.93),
    ("ContinuousCartPole-v0", 32, {"update": "each-step"}, 156_543, 0.24),
    ("InvertedPendulum-v5", 16, {"hidden_sizes": (32, 32)}, 467_649, 0.82),
    ("InvertedPendulum-v5", 16, {"value_fits": 10}, 603_998, 9.32),
    ("Swimmer-v5", 4, {"value_fits": 10}, 160_000, 1.23),
]


@pytest.mark.parametrize(("env", "seeds", "settings", "steps", "seconds"), TRAINED)
def test_estimates_are_good_to_a_factor_of_three(env, seeds, settings, steps, seconds):
    if any(name.startswith("value") for name in settings):
        fitted = {"value_fit": "full-batch", "value_fits": 10}
        settings = {"estimator": "value-baseline"} | fitted | settings
    config = dataclasses.replace(of_task(env), num_seeds=seeds, **settings)
    config = dataclasses.replace(config, env_steps=steps // seeds)
    machine = plan.Hardware("two cores", measured.CPU, 1.0, 1e10, shared=True)
    task, speed = measured.TASKS[env], measured.CPU[env]
    said, bounded = plan.run_seconds(config, task, machine, speed)
    assert not bounded
    assert seconds / 2 / 3 < said < seconds / 2 * 3


def test_a_wrong_estimate_is_corrected_once_it_shows():
    made = plan.Plan("", 8.0, 10.0, bounded=False)
    said = "training takes about 2 min in all, not about 5 s to 20 s as was said"
    assert made.correction(120.0) == said
    assert made.correction(29.0) is None  # less than three times as long
    assert made.correction(float("nan")) is None
    assert plan.Plan("", 8.0, 1.0).correction(9.0) is None  # nobody waits for 8 s
    slow = plan.Plan("", 8.0, 600.0)
    assert slow.correction(60.0) is not None
    bounded = slow._replace(bounded=True)
    assert bounded.correction(60.0) is None  # it said "at most"
    assert "1.7 h in all, not at most 10 min as" in (bounded.correction(6000.0) or "")
    assert plan.Plan("", None).correction(1e9) is None


def test_a_run_says_once_that_it_takes_another_time(run, monkeypatch, capsys):
    plans = lambda *args: plan.Plan("a plan", 8.0, 1e5)  # noqa: E731
    monkeypatch.setattr(train_module, "make_plan", plans)
    assert run("--max-updates", "120", "--output", "out", "--hidden-sizes") == 0
    lines = capsys.readouterr().out.splitlines()
    corrected = [
        n for n, line in enumerate(lines) if "in all, not about 14 h to 56 h as was said" in line
    ]
    assert len(corrected) == 1
    assert lines[corrected[0] - 1].startswith("update    30")  # a quarter of 120


@pytest.mark.parametrize(
    ("size", "said"),
    [(2e5, "1 MB"), (2.64e7, "26 MB"), (1e8, "0.1 GB"), (5e8, "0.5 GB"), (1.23e10, "12 GB")],
)
def test_memory_is_never_nothing(size, said):
    assert memory.gigabytes(size) == said


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.2, "1 s"),
        (8.44, "8.4 s"),
        (99.9, "100 s"),
        (128, "2.1 min"),
        (9e3, "2.5 h"),
        (4e6, "1100 h"),
    ],
)
def test_durations_are_for_people(seconds, said):
    assert plan.duration(seconds) == said


@pytest.mark.parametrize("engine", ["vmap", "native"])
def test_a_plan_says_what_is_known(monkeypatch, engine):
    speeds = {"Survive-v0": Speed("vmap", 40.0, 1.0, 1e9)}
    monkeypatch.setattr(
        plan, "this_hardware", lambda: plan.Hardware("3 mills", speeds, 2, 1e9, True)
    )
    monkeypatch.setitem(measured.TASKS, "Survive-v0", Task(1, 1, 20, 0.5, 5e8))
    config = Config(env="Survive-v0", env_steps=1600, engine=engine)
    env = Survive()
    text, compiling, *_ = plan.make_plan(ready.made(env, config), config)
    assert text.startswith("Training 4 seeds of Survive-v0 by reinforce, 1,600 env steps each, on")
    assert "on 3 mills, with the engine" in text
    assert "0.5 GB of memory" in text
    if engine == "vmap":  # 1600 / 0.5 * 1.4 / 16 steps of a second, at twice the speed
        assert compiling == 40
        assert "takes about 20 s to 80 s" in text
        assert "training about 70 s to 4.7 min, more if some seeds' episodes stay short" in text
    else:
        assert compiling is None
        assert "is not known" in text


@pytest.mark.parametrize(
    ("seeds", "episodes", "here", "idle"),
    [(1, 7, 4, 3), (1, 6, 4, 1), (5, 16, 4, None), (9, 7, 4, 1), (1, 8, 4, None), (1, 8, 1, None)],
)
def test_a_plan_says_how_many_devices_stand_idle(monkeypatch, seeds, episodes, here, idle):
    monkeypatch.setattr(jax, "local_device_count", lambda: here)
    config = Config(num_seeds=seeds, num_episodes=episodes)
    said = plan._idle(plan.this_hardware(), divide_run(config))
    verb = "stands" if idle == 1 else "stand"
    assert said == "" if idle is None else f"Of {here} devices here, {idle} {verb} idle" in said


def test_a_run_begins_with_its_plan(run, capsys):
    assert run("--max-updates", "2", "--output", "out", "--hidden-sizes") == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("Training 4 seeds of Survive-v0")
    assert "280,000 env steps or 2 updates each" in first


# While it compiles and after.


def test_a_heartbeat_beats_until_the_end():
    said = []
    with heartbeat(said.append, 40.0, interval=0.01):
        deadline = time.monotonic() + 10
        while len(said) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
    count = len(said)
    assert count >= 2
    assert said[0] == "still compiling, 0 s; about 40 s expected"
    time.sleep(0.05)
    assert len(said) == count


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


def test_a_block_ends_with_the_budget(run, tmp_path):
    arguments = ["--max-updates", "7", "--hidden-sizes", "--num-seeds", "1"]
    assert run(*arguments, "--eval-every", "1000000", "--output", "long") == 0
    assert run(*arguments, "--eval-every", "7", "--output", "short") == 0
    assert updates(tmp_path / "long") == updates(tmp_path / "short") == [0, 7]
    ours, theirs = ((tmp_path / name / "policy" / "actor.npz") for name in ("long", "short"))
    assert ours.read_bytes() == theirs.read_bytes()


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

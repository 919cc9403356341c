"""Several processes: on devices of their own, one run among them, and what follows a death."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from places import PYTHONPATH

from mjx_reinforce.hosts import processes as module
from mjx_reinforce.hosts.processes import ProcessSettings, check_processes, joined
from mjx_reinforce.hosts.shares import _together_in_time

PENDULUM = "--env InvertedPendulum-v5 --num-episodes 4 --eval-episodes 2 --hidden-sizes 4"
PENDULUM += " --env-steps None --max-updates 6"
FOREVER = "--env toys:Drift --num-episodes 4 --eval-episodes 2 --hidden-sizes 4 --num-seeds 3"
FOREVER += " --env-steps None --max-updates 2000000 --output out"


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def start_two(folder, *line):
    """Two processes of a program, each with what it says in a file of its own."""
    environment = os.environ | {"PYTHONPATH": PYTHONPATH}
    started = []
    for index in range(2):
        command = [sys.executable, *line]
        if line[0] == "-m":
            command += ["--process-id", str(index)]
        with (folder / f"said-{index}.txt").open("wb") as said:
            each = command if line[0] == "-m" else [*command, str(index)]
            started.append(
                subprocess.Popen(each, cwd=folder, env=environment, stdout=said, stderr=said)
            )
    return started


def train_two(folder, program, command):
    hosts = f"--distributed --coordinator localhost:{free_port()} --num-processes 2"
    return start_two(folder, "-m", f"mjx_reinforce.{program}", *command.split(), *hosts.split())


def said(folder, index):
    return (folder / f"said-{index}.txt").read_text()


def finish(folder, started, seconds=300):
    codes = [process.wait(timeout=seconds) for process in started]
    assert all("Traceback" not in said(folder, i) for i in range(2)), said(folder, 0)
    return codes


def train_alone(folder, program, command):
    line = [sys.executable, "-m", f"mjx_reinforce.{program}", *command.split()]
    subprocess.run(line, cwd=folder, check=True, capture_output=True)


USER = """
import sys
import jax
jax.distributed.initialize("localhost:{port}", 2, int(sys.argv[1]))
from mjx_reinforce import envs
env = envs.make("InvertedPendulum-v5")
state = jax.jit(env.reset)(jax.random.key(0))
print(env.num_contacts, jax.jit(env.step)(state, jax.numpy.zeros(1)).obs)
"""


@pytest.mark.cpu  # each process needs a GPU of its own
def test_a_task_is_on_the_device_of_its_process(tmp_path):
    """Where the user's program starts several, and JAX's first device is another's."""
    started = start_two(tmp_path, "-c", USER.format(port=free_port()))
    assert finish(tmp_path, started) == [0, 0]


@pytest.mark.cpu
def test_two_processes_share_a_sweep(tmp_path):
    command = f"{PENDULUM} --num-seeds 3 --over learning-rate 1e-2 1e-1"
    assert finish(tmp_path, train_two(tmp_path, "sweep", f"{command} --output two")) == [0, 0]
    train_alone(tmp_path, "sweep", f"{command} --output one")
    assert len(list((tmp_path / "two" / "parts").glob("[0-9]*.npz"))) == 2
    one, two = (np.load(tmp_path / name / "curves.npz") for name in ("one", "two"))
    for name in one.files:
        np.testing.assert_allclose(one[name], two[name], rtol=1e-4)
    assert len((tmp_path / "two" / "results.csv").read_text().splitlines()) == 1 + 6
    assert json.loads((tmp_path / "two" / "sweep.json").read_text())["status"] == "finished"


@pytest.mark.cpu
@pytest.mark.parametrize("devices", [1, 2])
def test_two_processes_share_a_run(tmp_path, monkeypatch, devices):
    """Of two devices each, those of the first share its seed's episodes, the others two seeds."""
    command = f"{PENDULUM} --num-seeds 3"
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", flags)
        assert finish(tmp_path, train_two(tmp_path, "train", f"{command} --output two")) == [0, 0]
    assert "on 2 processes, each on" in said(tmp_path, 0)
    train_alone(tmp_path, "train", f"{command} --output one")
    one, two = (list(csv.DictReader((tmp_path / x / "metrics.csv").open())) for x in ("one", "two"))
    assert [row["seed"] for row in two] == [row["seed"] for row in one]
    for ours, theirs in zip(one, two, strict=True):
        del ours["wall_seconds"], theirs["wall_seconds"]
        for name in ours:
            np.testing.assert_allclose(
                float(ours[name] or "nan"), float(theirs[name] or "nan"), rtol=1e-2, err_msg=name
            )
    arrays = [np.load(tmp_path / name / "returns.npz") for name in ("one", "two")]
    for name in arrays[0].files:
        np.testing.assert_allclose(arrays[0][name], arrays[1][name], rtol=1e-3)
    summary = json.loads((tmp_path / "two" / "summary.json").read_text())
    assert len(summary["final_test_returns"]) == 3
    assert json.loads((tmp_path / "two" / "config.json").read_text())["num_processes"] == 2


def begun(folder):
    return any((folder / "out" / name).exists() for name in ("metrics.csv", "sweep.json"))


def wait_until(condition, seconds=200):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.cpu
@pytest.mark.parametrize(("program", "victim"), [("train", 1), ("sweep", 0)])
def test_a_death_ends_the_other_process_with_the_name(tmp_path, program, victim):
    over = " --over learning-rate 1e-2 1e-1" * (program == "sweep")
    started = train_two(tmp_path, program, FOREVER + over)
    wait_until(lambda: begun(tmp_path))
    started[victim].kill()
    assert started[1 - victim].wait(timeout=30) == 1
    last = said(tmp_path, 1 - victim).splitlines()[-1]
    name = f"process {victim} (host {socket.gethostname()}, pid {started[victim].pid})"
    assert last.startswith(f"error: {name} is gone")
    assert "Traceback" not in said(tmp_path, 1 - victim)


@pytest.mark.cpu
@pytest.mark.parametrize("program", ["train", "sweep"])
def test_a_signal_to_one_process_stops_all(tmp_path, program):
    over = " --over learning-rate 1e-2 1e-1" * (program == "sweep")
    started = train_two(tmp_path, program, FOREVER + over)
    wait_until(lambda: begun(tmp_path))
    time.sleep(2)
    started[1].send_signal(signal.SIGTERM)
    assert finish(tmp_path, started, 60) == [143, 143]
    name = "summary.json" if program == "train" else "sweep.json"
    assert json.loads((tmp_path / "out" / name).read_text())["status"] == "interrupted"
    if program == "train":  # with as many processes it goes on
        alone = [sys.executable, "-m", "mjx_reinforce.train", "--resume", "out"]
        alone += ["--env", "toys:Drift"]
        environment = os.environ | {"PYTHONPATH": PYTHONPATH}
        refused = subprocess.run(alone, cwd=tmp_path, env=environment, capture_output=True)
        assert b"was begun on 2 processes, and here there are 1" in refused.stderr


class Listener:
    """Takes the place of ``Interrupt``."""

    def __init__(self):
        self.number, self.left = None, []

    def ask(self, number):
        self.number = number

    def leave(self, status, say):
        self.left.append(status)


@pytest.fixture(autouse=True)
def silent(monkeypatch):
    """Threads that still wait when their test is over say nothing in the tests after it."""
    monkeypatch.setattr(module, "to_screen", lambda text: None)


def join_all(count, changes=None, common=None):
    """What each of some processes, here threads, comes to: its Processes, or what it raised."""
    port, found, leave = free_port(), {}, threading.Event()

    def join(index):
        settings = {"num_processes": count, "process_id": index} | (changes or {}).get(index, {})
        settings = ProcessSettings(distributed=True, coordinator=f"localhost:{port}", **settings)
        try:
            with joined(settings, Listener(), (common or {}).get(index, {"jax": "1"})) as processes:
                found[index] = processes
                met.append(processes.meet())
                leave.wait(20)
        except ValueError as error:
            found[index] = str(error)

    met = []
    threads = [threading.Thread(target=join, args=(i,), daemon=True) for i in range(count)]
    for thread in threads:
        thread.start()
    wait_until(lambda: 0 in found and (isinstance(found[0], str) or len(met) == count), 20)
    leave.set()
    return found, met


def test_three_processes_meet():
    found, met = join_all(3)
    assert met == [True] * 3
    assert [found[i].index for i in range(3)] == [0, 1, 2]
    assert found[2].names == found[0].names
    assert found[1].names[2].startswith(f"process 2 (host {socket.gethostname()}, pid ")
    assert found[0].shares(7) == [slice(0, 2), slice(2, 4), slice(4, 7)]
    with pytest.raises(ValueError, match="--num-seeds 2 is less than the 3 processes"):
        found[0].shares(2)


@pytest.mark.parametrize(
    ("changes", "common", "words"),
    [
        ({1: {"num_processes": 5}}, None, "is one of 5, and this of 2"),
        ({}, {1: {"jax": "0"}}, "jax is 0 in process 1"),
    ],
)
def test_processes_that_do_not_belong_together_are_refused(changes, common, words):
    found, _ = join_all(2, changes, common)
    assert words in found[0]


def test_two_processes_of_one_number_are_refused():
    found, _ = join_all(3, {2: {"process_id": 1}})
    assert "there are two processes 1" in found[0]


def test_who_does_not_come_is_named(monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE", 0.3)
    for index, words in ((0, "process 1 of 2 did not come"), (1, "process 0 did not answer at")):
        settings = ProcessSettings(
            distributed=True,
            coordinator=f"localhost:{free_port()}",
            num_processes=2,
            process_id=index,
        )
        with pytest.raises(ValueError, match=words), joined(settings, Listener(), {}):
            pass


def test_a_port_in_use_is_named():
    with socket.socket() as used:
        used.bind(("localhost", 0))
        used.listen()
        where = f"localhost:{used.getsockname()[1]}"
        settings = ProcessSettings(
            distributed=True, coordinator=where, num_processes=2, process_id=0
        )
        with pytest.raises(ValueError, match="cannot listen"), joined(settings, Listener(), {}):
            pass


def test_slurm_says_who_is_who(monkeypatch):
    for name, value in {
        "SLURM_JOB_ID": "5",
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "1",
        "SLURM_PROCID": "0",
        "SLURM_LOCALID": "0",
    }.items():
        monkeypatch.setenv(name, value)
    coordinator, count, index = module._who(ProcessSettings(distributed=True))
    assert (coordinator.partition(":")[0], count, index) == ("localhost", 1, 0)


def test_nobody_says_who_is_who():
    with pytest.raises(ValueError, match="none of SLURM, Open MPI and Kubernetes"):
        module._who(ProcessSettings(distributed=True))


@pytest.mark.parametrize("where", ["here", "here:", "here:x", ":4", "here:70000", "here:0"])
def test_a_coordinator_is_host_and_port(where):
    settings = ProcessSettings(distributed=True, coordinator=where, num_processes=2, process_id=0)
    with pytest.raises(ValueError, match="must be HOST:PORT"):
        check_processes(settings)


def test_seeds_of_a_process_that_made_fewer_updates_stand_still():
    longer = {
        "active": np.ones((3, 2), bool),
        "env_steps": np.array([[5, 6], [7, 8], [9, 10]]),
        "episode_return": np.ones((3, 2), np.float32),
    }
    shorter = {name: x[:1, :1] for name, x in longer.items()}
    joint = _together_in_time([longer, shorter])
    assert joint["active"].tolist() == [[True] * 3] + [[True, True, False]] * 2
    assert joint["env_steps"][:, 2].tolist() == [5, 0, 0]
    assert joint["episode_return"].dtype == np.float32

"""The command line, end to end on toy environments: files, statistics, errors, Ctrl-C."""

import csv
import errno
import gc
import json
import resource
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import HELPERS
from toys import Survive

from mjx_reinforce import load, load_policy
from mjx_reinforce import train as train_module
from mjx_reinforce.files import append_csv, create_csv
from mjx_reinforce.policies import normalize
from mjx_reinforce.reports.statistics import smooth
from mjx_reinforce.settings.config import MAX_OF_UPDATE, Config, check_step_count
from mjx_reinforce.store.build import build
from mjx_reinforce.training.progress import as_events
from mjx_reinforce.training.record import RunRecord

ARGUMENTS = ["--env", "Survive-v0", "--num-seeds", "3", "--env-steps", "1500"]


def read(directory):
    with (directory / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file)), json.loads((directory / "summary.json").read_text())


def test_shares_are_parts_of_the_whole_run(run, tmp_path):
    """Up to rounding; their seeds have the numbers of the whole run, also where one is loaded."""
    assert run(*ARGUMENTS, "--output", "whole") == 0
    common = [*ARGUMENTS[:2], *ARGUMENTS[4:]]
    for seeds in ("0:1", "1:3"):
        assert run(*common, "--seeds", seeds, "--output", f"share-{seeds[0]}") == 0
    whole = {(row["seed"], row["update"]): row for row in read(tmp_path / "whole")[0]}
    for name, seeds in (("share-0", {"0"}), ("share-1", {"1", "2"})):
        rows = read(tmp_path / name)[0]
        assert {row["seed"] for row in rows} == seeds
        for row in rows:
            same = whole[row["seed"], row["update"]]
            for column in ("env_steps", "eval_return", "train_return"):
                np.testing.assert_allclose(float(row[column] or 0), float(same[column] or 0), 1e-4)
    assert json.loads((tmp_path / "share-1" / "config.json").read_text())["seeds"] == "1:3"
    assert load(tmp_path / "share-1", 2).seed == 2
    with pytest.raises(ValueError, match="policies of the seeds 1 and 2, not 0"):
        load(tmp_path / "share-1", 0)
    assert run("--resume", "share-1", "--env-steps", "2500") == 0
    assert {row["seed"] for row in read(tmp_path / "share-1")[0]} == {"1", "2"}


def test_a_run_leaves_its_files(run, tmp_path):
    assert run(*ARGUMENTS, "--output", "out", "--hidden-sizes", "4") == 0
    out = tmp_path / "out"
    rows, summary = read(out)
    assert {(row["seed"], row["update"]) for row in rows[:3]} == {
        ("0", "0"),
        ("1", "0"),
        ("2", "0"),
    }
    last = rows[-3:]
    assert [np.float32(row["eval_return"]) for row in last] == summary["final_returns"]
    assert all(int(row["env_steps"]) >= 1500 for row in last)
    assert summary["env"] == "Survive-v0"
    assert summary["num_seeds"] == 3
    assert len(summary["env_steps_to_solve"]) == len(summary["episodes_to_solve"]) == 3
    assert summary["iqm_ci"] == [None, None]  # of three seeds
    assert 0 < summary["useful_step_fraction"] <= 1
    for name in ("compile_seconds", "run_seconds", "env_steps_per_second", "engine", "solve_rate"):
        assert name in summary
    config = json.loads((out / "config.json").read_text())
    assert config["hidden_sizes"] == [4]
    assert config["horizon"] == 20
    assert config["packages"]["jax"] == jax.__version__
    assert (out / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert not list(out.glob(".*"))


def test_training_returns_are_kept(run, tmp_path):
    """Of every update until each seed's budget is used; after that it is NaN."""
    assert run(*ARGUMENTS, "--output", "out", "--hidden-sizes", "4") == 0
    rows, summary = read(tmp_path / "out")
    with np.load(tmp_path / "out" / "returns.npz", allow_pickle=False) as archive:
        training = dict(archive)
    made = np.isfinite(training["episode_return"])
    assert training["env_steps"][-1].tolist() == summary["env_steps"]
    for seed, row in enumerate(rows[-3:]):
        updates = int(row["update"])
        assert made[:updates, seed].all()
        assert not made[updates:, seed].any()
        assert training["episodes"][-1, seed] == int(row["episodes"]) == 16 * updates
        returns, steps = training["episode_return"][:, seed], training["env_steps"][:, seed]
        assert returns[updates - 1] == pytest.approx(float(row["train_return"]))
        # Survive pays 1 a step.
        np.testing.assert_allclose(np.cumsum(16 * returns[:updates]), steps[:updates], rtol=1e-5)


def test_the_number_of_updates_is_a_budget_by_itself(run, tmp_path):
    arguments = ["--env", "Survive-v0", "--env-steps", "None", "--max-updates", "7"]
    assert run(*arguments, "--output", "out") == 0
    rows, _ = read(tmp_path / "out")
    assert [int(row["update"]) for row in rows] == [0] * 4 + [5] * 4 + [7] * 4


@pytest.mark.parametrize("horizon", [20, 8])
def test_a_run_may_stop_when_solved(run, tmp_path, horizon):
    """A fresh policy solves Survive, unless it has less time than the threshold of 15."""
    arguments = ["--max-updates", "5", "--stop-when-solved", "--horizon", str(horizon)]
    assert run(*ARGUMENTS, *arguments, "--output", "out") == 0
    rows, summary = read(tmp_path / "out")
    assert int(rows[-1]["update"]) == (0 if horizon == 20 else 5)
    assert summary["episodes_to_solve"] == [0 if horizon == 20 else None] * 3


def test_random_search_trains_and_loads(run, tmp_path):
    assert run(*ARGUMENTS, "--algorithm", "ars", "--hidden-sizes", "--output", "out") == 0
    policy, actor = load_policy(tmp_path / "out" / "policy", seed=1)
    outputs = policy.apply(actor.params, normalize.apply(actor.normalizer, jnp.zeros(1)))
    assert np.isfinite(policy.distribution.mode(outputs)[0])


def test_a_seed_does_not_depend_on_how_many_there_are(run, tmp_path):
    run(*ARGUMENTS, "--output", "three")
    run("--env", "Survive-v0", "--num-seeds", "1", "--env-steps", "1500", "--output", "one")
    three, one = read(tmp_path / "three")[0], read(tmp_path / "one")[0]
    ours = [row for row in three if row["seed"] == "0"][: len(one)]
    for name in ("update", "env_steps", "eval_return"):
        assert [row[name] for row in ours] == [row[name] for row in one]


def test_the_saved_policy_plays_like_the_trained_one(run, tmp_path):
    run(*ARGUMENTS, "--output", "out", "--policy", "normal-softplus")
    policy, actor = load_policy(tmp_path / "out" / "policy", seed=1)
    outputs = policy.apply(actor.params, normalize.apply(actor.normalizer, jnp.zeros(1)))
    survives = bool(jnp.abs(policy.distribution.mode(outputs)[0]) <= 0.5)
    final = read(tmp_path / "out")[1]["final_returns"][1]
    assert final == (20.0 if survives else 1.0)
    with pytest.raises(ValueError, match="has no seed 3: its seeds are 0 to 2"):
        load_policy(tmp_path / "out" / "policy", seed=3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "InvertedPendulm-v5"], "Did you mean 'InvertedPendulum-v5'"),
        (["--policy", "gaussian"], "unknown policy 'gaussian'"),
        (["--estimator", "leave-one"], "Did you mean 'leave-one-out'"),
        (["--num-seeds", "0"], "--num-seeds must be at least 1, got 0"),
        (["--num-episodes", "1"], "at least two episodes"),
        (["--env-steps", "-5"], "--env-steps must be at least 1"),
        (["--learning-rate", "nan"], "--learning-rate must be positive and finite, got nan"),
        (["--discount", "1.5"], r"--discount must be in [0, 1], got 1.5"),
        (["--hidden-sizes", "32", "0"], "positive in every layer"),
        (["--horizon", "0"], "--horizon must be at least 1"),
        (["--env-steps", "None"], "nothing would end this run"),
        (["--max-updates", "0"], "--max-updates must be at least 1, got 0"),
        (["--max-updates", str(2**53 + 1)], "--max-updates must be at most 2^53"),
        (["--env-steps", str(2**53 + 1)], "--env-steps must be at most 2^53"),
        (["--horizon", str(2**31)], "--horizon must be less than 2^31, got 2147483648"),
        (
            [
                *("--num-episodes", "16", "--env-steps", "None", "--max-updates", str(2**50)),
                *("--output", "out"),
            ],
            "give --env-steps, or lower",
        ),
        (["--max-grad-norm", "0"], "--max-grad-norm must be positive and finite, got 0.0"),
        (["--weight-decay", "-1"], "--weight-decay must be finite and not negative"),
        (
            ["--update", "minibatches", "--minibatch-size", "0"],
            "--minibatch-size must be at least 1",
        ),
        (
            ["--estimator", "value-baseline", "--value-learning-rate", "0"],
            "--value-learning-rate must be positive",
        ),
        (["--policy", "deterministic"], "no log-probability"),
        (["--decay-updates", "9"], "not both: pass --decay-steps None"),
        (
            ["--update", "each-step", "--decay-updates", "9", "--decay-steps", "None"],
            "choose --decay-steps",
        ),
        (["--algorithm", "ars", "--one-start"], "--shared-starts"),
        (["--algorithm", "ars", "--top-directions", "9"], "at most --num-directions 8, got 9"),
        (
            ["--algorithm", "ars", "--ars-update", "document", "--hidden-sizes", "8"],
            "pass --hidden-sizes alone",
        ),
        (["gymnasium"], "Did you mean 'gymnasium-tutorial'"),
        (["--output", "taken"], "is not empty"),
        (["--output", "taken/file"], "cannot write"),
        (["--output", "/proc/no"], "cannot write"),
    ],
)
def test_bad_input_is_explained_before_anything_starts(run, tmp_path, capsys, arguments, message):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").write_text("mine")
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") <= 2
    assert not (tmp_path / "runs").exists()
    assert (tmp_path / "taken" / "file").read_text() == "mine"


@pytest.mark.parametrize("files", [("config.json", "metrics.csv"), ("sweep.json",)])
def test_a_run_is_not_put_into_another(run, tmp_path, capsys, files):
    for name in files:
        (tmp_path / name).write_text("{}")
    assert run(*ARGUMENTS, "--output", "new/deep", "--overwrite") == 2
    assert f"new/deep would be inside the run {tmp_path}" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_solving_needs_a_threshold(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Survive, "reward_threshold", None)
    assert run(*ARGUMENTS, "--stop-when-solved", "--output", "out") == 2
    assert "leave --stop-when-solved out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_run_beyond_all_memory_is_refused(run, tmp_path, capsys):
    size = ["--engine", "vmap", "--num-seeds", str(10**9)]
    assert run(*ARGUMENTS, *size, "--output", "out") == 2
    error = capsys.readouterr().err
    assert "does not fit into memory" in error
    assert "--num-seeds" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (
            RuntimeError("RESOURCE_EXHAUSTED: 9 GB"),
            2,
            "this run does not fit into memory (RESOURCE_EXHAUSTED: 9 GB); lower --num-seeds, "
            "--num-episodes, --eval-episodes or --horizon",
        ),
        (
            OSError(errno.ENOSPC, "No space left"),
            1,
            "the files of this run ([Errno 28] No space left); make room, then try again",
        ),
        (
            OSError("no network"),
            1,
            "the files of this run (no network); then try again",
        ),
    ],
)
def test_what_is_full_is_said_in_one_line(run, tmp_path, monkeypatch, capsys, error, status, said):
    def fail(*_):
        raise error

    monkeypatch.setattr(train_module, "train", fail)
    assert run(*ARGUMENTS, "--output", "out") == status
    assert " ".join(capsys.readouterr().err.split()).endswith(said)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("taken", "advised"), [("false", True), ("true", False), (None, False)])
def test_memory_in_pieces_is_named(run, monkeypatch, capsys, taken, advised):
    def fail(*_):
        raise RuntimeError("RESOURCE_EXHAUSTED: 9 GB")

    monkeypatch.setattr(train_module, "train", fail)
    monkeypatch.delenv("XLA_PYTHON_CLIENT_PREALLOCATE", raising=False)
    if taken:
        monkeypatch.setenv("XLA_PYTHON_CLIENT_PREALLOCATE", taken)
    assert run(*ARGUMENTS, "--output", "out") == 2
    assert ("unset XLA_PYTHON_CLIENT_PREALLOCATE" in capsys.readouterr().err) == advised


def test_another_error_is_not_said_to_be_of_memory(run, monkeypatch):
    def fail(*_):
        raise RuntimeError("INTERNAL")

    monkeypatch.setattr(train_module, "train", fail)
    with pytest.raises(RuntimeError, match="INTERNAL"):
        run(*ARGUMENTS, "--output", "out")


@pytest.mark.parametrize("arguments", [["--num-seeds", "0"], ["--help"]])
def test_the_garbage_collector_runs_after_every_way_out(run, arguments):
    assert gc.isenabled()
    run(*arguments)
    assert gc.isenabled()


@pytest.mark.parametrize(
    ("settings", "most"),
    [
        # 320 env steps an update, all of which the last one before the budget may add.
        ({"env_steps": None, "max_updates": 100}, 32_000),
        ({"env_steps": 1000, "max_updates": None}, 1319),
        ({"env_steps": 1000, "max_updates": 3}, 960),
        ({"env_steps": 1000, "max_updates": 100}, 1319),
    ],
)
def test_env_steps_that_cannot_be_counted_are_refused(monkeypatch, settings, most):
    config = Config(num_episodes=16, **settings)
    monkeypatch.setattr("mjx_reinforce.settings.config.MAX_COUNT", most)
    check_step_count(config, horizon=20)
    monkeypatch.setattr("mjx_reinforce.settings.config.MAX_COUNT", most - 1)
    with pytest.raises(ValueError, match=f"a seed may play {most:,} env steps"):
        check_step_count(config, horizon=20)


def test_an_update_that_cannot_be_counted_is_refused():
    config = Config(num_episodes=2**21, env_steps=10**12)
    check_step_count(config, horizon=2**10 - 1)
    with pytest.raises(ValueError, match="an update may play 2,147,483,648 env steps"):
        check_step_count(config, horizon=2**10)
    assert jnp.iinfo(jnp.int32).max == MAX_OF_UPDATE


def test_a_ready_policy_may_be_trained():
    config = Config(env="Survive-v0")
    built = build(Survive(), config)[0].policy
    policy = built._replace(apply=lambda *arguments: built.apply(*arguments))
    assert built != policy
    assert build(Survive(), config, policy)[0].policy is policy


METRICS = {  # two updates of two seeds; the second seed stands still in the second update
    "active": np.array([[True, True], [True, False]]),
    "env_steps": np.array([[30, 40], [40, 0]], np.int32),
    "episodes": np.array([[2, 2], [2, 2]], np.int32),
    "simulated_steps": np.array([[50, 60], [40, 0]], np.int32),
    "episode_return": np.array([[3.0, 4.0], [5.0, 0.0]], np.float32),
    "episode_length": np.array([[15.0, 20.0], [20.0, 0.0]], np.float32),
    "entropy": np.array([[0.5, 0.25], [0.125, 0.0]], np.float32),
    "gradient_norm": np.array([[1.0, 2.0], [3.0, 0.0]], np.float32),
    "nonfinite_episodes": np.array([[0, 0], [2, 7]], np.int32),
    "skipped_update": np.array([[0, 0], [1, 1]], np.int32),
}


def evaluation(*returns):
    values = np.array(returns, np.float32)
    measured = {"eval_return": values, "eval_return_stochastic": values / 2, "eval_length": values}
    counts = np.arange(1, len(values) + 1)
    return measured | {"simulated_steps": counts + 1, "eval_steps": counts}


def test_a_record_of_two_seeds_by_hand():
    config = Config(num_seeds=2, num_episodes=2, env_steps=60, stop_when_solved=True)
    record = RunRecord(config, threshold=8.0)
    first = record.add_evaluation(evaluation(1, 9), 0.5)
    assert first["train_return"] == ["", ""]
    assert not record.finished()
    assert record.progress().fraction == 0
    met = record.add_updates(METRICS)
    assert as_events(met) == [{"seed": 0, "update": 1, "episodes": 2, "skipped": True}]
    second = record.add_evaluation(evaluation(7, 10), 2.00009)
    keys = ("seed", "update", "episodes", "env_steps", "wall_seconds", "train_return")
    assert [*zip(*(second[key] for key in keys), strict=True)] == [
        ("0", "2", "4", "70", "2.000", "nan"),
        ("1", "1", "2", "40", "2.000", "4.0"),
    ]
    assert second["skipped_update"] == ["1", "0"]
    progress = record.progress()
    assert progress[:-3] == (40 / 60, 2, 55.0, 8.5, 7.0, 0, 2)
    np.testing.assert_allclose(progress[-3:], [55, 110 / 1.5, 1.5 / 2], rtol=1e-3)
    assert not record.finished()
    np.testing.assert_array_equal(record.training()["episode_return"], [[3, 4], [np.nan] * 2])
    np.testing.assert_array_equal(record.training()["env_steps"], [[30, 40], [70, 40]])
    np.testing.assert_array_equal(record.training()["episodes"], [[2, 2], [4, 2]])
    summary = record.summary("vmap", 3.0, 2.0)
    assert summary["env_steps_to_solve"] == [None, 0]
    # 2 (60 + 40) in training and 2 (2 + 2) in evaluations: each waits for the other.
    assert summary["useful_step_fraction"] == 116 / 160
    assert summary["env_steps_per_second"] == 55
    assert len(summary["nonfinite"]) == 1
    record.add_evaluation(evaluation(8, 8), 2.0)
    assert record.finished()


def test_a_csv_file_grows_by_whole_rows(tmp_path):
    path = tmp_path / "table.csv"
    create_csv(path, ["a", "b"])
    append_csv(path, ["a", "b"], [{"a": 1, "b": 0.1}, {"b": "", "a": "x,y"}])
    append_csv(path, ["a", "b"], [{"a": 2, "b": 1e-30}])
    assert path.read_bytes() == b'a,b\n1,0.1\n"x,y",\n2,1e-30\n'


def test_a_full_disk_leaves_no_half_row(tmp_path):
    """A limit on the size of files fails as a full disk does: after a part was written."""
    path = tmp_path / "table.csv"
    create_csv(path, ["a"])
    append_csv(path, ["a"], [{"a": 1}])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (7, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            append_csv(path, ["a"], [{"a": 23456}])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"a\n1\n"
    append_csv(path, ["a"], [{"a": 23456}])
    assert path.read_bytes() == b"a\n1\n23456\n"


def test_smoothing_is_a_mean_of_the_latest():
    values = np.arange(12.0).reshape(6, 2)
    values[1, 0] = np.nan
    expected = [values[max(0, u - 2) : u + 1].mean(axis=0) for u in range(6)]
    np.testing.assert_allclose(smooth(values, 3), expected)
    assert np.isnan(expected).sum() == 3


def test_overwrite_is_by_request_alone(run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    assert run(*ARGUMENTS, "--output", "out") == 2
    assert run(*ARGUMENTS, "--output", "out", "--overwrite") == 0
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"


def test_ctrl_c_leaves_a_readable_run(tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv.pop(1))\n"
        "from toys import Survive\n"
        "from mjx_reinforce import envs, train\n"
        "envs.register('Survive-v0', Survive)\n"
        "train.main()"
    )
    arguments = ["--env", "Survive-v0", "--env-steps", "1000000000", "--output", "out"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(HELPERS), *arguments],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    )
    metrics = tmp_path / "out" / "metrics.csv"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (
        metrics.exists() and metrics.read_text().count("\n") > 20
    ):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    rows, summary = read(tmp_path / "out")
    assert len(rows) >= 20
    assert len(summary["final_returns"]) == 4
    _, actor = load_policy(tmp_path / "out" / "policy")
    assert np.all(np.isfinite(actor.normalizer.mean))


class Fragile(Survive):
    """Breaks down in one episode of about a hundred."""

    def step(self, state, action):
        after = super().step(state, action)
        bad = (action[0] > 1.1) & (action[0] < 1.15)
        return after.replace(obs=jnp.where(bad, jnp.nan, after.obs))


def test_a_broken_simulation_is_named(run, register, tmp_path, capsys):
    """In one line a block of updates; the training return of such an update is no number."""
    register("Fragile-v0", Fragile)
    assert run("--env", "Fragile-v0", "--env-steps", "1500", "--output", "out") == 0
    rows, summary = read(tmp_path / "out")
    blocks = {event["update"] // 5 for event in summary["nonfinite"]}
    said = capsys.readouterr().out
    assert said.count("met numbers that are not finite") == len(blocks) > 0
    assert any(row["train_return"] == "nan" for row in rows)
    for row in rows[4:]:
        assert (row["train_return"] == "nan") == (int(row["nonfinite_episodes"]) > 0)
    assert np.all(np.isfinite(summary["final_returns"]))


class Broken(Survive):
    """Leaves the finite numbers in every first step, and would reward it."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=after.obs * jnp.nan, done=jnp.zeros(()))


def test_a_run_without_a_finite_number_stops(run, register, tmp_path, capsys):
    """Not with returns of 0, and long before its budget is used."""
    register("Broken-v0", Broken)
    arguments = ["--env", "Broken-v0", "--num-seeds", "3", "--env-steps", "100000"]
    assert run(*arguments, "--eval-every", "2", "--output", "out") == 1
    said = capsys.readouterr().out
    assert "stopped: every seed that still trained was broken" in said
    assert run("--resume", "out") == 2
    assert "out was stopped and would be again: every seed that" in capsys.readouterr().err
    assert "worst nan (3 of 3 seeds)" in said
    rows, summary = read(tmp_path / "out")
    assert {row["eval_return"] for row in rows} == {"nan"}
    assert {row["eval_return_stochastic"] for row in rows} == {"nan"}
    assert int(rows[-1]["update"]) == 6  # three blocks of two: the first with at least five
    assert summary["status"] == "stopped"
    assert summary["reason"].startswith("every seed that still trained was broken")
    assert summary["final_returns"] == [None] * 3
    assert summary["iqm"] is None
    assert summary["iqm_ci"] == [None, None]
    assert summary["seeds_nonfinite_at_end"] == 3
    assert summary["seeds_solved_at_end"] == summary["seeds_ever_solved"] == 0

"""The command line, end to end on toy environments: files, statistics, errors."""

import contextlib
import csv
import errno
import gc
import json
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_lines import added_environments, run_command
from toys import Survive

from mjx_reinforce import load, load_policy
from mjx_reinforce.files import append, csv_text
from mjx_reinforce.learning import normalize
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.build import build

ARGUMENTS = ["--env", "Survive-v0", "--num-seeds", "3", "--env-steps", "1500"]


def read(directory):
    with (directory / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file)), json.loads((directory / "summary.json").read_text())


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """The directory of a run."""
    directory = tmp_path_factory.mktemp("run")
    with contextlib.chdir(directory), added_environments():
        assert run_command(*ARGUMENTS, "--output", "out", "--hidden-sizes", "4") == 0
    return directory / "out"


@pytest.mark.slow
def test_a_share_is_a_part_of_the_whole_run(run, out, tmp_path):
    """Up to rounding; its seeds have the numbers of the whole run, also where one is loaded."""
    share = tmp_path / "share"
    common = [*ARGUMENTS[:2], *ARGUMENTS[4:], "--hidden-sizes", "4"]
    assert run(*common, "--seeds", "1:3", "--output", "share") == 0
    whole = {(row["seed"], row["update"]): row for row in read(out)[0]}
    rows = read(share)[0]
    assert {row["seed"] for row in rows} == {"1", "2"}
    for row in rows:
        same = whole[row["seed"], row["update"]]
        for column in ("env_steps", "eval_return", "train_return"):
            np.testing.assert_allclose(float(row[column] or 0), float(same[column] or 0), 1e-4)
    assert json.loads((share / "config.json").read_text())["seeds"] == "1:3"
    assert load(share, 2).seed == 2
    with pytest.raises(ValueError, match="policies of the seeds 1 and 2, not 0"):
        load(share, 0)
    assert run("--resume", "share", "--env-steps", "2500") == 0
    assert {row["seed"] for row in read(share)[0]} == {"1", "2"}


def test_a_run_leaves_its_files(out):
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


def test_training_returns_are_kept(out):
    """Of every update until each seed's budget is used; after that it is NaN."""
    rows, summary = read(out)
    with np.load(out / "returns.npz", allow_pickle=False) as archive:
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


def test_the_saved_policy_plays_like_the_trained_one(out):
    policy, actor = load_policy(out / "policy", seed=1)
    outputs = policy.apply(actor.params, normalize.apply(actor.normalizer, jnp.zeros(1)))
    survives = bool(jnp.abs(policy.distribution.mode(outputs)[0]) <= 0.5)
    final = read(out)[1]["final_returns"][1]
    assert final == (20.0 if survives else 1.0)
    with pytest.raises(ValueError, match="has no seed 3: its seeds are 0 to 2"):
        load_policy(out / "policy", seed=3)


@pytest.mark.parametrize("files", [("config.json", "metrics.csv"), ("sweep.json",)])
def test_a_run_is_not_put_into_another(run, tmp_path, capsys, files):
    for name in files:
        (tmp_path / name).write_text("{}")
    assert run(*ARGUMENTS, "--output", "new/deep") == 2
    assert f"new/deep would be inside the run {tmp_path}" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


LOWER = "; lower --num-seeds, --num-episodes, --eval-episodes or --horizon"
FULL = [
    (RuntimeError("RESOURCE_EXHAUSTED"), 2, f"fit into memory (RESOURCE_EXHAUSTED){LOWER}"),
    (MemoryError("9 GB"), 2, f"this run does not fit into memory (9 GB){LOWER}"),
    (
        OSError(errno.ENOSPC, "No space left"),
        1,
        "the files of this run ([Errno 28] No space left); make room, then try again",
    ),
    (
        IsADirectoryError(errno.EISDIR, "Is a directory", "out/summary.json"),
        1,
        "([Errno 21] Is a directory: 'out/summary.json'); mend that, then try again",
    ),
    (OSError("no network"), 1, "the files of this run (no network); then try again"),
]


@pytest.fixture
def failing(run, monkeypatch):
    """Runs a command line whose training raises an error: its exit code."""

    def fail(error, place="conduct.conduct"):
        def called(*given):
            for interrupt in given[-1:]:
                interrupt.defer(print)
            raise error

        monkeypatch.setattr(f"mjx_reinforce.runs.{place}", called)
        return run(*ARGUMENTS, "--output", "out")

    return fail


@pytest.mark.parametrize(("error", "status", "said"), FULL)
def test_what_is_full_is_said_in_one_line(failing, tmp_path, capsys, error, status, said):
    assert failing(error) == status
    assert " ".join(capsys.readouterr().err.split()).endswith(said)
    assert not (tmp_path / "out").exists()


def test_the_flag_that_goes_on_may_be_copied_to_a_shell(run, tmp_path, monkeypatch, capsys):
    def conduct(*_):
        (tmp_path / "my run" / "config.json").write_text("{}")
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr("mjx_reinforce.runs.conduct.conduct", conduct)
    assert run(*ARGUMENTS, "--output", "my run") == 1
    assert "then go on with --resume 'my run'" in " ".join(capsys.readouterr().err.split())


def test_a_mistake_of_ours_in_training_is_no_bad_input(failing):
    with pytest.raises(ValueError, match="a bug"):
        failing(ValueError("a bug"))


def test_libraries_that_find_no_memory_do_not_ask_for_fewer_seeds(failing, capsys):
    assert failing(MemoryError(), "perform.configure_jax") == 2
    assert "cannot load what this package needs (no memory is left)" in capsys.readouterr().err


def test_another_error_is_not_said_to_be_of_memory(failing):
    with pytest.raises(RuntimeError, match="INTERNAL"):
        failing(RuntimeError("INTERNAL"))


@pytest.mark.parametrize("arguments", [["--num-seeds", "0"], ["--help"]])
def test_the_garbage_collector_runs_after_every_way_out(run, arguments):
    assert gc.isenabled()
    run(*arguments)
    assert gc.isenabled()


def test_a_ready_policy_may_be_trained():
    config = Config(env="Survive-v0")
    built = build(Survive(), config)[0].policy
    policy = built._replace(apply=lambda *arguments: built.apply(*arguments))
    assert built != policy
    assert build(Survive(), config, policy)[0].policy.apply is policy.apply


def test_a_csv_file_grows_by_whole_rows(tmp_path):
    path = tmp_path / "table.csv"
    path.touch()
    for rows in ([["a", "b"]], [[1, 0.1], ["x,y", None]], [[2, 1e-30]]):
        append(path, csv_text(rows).encode())
    assert path.read_bytes() == b'a,b\n1,0.1\n"x,y",\n2,1e-30\n'


def test_a_full_disk_leaves_no_half_row(tmp_path):
    """A limit on the size of files fails as a full disk does: after a part was written."""
    path = tmp_path / "table.csv"
    path.write_bytes(b"a\n1\n")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (7, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            append(path, b"23456\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"a\n1\n"
    append(path, b"23456\n")
    assert path.read_bytes() == b"a\n1\n23456\n"


class Broken(Survive):
    """Leaves the finite numbers in every first step, and would reward it."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=after.obs * jnp.nan, done=jnp.zeros(()))


@pytest.mark.slow
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

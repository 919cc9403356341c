"""Checkpoints: a run that goes on ends as one that never stopped, whatever happens to its files."""

import contextlib
import errno
import functools
import io
import json
import os
import resource
import shutil
import signal
import time

import numpy as np
import pytest
from command_lines import added_environments, run_command
from saved_runs import assert_same, change

from mjx_reinforce import files
from mjx_reinforce import files as export_files
from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.runs import perform, plan
from mjx_reinforce.runs.perform import locked
from mjx_reinforce.runs.saving import RunFiles
from mjx_reinforce.training import resume
from mjx_reinforce.training.slots import Slots

#: One of our tasks, whose programs are kept on disk: only the first run traces and compiles them.
COMMON = ["--env", "ContinuousCartPole-v0", "--env-steps", "None", "--num-seeds", "3"]
COMMON += ["--eval-episodes", "2"]
#: A rate that lasts as long as the budget would make another run of a larger one.
COMMON += ["--hidden-sizes", "4", "--num-episodes", "4", "--decay-steps", "9000"]


@pytest.mark.slow
def test_a_run_in_two_parts_is_the_run_in_one(run, tmp_path):
    """Also where the first part ends in the middle of a block, or between two checkpoints."""
    more = ["--estimator", "value-baseline", "--value-hidden-sizes", "4", "--value-fits", "2"]
    assert run(*COMMON, *more, "--max-updates", 24, "--output", "whole") == 0
    more += ["--checkpoint-every", 5, "--output", "parts"]
    assert run(*COMMON, *more, "--max-updates", 13) == 0
    assert run("--resume", "parts", "--max-updates", 24) == 0
    assert_same(tmp_path / "whole", tmp_path / "parts")
    config = json.loads((tmp_path / "parts" / "config.json").read_text())
    assert config["max_updates"] == 24
    assert [entry["updates"] for entry in config["resumed"]] == [10]
    assert not list((tmp_path / "parts").rglob(".*"))


@pytest.mark.slow
def test_seeds_that_stood_still_are_played_again(run, tmp_path):
    """Under --env-steps they stop one by one; a run of a larger budget knows no such state."""
    steps = [*COMMON, "--env-steps"]
    assert run(*steps, 900, "--output", "whole") == 0
    assert run(*steps, 300, "--checkpoint-every", 5, "--output", "parts") == 0
    updates = json.loads((tmp_path / "parts" / "summary.json").read_text())["best_updates"]
    assert run("--resume", "parts", "--env-steps", 900) == 0
    assert_same(tmp_path / "whole", tmp_path / "parts")
    assert len(updates) == 3


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 20 updates; its checkpoints at 15 and 20 are left."""
    directory = tmp_path_factory.mktemp("trained")
    with added_environments(), contextlib.chdir(directory):
        budget = ["--max-updates", "20", "--checkpoint-every", "5", "--output", "whole"]
        assert run_command(*COMMON, *budget) == 0
    return directory / "whole"


@pytest.fixture
def parts(trained, tmp_path):
    """A copy of that run, as if it had been killed at its end."""
    shutil.copytree(trained, tmp_path / "parts")
    (tmp_path / "parts" / "summary.json").write_text('{"status": "running"}')
    return tmp_path / "parts"


def checkpoints(directory):
    return sorted((directory / "checkpoint").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["newest", "folder", "table"])
def test_what_is_damaged_costs_an_interval(run, trained, parts, capsys, damage):
    *_, new = checkpoints(parts)
    metrics = parts / "metrics.csv"
    if damage == "table":
        metrics.write_bytes(metrics.read_bytes()[:-7])
        said = ["metrics.csv lacks rows of checkpoint 4", "going on after 15 updates"]
    elif damage == "folder":
        new.unlink()
        new.mkdir()
        said = ["going on after 15 updates"]
    else:
        new.write_bytes(new.read_bytes()[:-1] + b"!")
        said = [f"checkpoint {new.name} is damaged; trying the one before"]
        said.append("going on after 15 updates")
        with metrics.open("a") as file:
            file.write("0,25,half a ro")
    assert run("--resume", "parts") == 0
    assert_same(trained, parts)
    output = capsys.readouterr().out
    assert all(words in output for words in said)


def lose_checkpoints(directory):
    for path in checkpoints(directory):
        path.write_bytes(b"")


def lose_folder(directory):
    shutil.rmtree(directory / "checkpoint")
    (directory / "checkpoint").write_text("")


def lose_metrics(directory):
    (directory / "metrics.csv").unlink()


def edit_metrics(directory):
    """Saves the file as an editor of Windows does: no byte of a number is another."""
    metrics = directory / "metrics.csv"
    metrics.write_bytes(metrics.read_bytes().replace(b"\n", b"\r\n"))


@pytest.mark.parametrize("lose", [lose_checkpoints, lose_folder, lose_metrics, edit_metrics])
def test_policies_are_not_replaced_unasked(run, parts, capsys, lose):
    lose(parts)
    before = {path: path.read_bytes() for path in parts.rglob("*") if path.is_file()}
    assert run("--resume", "parts") == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "parts has policies, but no whole checkpoint/ and metrics.csv" in error
    assert before == {path: path.read_bytes() for path in parts.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_who_removes_the_policies_begins_again(run, trained, parts, capsys):
    lose_metrics(parts)
    shutil.rmtree(parts / "checkpoint")
    shutil.rmtree(parts / "policy")
    assert run("--resume", "parts") == 0
    assert "there is no checkpoint yet, so it begins again" in capsys.readouterr().out
    assert_same(trained, parts)


def test_a_checkpoint_that_is_cut_or_compressed_is_none(trained, tmp_path):
    """Few bytes can ask for gigabytes; whoever writes such a file can name it by its digest."""
    [*_, newest] = checkpoints(trained)
    content, packed = newest.read_bytes(), io.BytesIO()
    np.savez_compressed(packed, **np.load(newest))
    name = f"{newest.name.split('-')[0]}-{resume._digest(packed.getvalue())}.npz"
    (tmp_path / name).write_bytes(packed.getvalue())
    assert resume._read(tmp_path / name) is None
    assert resume._read(newest) == content
    for damaged in (content[:-7], b"", content[:-1] + b"!"):
        (tmp_path / newest.name).write_bytes(damaged)
        assert resume._read(tmp_path / newest.name) is None


OTHER_ARRAYS = {
    "states": lambda x: x[:1],
    "best": lambda x: x[:, :-4],
    "record/updates": lambda x: x[:1],
    "record/env_steps": None,
    "record/returns": None,
    "record/seen": lambda x: x.astype(float),
    "record/training.env_steps": lambda x: x[:, :1],
    "record/evaluations.seconds": lambda x: x[1:],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHER_ARRAYS)
def test_a_checkpoint_of_other_shapes_is_named(run, parts, capsys, name):
    """Also where its name has the digest: no error of NumPy, and no table is cut."""
    *_, newest = checkpoints(parts)
    with np.load(newest) as archive:
        arrays = dict(archive)
    change = OTHER_ARRAYS[name]
    if change is None:
        del arrays[name]
    else:
        arrays[name] = change(arrays[name])
    newest.unlink()
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    start = newest.name.rpartition("-")[0]
    (newest.parent / f"{start}-{resume._digest(packed.getvalue())}.npz").write_bytes(
        packed.getvalue()
    )
    before = (parts / "metrics.csv").read_bytes()
    assert run("--resume", "parts") == 2
    said = capsys.readouterr().err
    assert "checkpoint" in said
    assert "fit" in said
    assert said.count("\n") == 1
    assert (parts / "metrics.csv").read_bytes() == before


@pytest.mark.slow
def test_a_full_disk_costs_no_training(run, trained, tmp_path, monkeypatch, capsys):
    """Neither checkpoints nor policies nor rows can be written, then all of them again."""
    written, real = [], export_files.write_bytes
    appended, real_append = [], files.append

    def full(path, content):
        written.append(path.name)
        if path.suffix == ".npz" and len(written) < 18:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, content)

    def full_for_rows(path, content):
        appended.append(content)
        if 1 < len(appended) < 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        real_append(path, content)

    monkeypatch.setattr(files, "append", full_for_rows)
    for module in (resume, export_files):
        monkeypatch.setattr(module, "write_bytes", full)
    arguments = ["--max-updates", 20, "--checkpoint-every", 5, "--output", "full"]
    assert run(*COMMON, *arguments) == 0
    assert_same(trained, tmp_path / "full")
    output = capsys.readouterr().out
    for what in ("a checkpoint", "metrics.csv"):
        assert f"warning: cannot write {what} (No space left on device)" in output


@pytest.mark.slow
def test_a_run_goes_on_with_the_engine_that_it_has(run, tmp_path):
    """Also where ``auto`` would choose another one by now."""
    assert run(*COMMON, "--max-updates", 2, "--output", "run") == 0
    path = tmp_path / "run" / "config.json"
    record = json.loads(path.read_text())
    assert (record["engine"], record["played_by"]) == ("auto", "native")
    path.write_text(json.dumps(record | {"played_by": "vmap"}))
    assert run("--resume", "run", "--max-updates", 4) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["engine"] == "vmap"


@pytest.mark.slow
def test_a_run_that_cannot_end_is_resumed(run, trained, tmp_path, monkeypatch, capsys):
    def full(path, content, compressed):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mjx_reinforce.runs.saving.write_arrays", full)
    arguments = ["--max-updates", 20, "--checkpoint-every", 5, "--output", "full"]
    assert run(*COMMON, *arguments) == 1
    assert "then go on with --resume full" in capsys.readouterr().err
    assert json.loads((tmp_path / "full" / "summary.json").read_text())["status"] == "running"
    monkeypatch.undo()
    assert run("--resume", "full") == 0
    assert_same(trained, tmp_path / "full")


def signalled(method, when):
    """The method, and after its ``when``-th call a signal, which has been heard when it returns."""
    calls = []

    @functools.wraps(method)
    def called(*arguments, **options):
        result = method(*arguments, **options)
        calls.append(None)
        if len(calls) == when:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.3)
        return result

    return called


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name", "when", "status", "rows"),
    [
        (RunFiles, "began", 1, 143, 1),
        (Slots, "advance", 2, 143, 2),  # whose evaluation is left to the run that goes on
        (Slots, "test", 1, 143, 5),
        (Slots, "test", 2, 0, 5),  # nothing is left to stop
    ],
)
def test_a_signal_anywhere_costs_nothing(
    run, trained, tmp_path, monkeypatch, owner, name, when, status, rows
):
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, signalled(getattr(owner, name), when))
        arguments = ["--max-updates", 20, "--checkpoint-every", 5, "--output", "parts"]
        assert run(*COMMON, *arguments) == status
    summary = json.loads((tmp_path / "parts" / "summary.json").read_text())
    assert summary["status"] == ("interrupted" if status else "finished")
    assert ("final_test_returns" in summary) == (status == 0)
    assert (tmp_path / "parts" / "metrics.csv").read_text().count("\n") == 1 + 3 * rows
    if status:
        assert run("--resume", "parts") == 0
    assert_same(trained, tmp_path / "parts")


@pytest.mark.parametrize("resumed", [False, True])
def test_a_full_disk_is_refused_at_once(run, parts, tmp_path, monkeypatch, capsys, resumed):
    """A limit on the size of files stands for it."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    arguments = ["--resume", "parts"] if resumed else [*COMMON, "--output", "new/out"]
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(plan, "make_plan", pytest.fail)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        code = run(*arguments, "--max-updates", 30)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2
    assert "(File too large); make room there" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "make it a folder that you may write to, or choose another --output"),
        (errno.EROFS, "make it a folder that you may write to, or choose another --output"),
        (errno.ENOSPC, "make room there, or choose another --output"),
        (errno.EDQUOT, "make room there, or choose another --output"),
    ],
)
def test_the_remedy_is_that_of_what_keeps_the_files_away(
    run, tmp_path, monkeypatch, capsys, number, remedy
):
    """It is not always room that lacks."""

    def full(**_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(perform.tempfile, "TemporaryFile", full)
    assert run(*COMMON, "--max-updates", 4, "--output", "new/out") == 2
    assert f"({os.strerror(number)}); {remedy}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_screen_that_takes_nothing_ends_no_run(run, trained, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rich.console.Console.print", full)
    arguments = ["--max-updates", 20, "--checkpoint-every", 5, "--output", "out"]
    assert run(*COMMON, *arguments) == 0
    assert_same(trained, tmp_path / "out")


#: What is given besides --resume, what is changed in config.json by hand, and what is said.
REFUSED = [
    ("--learning-rate 0.5", {}, "--learning-rate is 0.01 in parts and cannot become 0.5"),
    ("--output other", {}, "leave --output out"),
    ("--max-updates 13", {}, "--max-updates 13 is less than the 20"),
    ("", {"device": "TPU"}, "was begun with device TPU"),
    ("", {"packages": {"jax": "0.1"}}, "was begun with jax 0.1"),
    ("", {"learning_rate": 0.5}, "learning_rate is 0.5, but the run was trained with 0.01"),
    ("", {"hidden_sizes": [8]}, "hidden_sizes is [8], but the run was trained with [4]"),
    ("", {"one_start": True}, "has other settings (one_start): it is damaged, or of another"),
    ("", {"eval_every": None}, "eval_every is None: it is damaged, or of another version of the"),
    ("", {"engine": "kernel"}, "engine is 'kernel': it is damaged"),
    ("", {"learning_rate": -1.0}, "parts/config.json: --learning-rate must be positive"),
    ("", {"env": "Nothing-v9"}, "parts/config.json: unknown environment 'Nothing-v9'"),
    ("", {"resumed": 3}, "parts/config.json is damaged: resumed must be"),
]


@pytest.mark.parametrize(("arguments", "by_hand", "message"), REFUSED)
def test_only_the_budget_may_change(run, parts, capsys, arguments, by_hand, message):
    old = json.loads((parts / "config.json").read_text())
    merged = {n: old[n] | x if isinstance(x, dict) else x for n, x in by_hand.items()}
    change(parts / "config.json", **merged)
    before = {path: path.read_bytes() for path in parts.rglob("*") if path.is_file()}
    assert run("--resume", "parts", *arguments.split()) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") <= 2
    assert before == {path: path.read_bytes() for path in parts.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_budget_changed_by_hand_is_a_budget(run, parts):
    change(parts / "config.json", max_updates=24)
    assert run("--resume", "parts") == 0
    last = (parts / "metrics.csv").read_text().splitlines()[-1].split(",")
    assert "24" in last[:2]


def test_what_is_no_run_is_named(run, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    for content in (None, "{", "[]", "{}"):
        if content is not None:
            (tmp_path / "out" / "config.json").write_text(content)
        assert run("--resume", "out") == 2
        error = " ".join(capsys.readouterr().err.split())
        assert "config.json" in error
        assert ("put back a copy" in error) == (content != "{}")


def test_two_processes_do_not_train_in_one_directory(run, parts, capsys):
    with locked(parts):
        assert run("--resume", "parts") == 2
    assert "another process trains in parts" in capsys.readouterr().err


@pytest.mark.parametrize("said", ["another process trains in out/in", "out/in is not empty"])
def test_a_folder_in_which_another_is_quicker_stays(run, tmp_path, monkeypatch, capsys, said):
    """Of two processes one makes the folder; the other trains in it meanwhile, or has trained."""
    with contextlib.ExitStack() as other:

        def quicker(directory):
            (directory / "config.json").touch()
            if "another" in said:
                other.enter_context(locked(directory))
            return locked(directory)

        monkeypatch.setattr("mjx_reinforce.runs.perform.locked", quicker)
        assert run("--output", "out/in") == 2
    assert said in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out/in").iterdir()] == ["config.json"]


def test_a_finished_run_has_nothing_to_do(run, trained, tmp_path, capsys):
    shutil.copytree(trained, tmp_path / "out")
    before = (tmp_path / "out" / "summary.json").read_bytes()
    assert run("--resume", "out") == 0
    assert "is finished" in capsys.readouterr().out
    assert (tmp_path / "out" / "summary.json").read_bytes() == before


def test_the_best_policies_are_kept_and_tested(trained):
    out = trained
    rows = [line.split(",") for line in (out / "metrics.csv").read_text().splitlines()]
    names = rows[0]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "finished"
    for seed, update in enumerate(summary["best_updates"]):
        mine = [dict(zip(names, row, strict=True)) for row in rows[1:] if row[0] == str(seed)]
        best = max(float(row["eval_return"]) for row in mine)
        latest = [row for row in mine if float(row["eval_return"]) == best][-1]
        assert int(latest["update"]) == update
        last = update == 20
        ours = [summary[f"{kind}_test_returns"][seed] for kind in ("final", "best")]
        assert (ours[0] == ours[1]) == last


def test_code_for_another_cpu_is_another_program(run, parts, monkeypatch, capsys):
    """Though the machine is the same; nothing is promised then, and nothing changed."""
    before = (parts / "config.json").read_bytes()
    here = json.loads(before)["machine_code"]
    monkeypatch.setenv(machine.VARIABLE, "x86-64")
    assert run("--resume", "parts", "--max-updates", 24) == 2
    error = capsys.readouterr().err
    assert f"was begun with machine_code {here}, and here it is llvmlite" in error
    assert "x86-64, 4 lanes" in error
    assert (parts / "config.json").read_bytes() == before

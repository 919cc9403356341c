"""Sinks: what they hold is what metrics.csv holds, also after a full disk, a kill and a resume."""

import csv
import errno
import shutil
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mjx_reinforce as mr
from mjx_reinforce import train as train_module
from mjx_reinforce.runs import sinks
from mjx_reinforce.runs.saving import RunFiles
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import iqm, iqm_interval
from mjx_reinforce.training import rows


def evaluation(update, num_seeds=20, first=False):
    """Rows of one evaluation; the last seed failed, and the last but one stood still."""
    rng = np.random.default_rng(update)
    values = rng.normal(size=num_seeds).astype(np.float32)
    values[-1] = np.nan
    updates = np.full(num_seeds, update)
    updates[-2] = min(update, 5)
    names = ("eval_return", "eval_return_stochastic", "eval_length")
    measured = dict.fromkeys(names, values)
    metrics = ("episode_return", "episode_length", "entropy", "gradient_norm")
    counts = ("nonfinite_episodes", "skipped_update")
    measured |= {} if first else dict.fromkeys(metrics, values) | dict.fromkeys(counts, updates)
    measured |= {"seed": np.arange(num_seeds), "update": updates}
    measured |= {"episodes": 4 * updates, "env_steps": 40 * updates}
    return rows.as_rows(measured, 0.1 * update)


def begin(directory, config):
    """Begins a run in a directory, or goes on without a checkpoint."""
    record = SimpleNamespace(played_steps=lambda: np.zeros(1))
    run = SimpleNamespace(config=config, updates=lambda: 0, record=record)
    group_plan = SimpleNamespace(ready=SimpleNamespace(policy={}, engine="vmap", terms=()))
    plan = SimpleNamespace(saved_record={}, checkpoint=None, group_plans=[group_plan])
    files = RunFiles(directory, plan, lambda text: None)
    files.open()
    files.began(run)


@pytest.fixture
def directory(tmp_path):
    """A run's directory with its metrics.csv, and settings, as sinks find it."""
    (tmp_path / "metrics.csv").write_bytes(rows.header(()))
    (tmp_path / "config.json").write_text('{"env": "Survive-v0", "learning_rate": 0.01}')
    return tmp_path


def as_csv(path):
    """The rows of metrics.csv, with numbers; None where there is none that is finite."""

    def number(text):
        return float(text) if text and np.isfinite(float(text)) else None

    with path.open(newline="") as file:
        return [{name: number(x) for name, x in row.items()} for row in csv.DictReader(file)]


def events(folder):
    """All events of a folder, file after file, with their checksums checked."""
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c

    for path in sorted(folder.glob(sinks.EVENTS)):
        content = path.read_bytes()
        while content:
            length, of_length = struct.unpack("<QI", content[:12])
            data, of_data = content[12 : 12 + length], content[12 + length : 16 + length]
            assert masked_crc32c(content[:8]) == of_length
            assert masked_crc32c(data) == struct.unpack("<I", of_data)[0]
            yield Event.FromString(data)
            content = content[16 + length :]


def events_of(folder):
    """What TensorBoard shows: {step: {name: value}}, without what a later start drops."""
    shown = {}
    for event in events(folder):
        if event.HasField("session_log"):
            shown = {step: x for step, x in shown.items() if step < event.step}
        elif event.HasField("summary"):
            assert event.step not in shown
            shown[event.step] = {value.tag: value.simple_value for value in event.summary.value}
    return shown


def test_statistics_are_over_all_seeds_and_a_few_seeds_are_single():
    shown = sinks.scalars(evaluation(10))
    values = sinks.measured(evaluation(10))["eval_return"]
    low, high = iqm_interval(values)
    assert shown["eval_return/iqm"] == float(iqm(values))
    assert (shown["eval_return/iqm_low"], shown["eval_return/iqm_high"]) == (low, high)
    assert np.isnan(shown["eval_return/lowest"])
    assert shown["eval_return/highest"] == np.nanmax(values)
    single = [name for name in shown if name.startswith("eval_return/seed_")]
    assert single == [f"eval_return/seed_{i}" for i in range(16)]
    assert shown["eval_return/seed_3"] == values[3]
    assert shown["progress/env_steps"] == pytest.approx((19 * 400 + 200) / 20)


def test_before_the_first_update_its_columns_are_not_shown():
    shown = sinks.scalars(evaluation(0, first=True))
    assert {name.partition("/")[0] for name in shown} == {
        *("progress", "eval_return", "eval_return_stochastic", "eval_length")
    }


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(data=st.data())
@settings(derandomize=True, deadline=None, database=None)
def test_cells_come_back_to_the_last_bit(dtype, data):
    floats = st.floats(width=np.finfo(dtype).bits)
    values = np.array(data.draw(st.lists(floats, min_size=1)), dtype)
    back = np.array([*map(float, rows._cells(values))], dtype)
    np.testing.assert_array_equal(back, values)
    number = ~np.isnan(values)  # of NaN, text keeps no sign
    np.testing.assert_array_equal(np.signbit(back[number]), np.signbit(values[number]))


def test_what_a_kill_left_of_writing_a_file_is_removed_and_what_is_not_ours_stays(directory):
    """At the next start of the run, or when it goes on."""
    (directory / "wandb").mkdir()
    (directory / "mine.txt").write_text("mine")
    written = [directory / name for name in ("wandb/mjx_reinforce.json", "config.json")]
    parts = [path.with_name(f".{path.name}.0a1b2c3d") for path in written]
    for config in (Config(), Config(resume=directory)):
        for part in parts:
            part.touch()
        begin(directory, config)
        assert not any(part.exists() for part in parts)
    assert (directory / "mine.txt").read_text() == "mine"


def test_tensorboard_has_the_numbers(directory):
    [charted] = sinks.open_sinks(Config(log=("tensorboard",)), directory, None)
    for update in (0, 5):
        charted.write(evaluation(update))
    charted.close()
    shown = events_of(directory / "tensorboard")
    assert list(shown) == [0, 5]
    expected = sinks.scalars(evaluation(5))
    for name, value in expected.items():
        np.testing.assert_allclose(shown[5][name], value, rtol=1e-6, err_msg=name)


def test_a_run_that_starts_again_drops_everything(directory):
    for _ in range(2):
        [charted] = sinks.open_sinks(Config(log=("tensorboard",)), directory, None)
        charted.write(evaluation(0))
    assert list(events_of(directory / "tensorboard")) == [0]
    assert sum(event.HasField("summary") for event in events(directory / "tensorboard")) == 2


def test_a_full_disk_costs_rows_and_leaves_the_others_whole(directory, monkeypatch):
    [charted] = sinks.open_sinks(Config(log=("tensorboard",)), directory, None)

    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    charted.write(evaluation(0))
    with monkeypatch.context() as patch:
        patch.setattr("mjx_reinforce.runs.sinks.append", full)
        with pytest.raises(OSError, match="No space left"):
            charted.write(evaluation(5))
    charted.write(evaluation(10))
    assert list(events_of(directory / "tensorboard")) == [0, 10]


@pytest.fixture
def wandb(monkeypatch):
    """Stands for W&B; notes how runs begin, and the rows that they log."""
    begun, logged = [], []

    def init(**given):
        begun.append(given)
        log = {"log": lambda row, step: logged.append((step, row)), "finish": lambda: None}
        return SimpleNamespace(**log)

    module = SimpleNamespace(init=init, Settings=dict, Error=RuntimeError)
    monkeypatch.setitem(sys.modules, "wandb", module)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    return module, begun, logged


def test_wandb_is_offline_and_goes_on(directory, wandb):
    """Both parts are of one run."""
    _, begun, logged = wandb
    for updates in ((0, 5), (5, 10)):
        sink = sinks.WeightsAndBiases(directory, None)
        for update in updates:
            sink.write(evaluation(update))
        sink.close()
    assert [step for step, _ in logged] == [0, 5, 5, 10]
    assert logged[1][1]["eval_return/iqm"] == sinks.scalars(evaluation(5))["eval_return/iqm"]
    assert begun[0]["id"] == begun[1]["id"] != ""
    assert {(given["mode"], given["dir"]) for given in begun} == {("offline", directory)}


def test_wandb_that_has_no_key_says_what_to_do(directory, wandb, monkeypatch):
    def init(**_):
        raise RuntimeError("No API key configured.")

    monkeypatch.setattr(wandb[0], "init", init)
    monkeypatch.setenv("WANDB_MODE", "online")
    with pytest.raises(OSError, match="key configured; run wandb login, or unset WANDB_MODE"):
        sinks.open_sinks(Config(log=("wandb",)), directory, None)


def test_a_missing_package_is_named_before_anything_starts(tmp_path, monkeypatch, capsys):
    """Also where a folder of its name lies beside."""
    (tmp_path / "wandb").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    real = [path for path in sys.path if "site-packages" not in path]
    monkeypatch.setattr(sys, "path", real)
    monkeypatch.setattr(sys, "argv", ["train", "--log", "wandb", "--output", "out"])
    with pytest.raises(SystemExit, match=r"^2$"):
        train_module.main()
    assert "--log wandb needs the package wandb" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_with_a_sink_and_its_resumption(run, tmp_path):
    """It goes on from what a kill leaves after an evaluation that no checkpoint has, then again."""
    size = {"num_seeds": 2, "eval_episodes": 2, "hidden_sizes": (4,), "num_episodes": 4}
    often = {"eval_every": 1, "checkpoint_every": 1, "log": ("tensorboard",)}
    config = Config(env="CartPole-v1", env_steps=None, max_updates=6, **size, **often)
    left = tmp_path / "left"

    def kill(evaluation):
        if evaluation.updates[0] == 3:
            shutil.copytree(tmp_path / "out", left)

    mr.run(config, output=tmp_path / "out", observers=[kill], quiet=True)
    for updates in ("5", "8"):
        assert run("--resume", "left", "--max-updates", updates) == 0
    table, shown = as_csv(left / "metrics.csv"), events_of(left / "tensorboard")
    assert list(shown) == sorted({int(row["update"]) for row in table}) == list(range(9))
    last = [row for row in table if row["update"] == 8]
    for name in ("eval_return", "kl", "gradient_snr", "explained_variance"):
        assert shown[8][f"{name}/seed_1"] == pytest.approx(last[1][name], rel=1e-6)

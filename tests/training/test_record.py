"""What a run measures: counts, numbers that are not finite, and going on where it was."""

import io
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from mjx_reinforce.engine.base import Trajectory
from mjx_reinforce.runs import display
from mjx_reinforce.settings.config import Config
from mjx_reinforce.statistics import summarize
from mjx_reinforce.training import failures, rows
from mjx_reinforce.training.programs import evaluate
from mjx_reinforce.training.record import Measured, Progress
from mjx_reinforce.training.run_record import RunRecord


def block(random, num_updates, num_seeds):
    """Metrics of a block in which the last seed stands still after its first update."""
    active = np.ones((num_updates, num_seeds), bool)
    active[1:, -1] = False
    names = ("episode_return", "episode_length", "entropy", "gradient_norm")
    floats = {name: random.normal(size=active.shape).astype(np.float32) for name in names}
    return floats | {
        "active": active,
        "env_steps": np.where(active, 10, 0).astype(np.int32),
        "episodes": random.integers(4, 9, active.shape, np.int32),
        "simulated_steps": random.integers(1, 99, active.shape, np.int32),
        "nonfinite_episodes": random.integers(0, 2, active.shape, np.int32),
        "skipped_update": random.integers(0, 2, active.shape, np.int32),
    }


def evaluation(*returns):
    values = np.array(returns, np.float32)
    whole = {"eval_return": values, "eval_return_stochastic": values / 2, "eval_length": values}
    return whole | {
        "simulated_steps": np.full(len(values), 7, np.int32),
        "eval_steps": np.full(len(values), 6, np.int32),
    }


def evaluation_of(*returns):
    return Measured(np.arange(len(returns)), {}, evaluation(*returns))


def made(metrics):
    return Measured(np.arange(metrics["active"].shape[1]), metrics, {})


def filled():
    """A record of three seeds, two blocks and three evaluations."""
    record, random = RunRecord(Config(num_seeds=3, max_updates=100), 2.0), np.random.default_rng(0)
    record.add_evaluation(evaluation_of(1, 2, 3), 0.1)
    for i in range(2):
        record.add_updates(made(block(random, 4, 3)))
        record.add_evaluation(evaluation_of(i, np.nan, -3.5), 1.0 + i / 3)
    return record


def same(one, other):
    assert list(one) == list(other)
    for name in one:
        assert one[name].dtype == other[name].dtype
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_a_record_is_restored_exactly(tmp_path):
    """It goes through an archive; what the copy measures after that is the same too."""
    record = filled()
    np.savez(tmp_path / "record.npz", allow_pickle=False, **record.arrays())
    copy = RunRecord(Config(num_seeds=3, max_updates=100), 2.0)
    with np.load(tmp_path / "record.npz", allow_pickle=False) as archive:
        copy.restore(dict(archive))
    for i in range(2):
        same(record.arrays(), copy.arrays())
        same(record.history(), copy.history())
        same(record.training(), copy.training())
        assert repr(record.summary("vmap", 1.0, 2.0)) == repr(copy.summary("vmap", 1.0, 2.0))
        assert repr(record.progress()) == repr(copy.progress())
        both = []
        for x in (record, copy):
            x.add_updates(made(block(np.random.default_rng(i), 5, 3)))
            both.append(x.add_evaluation(evaluation_of(5, 6, i), 3.0))
        assert repr(both[0]) == repr(both[1])


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


def test_a_record_of_two_seeds_by_hand():
    config = Config(num_seeds=2, num_episodes=2, env_steps=60)
    record = RunRecord(config, threshold=8.0)
    first = record.add_evaluation(evaluation_of(1, 9), 0.5)
    assert "train_return" not in first
    assert record.is_evaluated()
    assert not record.finished()
    assert record.progress().fraction == 0
    met = record.add_updates(made(METRICS))
    assert not record.is_evaluated()
    assert met.tolist() == [1, 0]
    second = record.add_evaluation(evaluation_of(7, 10), 2.00009)
    keys = ("seed", "update", "episodes", "env_steps", "wall_seconds", "train_return")
    written = rows.lines({key: second[key] for key in keys}).decode().split()
    assert [row.rstrip(",") for row in written] == ["0,2,4,70,2.0,nan", "1,1,2,40,2.0,4.0"]
    assert second["skipped_update"].tolist() == [1, 0]
    progress = record.progress()
    assert progress[:-2] == ((1 + 40 / 60) / 2, 2, 55.0, 8.5, 7.0, 0, 2)
    np.testing.assert_allclose(progress[-2:], [55, 1.5 / 5], rtol=1e-3)
    assert not record.finished()
    np.testing.assert_array_equal(record.training()["episode_return"], [[3, 4], [np.nan] * 2])
    np.testing.assert_array_equal(record.training()["env_steps"], [[30, 40], [70, 40]])
    np.testing.assert_array_equal(record.training()["episodes"], [[2, 2], [4, 2]])
    summary = record.summary("vmap", 3.0, 2.0)
    assert summary["env_steps_to_solve"] == [None, 0]
    # 50 + 60 + 40 in training and 2 (7 + 7) in evaluations.
    assert summary["useful_step_fraction"] == (70 + 40 + 2 * 12) / (150 + 2 * 14)
    assert summary["env_steps_per_second"] == 55
    assert summary["nonfinite"] == [1, 0]


def test_a_test_counts_among_what_was_simulated():
    record = filled()
    counts = {name: int(record.arrays()[name]) for name in ("simulated", "evaluated")}
    assert counts["evaluated"] == 3 * 3 * 6
    tested = {"simulated_steps": np.array([5, 9, 7]), "eval_steps": np.array([4, 3, 2])}
    record.count_steps({name: x.astype(np.int32) for name, x in tested.items()})
    useful = record.env_steps.sum() + counts["evaluated"] + 4 + 3 + 2
    fraction = useful / (counts["simulated"] + 5 + 9 + 7)
    assert record.summary("vmap", 1.0, 2.0)["useful_step_fraction"] == pytest.approx(fraction)


def test_a_seed_is_broken_while_nothing_of_it_is_finite():
    """All its episodes, or its policy. One good update ends it, standing still does not."""
    metrics = {
        "active": np.array([[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 0]], bool),
        "nonfinite_episodes": np.array([[4, 4, 3, 4], [0, 4, 4, 0], [4, 4, 4, 0]]),
        "skipped_update": np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]]),
        "episodes": np.full((3, 4), 4),
    }
    count = failures.broken_in_a_row(np.array([2, 0, 5, 1]), metrics)
    assert count.tolist() == [5, 3, 2, 2]


def test_a_run_is_hopeless_if_all_that_train_are():
    def hopeless(in_a_row, env_steps, block):
        record = RunRecord(Config(num_seeds=3, env_steps=10, eval_every=block), None)
        record.broken_in_a_row, record.env_steps = np.array(in_a_row), np.array(env_steps)
        return record.hopeless()

    assert hopeless([5, 9, 0], [1, 5, 10], block=5)
    assert hopeless([5, 9, 0], [1, 5, 10], block=1)
    assert not hopeless([5, 9, 0], [1, 5, 9], block=5)
    assert not hopeless([5, 9, 0], [1, 5, 10], block=6)
    assert not hopeless([4, 8, 0], [1, 5, 10], block=1)
    assert not hopeless([5, 9, 0], [10, 10, 10], block=5)


def test_broken_updates_are_one_line_with_the_remedy():
    met = np.repeat([0, 2], [994, 6])
    assert failures.describe_nonfinite(met, 7, 9) == (
        "up to update 9, 6 of 1,000 seeds (numbers 1001, 1002, 1003, 1004, 1005, ...) met values "
        "that are not finite or beyond 1e10. Such an episode counts as the worst of its update. "
        "This line comes once; the number of such updates comes at the end. If they are many, give "
        "the model a smaller timestep or more armature, or lower --learning-rate"
    )


def test_percentages_are_rounded_down():
    shown = {1.0: "100.0%", 1 - 1e-12: "99.9%", 0.57: "57.0%", 0.29: "29.0%", 1e-5: "0.0%"}
    assert {fraction: display.percent_done(fraction) for fraction in shown} == shown


def screen(width):
    return Console(
        file=io.StringIO(), width=width, force_terminal=True, color_system=None, markup=False
    )


def test_a_progress_line_fits_in_80_columns(monkeypatch):
    """With the returns, the speed, failed seeds, the time that passed and the time left."""
    console = screen(80)
    monkeypatch.setattr(display, "_Screen", lambda **_: console)
    with display.Display() as shown:
        shown.start(1.0)
        shown.show_progress(Progress(0.4567, 12, 3e4, 12345.6, np.nan, 3, 1000, 123456.0, 45296.0))
    written = console.file.getvalue()
    for text in ("45.6%", "0:00:00", "left 12:34:56", "return 12345.6"):
        assert text in written
    assert "worst nan (3 of 1,000 seeds)  123,456 steps/s\n" in written
    assert "…" not in written


def test_without_a_terminal_an_evaluation_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(display, "_Screen", lambda **_: Console(width=80))
    with display.Display() as shown:
        shown.show_progress(Progress(0.0, 0, 0, 8.0, 7.0, 0, 2, np.nan, np.nan))
        shown.show_progress(Progress(0.25, 5, 4e4, 9.5, 7.0, 0, 2, 1000.0, 59.2))
    first, second = capsys.readouterr().out.splitlines()
    assert first.endswith("return     8.0  worst     7.0  0.0%")
    assert second.endswith("worst     7.0  1,000 steps/s  25.0%  left 0:01:00")


@pytest.mark.parametrize("width", [60, 200])
def test_sentences_wrap_at_words_and_commands_do_not_wrap(monkeypatch, width):
    console = screen(width)
    monkeypatch.setattr(display, "_Screen", lambda **_: console)
    text = " ".join(f"sentence-{i}, which the terminal would cut." for i in range(12))
    line = f"python -m mjx_reinforce.watch {'x' * 300}"
    shown = display.Display()
    shown.say(text)
    shown.show_commands({"To see it": line})
    *sentences, command = console.file.getvalue().splitlines()
    assert max(map(len, sentences)) <= width
    assert len(sentences) > 1
    assert " ".join(sentences).split() == text.split()
    assert command == f"To see it:  {line}"


def test_the_end_table_has_counts(monkeypatch):
    returns = np.full((1, 1000), 1000.0)
    returns[0, :3] = 573.6, 600.0, np.nan
    counts = np.full((1, 1000), 50_000)
    history = {"eval_return": returns, "env_steps": counts, "episodes": counts}
    more = {"status": "finished", "env": "Task-v0", "num_seeds": 1000, "env_steps_per_second": 1e6}
    more |= {"race": 1, "env_steps": [50_000] * 1000}
    more |= {"useful_step_fraction": 0.9999, "compile_seconds": 1.0, "run_seconds": 2.0}
    more |= {
        "threshold": 950.0,
        "nonfinite": [2, 0, 83],
        "final_test_returns": [584.4] * 4,
        "best_test_returns": [572.0] * 4,
    }
    two = {name: values[:, :2] for name, values in history.items()}
    console = screen(200)
    monkeypatch.setattr(display, "_Screen", lambda **_: console)
    few = summarize(two, 950.0) | more | {"num_seeds": 2}
    display.Display().show_summary(few, Path("t"))
    display.Display().show_summary(few | {"num_seeds": 1}, Path("t"))
    titles = [x.strip() for x in console.file.getvalue().splitlines() if "Task-v0" in x]
    assert titles == ["Task-v0, 2 seeds", "Task-v0, 1 seed"]
    assert "586.8 (no interval below six seeds)" in " ".join(console.file.getvalue().split())
    console = screen(80)
    ended = summarize(history, 950.0) | more
    display.Display().show_summary(ended, Path("t/[bold]x"))
    written = " ".join(console.file.getvalue().split())
    for text in (
        "seeds at 950, the task's threshold │ 997 of 1,000 at the end, 997 ever",
        "last policies on fresh starts │ 584.4",
        "best policies on fresh starts │ 572.0 (their evaluation was luck)",
        "99.9%",
    ):
        assert text in written
    assert "(95%" in written
    assert "nan, 1000.0" in written
    assert "not finite │ 1 of 1,000" in written
    assert "updates with values not finite │ 85, of all seeds together" in written
    assert "Files in t/[bold]x" in written
    assert "the picture is learning_curve.png" in written
    for command in ("watch", "report"):  # each on one line, to be copied
        assert f"python -m mjx_reinforce.{command} 't/[bold]x'\n" in console.file.getvalue()
    assert "100" not in written.replace("1000.0", "").replace("1,000", "")
    shown = display.Display()
    shown.warn_of_model(None)
    shown.warn_of_model("this model is unstable")
    console = shown.console = screen(200)
    shown.show_summary(ended | {"status": "stopped", "reason": "nothing is finite"}, Path("t"))
    assert "stopped: nothing is finite; this model is unstable" in console.file.getvalue()


def evaluated(reward, mask, nonfinite_episodes):
    """What an evaluation of N episodes returns that were played so, half of them by the mode."""
    trajectory = Trajectory(
        observation=jnp.zeros((*mask.shape, 1)),
        action=jnp.zeros((*mask.shape, 1)),
        reward=jnp.asarray(reward),
        mask=jnp.asarray(mask),
        nonfinite=jnp.asarray(nonfinite_episodes),
        simulated=jnp.int32(mask.size),
    )
    engine = SimpleNamespace(rollout=lambda *_, **__: trajectory)
    learner = SimpleNamespace(engine=engine, act=None, policy=SimpleNamespace(distribution=None))
    key, half = jax.random.key(0), mask.shape[1] // 2
    return evaluate(None, learner, None, key, num_episodes=half, horizon=len(mask))


@pytest.mark.parametrize(("broken", "is_nan"), [(None, [0, 0]), (1, [1, 0]), (2, [0, 1])])
def test_an_evaluation_with_a_broken_episode_is_nan(broken, is_nan):
    """Two episodes of the mode, then two of samples."""
    mask = np.arange(5)[:, None] < np.array([2, 3, 4, 5])
    result = evaluated(np.where(mask, -1.0, 0.0), mask, np.arange(4) == broken)
    got = [result["eval_return"], result["eval_return_stochastic"]]
    np.testing.assert_allclose(got, np.where(is_nan, np.nan, [-2.5, -4.5]), rtol=1e-6)
    assert result["eval_length"] == 2.5
    assert result["simulated_steps"] == 4 * 5


def test_a_return_that_overflows_is_nan():
    result = evaluated(np.full((2, 2), -3e38, np.float32), np.ones((2, 2), bool), np.zeros(2, bool))
    assert np.isnan(result["eval_return"])

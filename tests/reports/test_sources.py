"""What a report reads: runs, sweeps, and what is said of damaged ones."""

import json

import numpy as np
import pytest
from fake_sweeps import make_sweep
from measured_runs import ONE, make_measured_run

from mjx_reinforce.reports import sources
from mjx_reinforce.reports.experiment import ordered, settings_in_words


def test_runs_are_told_apart_by_what_differs(tmp_path):
    first = make_measured_run(tmp_path / "a")
    second = make_measured_run(
        tmp_path / "b", learning_rate=0.003, hidden_sizes=[], output="elsewhere"
    )
    third = make_measured_run(tmp_path / "c")
    found = sources.read_experiment([first, second, third])
    labels = [part.label for part in found.configurations]
    assert labels[2] == "learning rate 0.003, hidden sizes none"
    assert labels[0] == f"learning rate 0.01, hidden sizes 32-32 in {first}"
    assert "learning_rate" not in found.settings


def make_shares(folder, *, second=3):
    first = make_measured_run(folder / "a", num_seeds=3, seeds="0:3")
    said = {"nonfinite": [1, 0]}
    made = {"num_seeds": 2, "first": second, "evaluations": 3, "summary": said}
    return make_measured_run(folder / "b", seeds=f"{second}:{second + 2}", **made), first


def test_shares_of_a_run_are_one_run(tmp_path):
    """Whichever is first; a seed that ended earlier repeats its last evaluation."""
    shares = make_shares(tmp_path)
    found = sources.read_experiment(shares)
    (part,) = found.configurations
    whole = make_measured_run(tmp_path / "whole", num_seeds=5)
    (like,) = sources.read_experiment([whole]).configurations
    expected = like.eval_return.copy()
    expected[3, 3:] = expected[2, 3:]
    np.testing.assert_array_equal(part.eval_return, expected)
    assert part.seed.tolist() == [0, 1, 2, 3, 4]
    assert part.nonfinite.tolist() == [0, 0, 0, 1, 0]
    assert [path.name for path in part.directories] == ["a", "a", "a", "b", "b"]


def test_shares_of_a_run_join_the_terms_that_all_have(tmp_path):
    """One of an older version has none."""
    terms = ("reward_forward", "reward_ctrl")
    shares = [
        make_measured_run(tmp_path / "a", seeds="0:3", evaluations=3, terms=terms),
        make_measured_run(tmp_path / "b", seeds="3:5", first=3, num_seeds=2, terms=terms),
    ]
    (part,) = sources.read_experiment(shares).configurations
    assert [*part.terms] == ["reward_forward", "reward_ctrl"]
    np.testing.assert_array_equal(part.terms["reward_ctrl"], part.eval_return)
    older = make_measured_run(tmp_path / "c", seeds="5:6", first=5, num_seeds=1)
    (part,) = sources.read_experiment([*shares, older]).configurations
    assert part.terms == {}


@pytest.mark.parametrize(
    "housekeeping", [{"log": ["tensorboard"]}, {"checkpoint_every": 5}, {"like": "other"}]
)
def test_shares_that_were_kept_otherwise_are_joined(tmp_path, housekeeping):
    """What was logged, and how often saved, is nothing that was trained."""
    first = make_measured_run(tmp_path / "a", seeds="0:3", log=[], checkpoint_every=None, like=None)
    kept = {"log": [], "checkpoint_every": None, "like": None} | housekeeping
    second = make_measured_run(tmp_path / "b", first=3, seeds="3:6", **kept)
    (part,) = sources.read_experiment([first, second]).configurations
    assert part.seed.tolist() == [0, 1, 2, 3, 4, 5]


def test_shares_that_differ_are_told_in_what(tmp_path):
    first = make_measured_run(tmp_path / "a", seeds="0:3", discount=0.9, log=[])
    other = {"learning_rate": 0.5, "discount": 0.99, "log": ["wandb"]}
    second = make_measured_run(tmp_path / "b", first=3, seeds="3:6", **other)
    said = r"As shares of one run they would have to agree in learning rate, discount$"
    with pytest.raises(ValueError, match=said):
        sources.read_experiment([first, second])


def test_what_was_swept_is_nothing_that_all_share(tmp_path):
    """Neither of one sweep, whose base has a value that no configuration had, nor of two."""
    base = {"learning_rate": 0.005, "discount": 0.9, "env_set": ["frame_skip=2", "mass=3"]}
    over = {"learning_rate": [0.01, 0.03], "env_set.mass": [1.0, 2.0]}
    first = make_sweep(tmp_path / "a", over=over, settings=base)
    second = make_sweep(tmp_path / "b", over={"estimator": ["mine", "theirs"]}, settings=base)
    shared = {"discount": 0.9, "env_set": ["frame_skip=2"]}
    assert sources.read_experiment([first]).settings == shared
    assert sources.read_experiment([first, second]).settings == shared
    assert sources.read_experiment([second]).settings == base


def test_shares_of_a_sweep_are_one_sweep(tmp_path):
    shares = [make_sweep(tmp_path / name, num_seeds=2) for name in ("a", "b")]
    for number, share in enumerate(shares):
        content = json.loads((share / "sweep.json").read_text())
        content["settings"]["seeds"] = f"{2 * number}:{2 * number + 2}"
        (share / "sweep.json").write_text(json.dumps(content))
        with np.load(share / "curves.npz") as archive:
            curves = dict(archive)
        curves["seed"] += 2 * number
        np.savez(share / "curves.npz", **curves)
    found = sources.read_experiment(shares)
    assert len(found.configurations) == 16
    assert all(part.seed.tolist() == [0, 1, 2, 3] for part in found.configurations)


def test_shares_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"b and .*a have seed 2 in common, with equal settings"):
        sources.read_experiment(make_shares(tmp_path, second=2))
    other = make_measured_run(tmp_path / "c", num_seeds=2, seeds="7:9", first=7, learning_rate=0.5)
    with pytest.raises(ValueError, match=r"learning rate 0\.5 have no seed in common"):
        sources.read_experiment([tmp_path / "a", other])


def test_a_run_that_goes_on_is_read_so_far(tmp_path):
    directory = make_measured_run(tmp_path / "a", summary={"status": "running"})
    (directory / "summary.json").unlink()
    path = directory / "metrics.csv"
    path.write_text(path.read_text()[:-40])
    found = sources.read_experiment([directory])
    assert found.unfinished == [directory]
    assert found.configurations[0].eval_return.shape == (3, 3)


def test_values_in_words():
    settings = {"learning_rate": 0.003, "hidden_sizes": (16, 32), "x_y": None}
    assert settings_in_words(settings) == "learning rate 0.003, hidden sizes 16-32, x y none"
    assert ordered([0.3, 0.1, 0.3]) == [0.1, 0.3]
    assert ordered(["b", "a", "b"]) == ["b", "a"]


def test_what_cannot_be_compared_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    run, sweep = make_measured_run(tmp_path / "run"), make_sweep(tmp_path / "sweep", over=ONE)
    for directories, said in (
        ([run, sweep], "different tasks .*mjx_reinforce.report"),
        ([tmp_path / "empty"], "neither a run nor a sweep"),
        ([tmp_path / "none"], "there is no directory"),
        ([], "nothing to report on"),
    ):
        with pytest.raises(ValueError, match=said):
            sources.read_experiment(directories)


def test_a_sweep_without_evaluations_is_damaged(tmp_path):
    sweep = make_sweep(tmp_path / "none", num_seeds=2, evaluations=2)
    arrays = dict(np.load(sweep / "curves.npz"))
    arrays |= {name: arrays[name][:0] for name in ("eval_return", "env_steps")}
    np.savez(sweep / "curves.npz", **arrays)
    with pytest.raises(ValueError, match=r"curves\.npz is damaged: it has no evaluations"):
        sources.read_experiment([sweep])

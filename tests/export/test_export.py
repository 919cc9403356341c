"""Policies outside this program: in NumPy alone, they act as here."""

import subprocess
import sys

import numpy as np
import pytest
from exports import BOX, CASES, KERNEL, OBSERVATIONS, import_file, make, run_export
from saved_runs import change_arrays, change_env, make_run

from mjx_reinforce import load
from mjx_reinforce.export.arithmetic import HEADS
from mjx_reinforce.registry import DISTRIBUTIONS


@pytest.mark.parametrize(
    ("family", "case"),
    [*((x, "linear") for x in DISTRIBUTIONS), *(("normal", x) for x in CASES if x != "linear")],
)
def test_the_exported_policy_acts_as_ours(tmp_path, monkeypatch, capsys, family, case):
    run = make(tmp_path, family, case)
    run_export(monkeypatch, run)
    written = [run / name for name in ("seed_1.npz", "seed_1.py")]
    assert capsys.readouterr().out.split() == list(map(str, written))
    module, player = import_file(run / "seed_1.py"), load(run)
    assert player.env == module.ENVIRONMENT
    assert module.SEED == 1
    expected = player.act(OBSERVATIONS)
    actions = module.act(OBSERVATIONS)
    assert ("are clipped to" in module.__doc__) == (family != "categorical")
    assert actions.shape == expected.shape
    if family == "categorical":
        np.testing.assert_array_equal(actions, expected)
    else:
        assert actions.dtype == np.float32
        np.testing.assert_allclose(actions, expected, rtol=1e-6, atol=1e-6)
    one = module.act(OBSERVATIONS[0])
    np.testing.assert_allclose(one, expected[0], rtol=1e-6, atol=1e-6)
    if HEADS[family] == "clip" and case == "linear":
        at_a_bound = (expected == BOX["action_low"]) | (expected == BOX["action_high"])
        assert at_a_bound.any()
        assert not at_a_bound.all()


def test_every_family_can_be_exported():
    assert set(HEADS) == set(DISTRIBUTIONS)


def test_a_rounded_tanh_stays_within_the_range(tmp_path, monkeypatch):
    """Of these ranges, the sum of the middle and half the range is beyond many an end."""
    low, high = np.sort(np.random.default_rng(0).uniform(-3, 3, size=(2, 50)), axis=0)
    space = {"action_low": [*low], "action_high": [*high], "hidden_sizes": []}
    run = make_run(tmp_path, "InvertedPendulum-v5", policy="tanh-normal", **space)
    change_arrays(run, **{KERNEL: lambda x: 100 * x})
    run_export(monkeypatch, run)
    actions = import_file(run / "seed_1.py").act(OBSERVATIONS)
    low, high = low.astype(np.float32), high.astype(np.float32)
    assert np.all((low <= actions) & (actions <= high))
    np.testing.assert_allclose([actions.min(axis=0), actions.max(axis=0)], [low, high], rtol=1e-6)


def test_unbounded_actions(tmp_path, monkeypatch):
    space = {"action_low": [-np.inf, -1.0], "action_high": [np.inf, 3.0]}
    run = make_run(tmp_path, "InvertedPendulum-v5", policy="normal-softplus", **space)
    run_export(monkeypatch, run)
    actions = import_file(run / "seed_1.py").act(OBSERVATIONS)
    np.testing.assert_allclose(actions, load(run).act(OBSERVATIONS), rtol=1e-6, atol=1e-6)


def test_the_numpy_file_is_short_and_needs_nothing_else(tmp_path, monkeypatch):
    """It is imported where nothing but NumPy and the standard library can be."""
    run = make_run(tmp_path, "InvertedPendulum-v5")
    run_export(monkeypatch, run, "--output", run / "brain.npz")
    source = (run / "brain.py").read_text()
    code = [line for line in source.split('"""', 2)[2].splitlines() if line.strip()]
    assert len(code) <= 20
    program = (
        "import sys\n"
        "for name in ('jax', 'flax', 'mjx_reinforce', 'scipy'): sys.modules[name] = None\n"
        "import brain, numpy\n"
        "print(brain.act(numpy.zeros(4))[0])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], cwd=run, check=True, capture_output=True, text=True
    )
    assert float(ran.stdout) == pytest.approx(load(run).act(np.zeros(4))[0], abs=1e-6)


def test_names_in_files_stay_text(tmp_path, monkeypatch):
    run = make_run(tmp_path)
    name = '"""\nraise SystemExit\n{env}'
    change_env(run, name)
    run_export(monkeypatch, run)
    assert name == import_file(run / "seed_1.py").ENVIRONMENT


def test_a_policy_of_the_package_can_be_exported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_export(monkeypatch, "Swimmer-v5")
    observation = np.linspace(-1, 1, 8)
    theirs = import_file(tmp_path / "Swimmer_v5.py").act(observation)
    np.testing.assert_allclose(theirs, load("Swimmer-v5").act(observation), atol=2e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output", "policy.pt"], "--output must end in .npz or .h or .onnx, got policy.pt"),
        (["--output", "my-policy.npz"], "cannot import 'my-policy.py'"),
        (["--output", "class.npz"], "cannot import 'class.py'"),
        (["--output", "numpy.npz"], "cannot import 'numpy.py' beside"),
        (["--output", "random.npz"], "cannot import 'random.py' beside"),
        (["--output", "nowhere/policy.npz"], "cannot write to nowhere"),
        (["--output", "mine.py/policy.npz"], "cannot write to mine.py"),
        (["--output", "/proc/policy.npz"], "cannot write to /proc; choose another"),
        (["--output", "mine.npz"], "mine.py exists; pass --overwrite"),
        (["--output", "folder.npz", "--overwrite"], "folder.npz exists"),
        (["--seed", "9"], "has no seed 9: its seeds are 0 to 2"),
        (["--which", "best"], "has no policy/best"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    make_run(tmp_path)
    (tmp_path / "mine.py").write_text("mine")
    (tmp_path / "folder.npz").mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit, match="2"):
        run_export(monkeypatch, ".", *arguments)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "mine.py").read_text() == "mine"


def test_overwrite_is_by_request_alone(tmp_path, monkeypatch):
    run = make_run(tmp_path)
    (run / "seed_1.py").write_text("mine")
    run_export(monkeypatch, run, "--overwrite")
    assert import_file(run / "seed_1.py").SEED == 1

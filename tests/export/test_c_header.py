"""Policies in C: compiled without a warning, they act as here."""

import ctypes
import re

import numpy as np
import pytest
from c_programs import COMPILERS, header_actions, load_library, needs_compiler, pointer
from exports import BOX, CASES, KERNEL, OBSERVATIONS, make, run_export
from saved_runs import change, change_arrays, change_env, make_run

from mjx_reinforce import load
from mjx_reinforce.export.c_header import declaration
from mjx_reinforce.registry import DISTRIBUTIONS


def exported(monkeypatch, run, folder):
    """Exports a run, and returns the header."""
    run_export(monkeypatch, run, "--output", folder / "policy.h")
    return folder / "policy.h"


def assert_same_actions(actions, expected, low, high):
    """Within 1e-5 of half of each range, and within the range."""
    half_range = (np.asarray(high) - np.asarray(low)) / 2
    assert np.all(np.abs(actions - expected) <= 1e-5 * half_range)
    assert np.all((np.float32(low) <= actions) & (actions <= np.float32(high)))


@needs_compiler
@pytest.mark.parametrize(
    ("family", "case"),
    [*((x, "linear") for x in DISTRIBUTIONS), ("tanh-normal", "mlp")]
    + [("normal", x) for x in CASES if x != "linear"],
)
def test_the_header_acts_as_ours(tmp_path, monkeypatch, capsys, family, case):
    run = make(tmp_path, family, case)
    header = exported(monkeypatch, run, tmp_path)
    assert capsys.readouterr().out == f"{header}\n"
    expected = load(run).act(OBSERVATIONS)
    actions = header_actions(header, OBSERVATIONS, expected.shape[1:])
    if family == "categorical":
        np.testing.assert_array_equal(actions, expected)
        assert set(actions) == {0, 1}
        return
    low, high = BOX.values()
    assert_same_actions(actions, expected, low, high)
    if case == "linear" and family != "tanh-normal":
        at_a_bound = (actions == np.float32(low)) | (actions == np.float32(high))
        assert at_a_bound.any()
        assert not at_a_bound.all()


@needs_compiler
@pytest.mark.parametrize("task", ["Ant-v5", "CartPole-v1", "Humanoid-v5", "InvertedPendulum-v5"])
def test_trained_policies(tmp_path, monkeypatch, task):
    """On observations around those of training, and far beyond where they are clipped."""
    header = exported(monkeypatch, task, tmp_path)
    player = load(task)
    normalizer = player.actor.normalizer
    std = np.sqrt(normalizer.m2 / normalizer.count)
    noise = np.random.default_rng(0).normal(size=(1000, player.observation_size))
    observations = normalizer.mean + std * noise * np.geomspace(0.1, 50, len(noise))[:, None]
    expected = player.act(observations)
    actions = header_actions(header, observations, expected.shape[1:])
    if task == "CartPole-v1":
        np.testing.assert_array_equal(actions, expected)
        assert set(actions) == {0, 1}
        return
    ranges = {"Ant-v5": 1.0, "Humanoid-v5": 0.4, "InvertedPendulum-v5": 3.0}
    bound = np.full(expected.shape[1], ranges[task])
    assert_same_actions(actions, expected, -bound, bound)


@needs_compiler
def test_unbounded_actions(tmp_path, monkeypatch):
    space = {"action_low": [-np.inf, -1.0], "action_high": [np.inf, 3.0]}
    run = make_run(tmp_path, "InvertedPendulum-v5", policy="normal-softplus", **space)
    actions = header_actions(exported(monkeypatch, run, tmp_path), OBSERVATIONS, (2,))
    np.testing.assert_allclose(actions, load(run).act(OBSERVATIONS), rtol=1e-6, atol=1e-6)


@needs_compiler
def test_a_rounded_tanh_stays_within_the_range(tmp_path, monkeypatch):
    """Of these ranges, the sum of the middle and half the range is beyond many an end."""
    low, high = np.sort(np.random.default_rng(0).uniform(-3, 3, size=(2, 50)), axis=0)
    space = {"action_low": [*low], "action_high": [*high], "hidden_sizes": []}
    run = make_run(tmp_path, "InvertedPendulum-v5", policy="tanh-normal", **space)
    change_arrays(run, **{KERNEL: lambda x: 100 * x})
    actions = header_actions(exported(monkeypatch, run, tmp_path), OBSERVATIONS, (50,))
    low, high = low.astype(np.float32), high.astype(np.float32)
    assert np.all((low <= actions) & (actions <= high))
    np.testing.assert_allclose([actions.min(axis=0), actions.max(axis=0)], [low, high], rtol=1e-6)


@needs_compiler
@pytest.mark.parametrize("family", ["normal", "tanh-normal", "categorical"])
def test_what_is_not_a_number_stays_so(tmp_path, monkeypatch, family):
    """A broken sensor gives no action at a bound; infinity is clipped as any number is."""
    run = make(tmp_path, family, "mlp")
    header = exported(monkeypatch, run, tmp_path)
    observations = np.zeros((3, 4))
    observations[:, 1] = np.nan, np.inf, -np.inf
    expected = load(run).act(observations)
    actions = header_actions(header, observations, expected.shape[1:])
    if family != "categorical":
        assert np.isnan(actions[0]).all()
    np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-6)


@needs_compiler
def test_the_greatest_is_the_first_of_equals(tmp_path, monkeypatch):
    run = make(tmp_path, "categorical", "linear")
    arrays = {KERNEL: np.zeros_like, KERNEL.replace("kernel", "bias"): np.zeros_like}
    change_arrays(run, **arrays)
    actions = header_actions(exported(monkeypatch, run, tmp_path), OBSERVATIONS, ())
    np.testing.assert_array_equal(actions, 0)
    np.testing.assert_array_equal(actions, load(run).act(OBSERVATIONS))


@needs_compiler
@pytest.mark.parametrize("family", ["tanh-normal", "categorical"])
def test_the_header_is_both_c_and_cpp(tmp_path, monkeypatch, family):
    header = exported(monkeypatch, make(tmp_path, family, "mlp"), tmp_path)
    shape = () if family == "categorical" else (3,)
    in_c, in_cpp = (header_actions(header, OBSERVATIONS, shape, x) for x in COMPILERS)
    np.testing.assert_array_equal(in_c, in_cpp)


@needs_compiler
def test_one_program_has_two_policies(tmp_path, monkeypatch):
    run = make(tmp_path, "normal", "mlp")
    for seed, name in enumerate(("walk.h", "stand_2.h")):
        run_export(monkeypatch, run, "--seed", seed, "--output", tmp_path / name)
    includes = '#include "walk.h"\n#include "stand_2.h"\n#include "walk.h"\n'
    code = "void {0}(float *x);\nvoid {0}(float *x) {{ {0}_act(x, x); }}\n"
    functions = [code.format(name) for name in ("walk", "stand_2")]
    library = load_library(tmp_path, includes + "".join(functions))
    for seed, function in enumerate((library.walk, library.stand_2)):
        numbers = np.float32([1.0, -2.0, 3.0, -4.0])
        expected = load(run, seed).act(numbers)
        function(pointer(numbers))
        assert_same_actions(numbers[:3], expected, *BOX.values())


@needs_compiler
def test_numbers_come_back_exactly(tmp_path):
    """Of all sizes, those below the normal ones and infinity too."""
    bits = np.random.default_rng(0).integers(2**32, size=10_000, dtype=np.uint32)
    drawn = bits.view(np.float32)
    plain = np.float32([0.0, -0.0, 1.0, -10.0, 1e10, 1e-10, 1e-45, np.inf, -np.inf])
    numbers = np.concatenate([plain, drawn[np.isfinite(drawn)]])
    text = declaration("numbers", numbers).replace("static ", "")
    code = f"#include <math.h>\nextern const float numbers[{len(numbers)}];\n{text}\n"
    library = load_library(tmp_path, code)
    compiled = (ctypes.c_float * len(numbers)).in_dll(library, "numbers")
    assert np.frombuffer(compiled, np.float32).tobytes() == numbers.tobytes()


def test_the_function_is_short_and_has_no_state(tmp_path, monkeypatch):
    header = exported(monkeypatch, make(tmp_path, "tanh-normal", "four layers"), tmp_path)
    text = header.read_text()
    assert max(map(len, text.splitlines())) <= 100
    assert re.findall("#include .*", text.partition("#define")[2]) == ["#include <math.h>"]
    function = text.partition("static inline void")[2].splitlines()
    assert len(function) <= 25
    assert set(re.findall(r"^static (\w+)", text, re.M)) == {"const", "inline"}


@needs_compiler
def test_names_in_files_stay_text(tmp_path, monkeypatch):
    """They are in a comment of the header, which they do not end."""
    run = make(tmp_path / "$name*/ \\", "normal", "mlp")
    change_env(run, "*/ /* ??/\n#error\n${env} \\\n{env} é")
    header = exported(monkeypatch, run, tmp_path)
    actions = header_actions(header, OBSERVATIONS, (3,))
    assert_same_actions(actions, load(run).act(OBSERVATIONS), *BOX.values())


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("my-policy.h", "no names that begin with 'my-policy'; choose an --output of letters,"),
        ("2nd.h", "no names that begin with '2nd'"),
        ("_walk.h", "no names that begin with '_walk'"),
        ("größe.h", "no names that begin with 'größe'"),
        ("nowhere/policy.h", "cannot write to nowhere"),
        ("mine.h", "mine.h exists; pass --overwrite"),
        ("policy.hpp", "--output must end in .npz or .h or .onnx, got policy.hpp"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, capsys, output, message):
    make_run(tmp_path)
    (tmp_path / "mine.h").write_text("mine")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit, match="2"):
        run_export(monkeypatch, ".", "--output", output)
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "mine.h").read_text() == "mine"


def test_overwrite_is_by_request_alone(tmp_path, monkeypatch):
    run = make_run(tmp_path)
    (run / "mine.h").write_text("mine")
    run_export(monkeypatch, run, "--output", run / "mine.h", "--overwrite")
    assert "mine_act" in (run / "mine.h").read_text()


def test_a_distribution_of_ones_own_is_refused(tmp_path, monkeypatch, capsys):
    """What follows from its network is known to its code alone."""
    run = make_run(tmp_path, "InvertedPendulum-v5")
    change(run / "policy" / "policy.json", policy="mine:laplace")
    change_arrays(run)
    with pytest.raises(SystemExit, match="2"):
        exported(monkeypatch, run, tmp_path)
    assert "names the distribution mine:laplace" in capsys.readouterr().err
    assert not (tmp_path / "policy.h").exists()

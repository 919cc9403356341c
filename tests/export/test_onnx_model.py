"""The ONNX model of hand-made layers, evaluated by ONNX's own reference in NumPy."""

import itertools
import sys

import numpy as np
import pytest

from mjx_reinforce.export.arithmetic import Arithmetic, import_onnx, onnx_model

onnx = pytest.importorskip("onnx")

RNG = np.random.default_rng(0)
OBSERVATION = RNG.normal(size=(6, 3)).astype(np.float32) * 4


def arithmetic(head, *, scaled=True, num_layers=2):
    sizes = [3, *[4] * (num_layers - 1), 2]
    arrays = {"low": [-0.5, -0.2], "high": [0.3, 0.4]} if head == "clip" else {}
    arrays |= {"middle": [1.0, 2.0], "half": [0.5, 3.0]} if head == "tanh" else {}
    arrays |= {"mean": [1.0, -1.0, 0.5], "std": [0.5, 2.0, 0.1]} if scaled else {}
    for i, shape in enumerate(itertools.pairwise(sizes)):
        arrays |= {f"weight_{i}": RNG.normal(size=shape), f"bias_{i}": RNG.normal(size=shape[1])}
    arrays = {name: np.asarray(x, np.float32) for name, x in arrays.items()}
    return Arithmetic(arrays, num_layers, head, clip=1.5)


def expected(plain, x):
    p = plain.arrays
    if "mean" in p:
        x = np.clip((x - p["mean"]) / p["std"], -1.5, 1.5)
    for i in range(plain.num_layers):
        x = x @ p[f"weight_{i}"] + p[f"bias_{i}"]
        x = np.tanh(x) if i < plain.num_layers - 1 else x
    return {
        "mean": lambda: x,
        "clip": lambda: np.clip(x, p["low"], p["high"]),
        "tanh": lambda: p["middle"] + p["half"] * np.tanh(x),
        "argmax": lambda: np.argmax(x, axis=1),
    }[plain.head]()


@pytest.mark.parametrize("head", ["mean", "clip", "tanh", "argmax"])
@pytest.mark.parametrize(("scaled", "num_layers"), [(True, 3), (False, 1)])
def test_the_model_computes_the_arithmetic(head, scaled, num_layers):
    from onnx.reference import ReferenceEvaluator

    plain = arithmetic(head, scaled=scaled, num_layers=num_layers)
    model = onnx.load_model_from_string(onnx_model(plain, "Task-v0", 7))
    (action,) = ReferenceEvaluator(model).run(None, {"observation": OBSERVATION})
    assert action.dtype == (np.int64 if head == "argmax" else np.float32)
    np.testing.assert_allclose(action, expected(plain, OBSERVATION), rtol=1e-5, atol=1e-6)
    shape = [x.dim_param or x.dim_value for x in model.graph.output[0].type.tensor_type.shape.dim]
    assert shape == (["N"] if head == "argmax" else ["N", 2])
    assert "Task-v0, seed 7" in model.graph.doc_string
    assert model.opset_import[0].version <= 17
    stored = {x.name for x in model.graph.initializer}
    assert stored - {"least", "greatest"} == set(plain.arrays)
    assert ("least" in stored) == scaled


def test_without_the_package_the_remedy_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"--to onnx needs the package onnx .*pip install onnx"):
        import_onnx()

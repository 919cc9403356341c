"""A policy for ONNX: one graph, with scaling, clipping and the memory of observations inside."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_reinforce.export.arithmetic import Arithmetic
from mjx_reinforce.learning import normalize

#: The versions of ONNX's operators and of its files, which programs since 2023 read.
_OPSET = 17
_IR_VERSION = 8


class _Nodes:
    """The nodes of a graph, and the arrays that they read."""

    def __init__(self, onnx: Any):
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.arrays: list[Any] = []

    def add(self, operator: str, *inputs: Any, output: str = "", **attributes: int) -> str:
        """Adds a node, whose inputs are names and arrays, and returns the name of its output."""
        names = [entry if isinstance(entry, str) else self._array(entry) for entry in inputs]
        output = output or f"x_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, names, [output], **attributes))
        return output

    def clip(self, x: str, low: Any, high: Any, output: str = "") -> str:
        """Adds what keeps ``x`` within bounds; NaN stays NaN."""
        return self.add("Min", self.add("Max", x, low), high, output=output)

    def _array(self, array: Any) -> str:
        name = f"array_{len(self.arrays)}"
        self.arrays.append(self.onnx.numpy_helper.from_array(np.asarray(array), name))
        return name


def onnx_policy(arithmetic: Arithmetic, run: str, env: str, seed: int) -> bytes:
    """Returns the file.

    Its inputs are ``observation`` [N, O] and, of a policy that sees several, ``frames`` [N, F*O]:
    what ``next_frames`` was one step before, and at the start of an episode the first observation F
    times. The output is ``action`` [N, A], or [N] if discrete; with a control also ``ctrl`` [N, A].
    With a gait there is an input ``step`` [N], too: the env steps in which ``ctrl`` is applied.

    Args:
      arithmetic: of one seed's policy.
      run: the name of the run.
      env: the id of the environment.
      seed: the number of the seed.

    Raises:
      ValueError: the package onnx is not installed.
    """
    try:
        onnx = importlib.import_module("onnx")
    except ImportError as error:
        raise ValueError("to write .onnx, pip install 'mjx-reinforce[onnx]'") from error
    graph = _Nodes(onnx)
    num_inputs = len(arithmetic.layers[0][0])
    size = num_inputs // arithmetic.frames
    inputs: dict[str, Sequence[str | int]] = {"observation": ["N", size]}
    outputs: dict[str, Sequence[str | int]] = {"action": ["N", len(arithmetic.layers[-1][1])]}
    observation = "observation"
    if arithmetic.frames > 1:
        inputs["frames"] = outputs["next_frames"] = ["N", num_inputs]
        newer = graph.add("Slice", "frames", *(np.array([x]) for x in (size, num_inputs, 1)))
        observation = graph.add("Concat", newer, observation, axis=1, output="next_frames")
    _act(graph, arithmetic, observation)
    if arithmetic.head == "argmax":
        outputs["action"] = ["N"]
    control = arithmetic.control
    if control:
        outputs["ctrl"] = ["N", len(control["home"])]
        moved = graph.add("Add", graph.add("Mul", "action", control["scale"]), control["home"])
        if "gait" in control:
            inputs["step"] = ["N"]
            phase = graph.add("Mod", "step", np.array(len(control["gait"])))
            moved = graph.add("Add", moved, graph.add("Gather", control["gait"], phase, axis=0))
        graph.clip(moved, control["ctrl_low"], control["ctrl_high"], output="ctrl")
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "policy",
            _declarations(onnx, inputs),
            _declarations(onnx, outputs),
            graph.arrays,
        ),
        producer_name="mjx_reinforce",
        doc_string=f"run {run}, environment {env}, seed {seed}",
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
    )
    return model.SerializeToString()


def _declarations(onnx: Any, shapes: dict[str, Sequence[str | int]]) -> list[Any]:
    """Returns the inputs or the outputs of a graph: rows of numbers, and integers [N]."""
    types = {1: onnx.TensorProto.INT64, 2: onnx.TensorProto.FLOAT}
    return [
        onnx.helper.make_tensor_value_info(name, types[len(shape)], shape)
        for name, shape in shapes.items()
    ]


def _act(graph: _Nodes, arithmetic: Arithmetic, x: str) -> None:
    """Adds what computes ``action`` of all that the policy sees."""
    if arithmetic.scale:
        deviation = graph.add("Sub", x, arithmetic.scale["mean"])
        scaled = graph.add("Div", deviation, arithmetic.scale["std"])
        x = graph.clip(scaled, np.float32(-normalize.CLIP), np.float32(normalize.CLIP))
    for weight, bias in arithmetic.layers[:-1]:
        x = graph.add("Tanh", graph.add("Gemm", x, weight, bias))
    # The last layer is linear.
    x = graph.add("Gemm", x, *arithmetic.layers[-1])
    bounds = arithmetic.bounds
    if arithmetic.head == "argmax":
        graph.add("ArgMax", x, axis=1, keepdims=0, output="action")
        return
    if arithmetic.head == "tanh":
        x = graph.add(
            "Add", graph.add("Mul", graph.add("Tanh", x), bounds["half"]), bounds["middle"]
        )
    graph.clip(x, bounds["low"], bounds["high"], output="action")

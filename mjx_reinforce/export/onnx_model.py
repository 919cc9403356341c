"""A policy as an ONNX model."""

from typing import Any

import numpy as np

from mjx_reinforce.export.arithmetic import Arithmetic

# Of 2021 and 2022: runtimes that are installed anywhere know them.
_OPSET, _IR_VERSION = 17, 8


def import_onnx() -> Any:
    """Returns the package ``onnx``.

    Raises:
      ValueError: it is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise ValueError(f"--to onnx needs the package onnx ({error}); pip install onnx") from error
    return onnx


def onnx_model(plain: Arithmetic, env: str, seed: int) -> bytes:
    """Returns the content of an .onnx file.

    Its input ``observation`` is float32 [N, O]; its output ``action`` is float32 [N, A] or, if
    discrete, int64 [N].

    Args:
      plain: what it computes.
      env: the id of the environment, for the model's description.
      seed: the number of the seed, for the description too.
    """
    onnx = import_onnx()
    helper, float32, int64 = onnx.helper, onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
    size, out = plain.sizes
    discrete = plain.head == "argmax"
    constants = plain.arrays | {
        "least": np.float32(-plain.clip),
        "greatest": np.float32(plain.clip),
    }
    nodes = [
        helper.make_node(operation, inputs, [output], **attributes)
        for operation, inputs, output, attributes in _nodes(plain)
    ]
    used = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", float32, ["N", size])],
        [
            helper.make_tensor_value_info("action", int64, ["N"])
            if discrete
            else helper.make_tensor_value_info("action", float32, ["N", out])
        ],
        [onnx.numpy_helper.from_array(x, n) for n, x in sorted(constants.items()) if n in used],
        doc_string=f"The deterministic action of a trained policy for {env}, seed {seed}.",
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="mjx_reinforce",
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _nodes(plain: Arithmetic) -> list[tuple[str, list[str], str, dict[str, Any]]]:
    """Returns operations in order: its name, inputs, output and attributes."""
    nodes: list[tuple[str, list[str], str, dict[str, Any]]] = []
    x = "observation"
    if plain.normalized:
        nodes += [
            ("Sub", [x, "mean"], "centred", {}),
            ("Div", ["centred", "std"], "scaled", {}),
            ("Clip", ["scaled", "least", "greatest"], "clipped", {}),
        ]
        x = "clipped"
    for i in range(plain.num_layers):
        nodes.append(("Gemm", [x, f"weight_{i}", f"bias_{i}"], f"layer_{i}", {}))
        x = f"layer_{i}"
        if i < plain.num_layers - 1:
            nodes.append(("Tanh", [x], f"units_{i}", {}))
            x = f"units_{i}"
    return (
        nodes
        + {
            "mean": [("Identity", [x], "action", {})],
            "clip": [("Max", [x, "low"], "above", {}), ("Min", ["above", "high"], "action", {})],
            "tanh": [
                ("Tanh", [x], "squashed", {}),
                ("Mul", ["squashed", "half"], "spread", {}),
                ("Add", ["spread", "middle"], "action", {}),
            ],
            "argmax": [("ArgMax", [x], "action", {"axis": 1, "keepdims": 0})],
        }[plain.head]
    )

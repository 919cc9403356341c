"""A policy for C and C++: one header, which needs <math.h> alone."""

import string
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.export.arithmetic import Arithmetic
from mjx_reinforce.learning import normalize

#: Bytes of a float.
_FLOAT = np.dtype(np.float32).itemsize


def c_header(arithmetic: Arithmetic, name: str, run: str, env: str, seed: int) -> str:
    """Returns the text of the header.

    Args:
      arithmetic: of one seed's policy.
      name: of the file without its ending; all names in the header begin with it.
      run: the name of the run.
      env: the id of the environment.
      seed: the number of the seed.
    """
    layers = arithmetic.layers
    sizes = [len(weight) for weight, _ in layers] + [len(layers[-1][1])]
    # A row is the bias of a unit and its weights, in the order in which the function reads them.
    units = [np.concatenate([bias[:, None], weight.T], axis=1).ravel() for weight, bias in layers]
    arrays = arithmetic.scale | {"network": np.concatenate(units)} | arithmetic.bounds
    arrays |= {key: array.ravel() for key, array in arithmetic.control.items()}
    scaled = "observation[i]" if arithmetic.frames == 1 else "state->frames[i]"
    if arithmetic.scale:
        deviations = f"({scaled} - {name}_mean[i]) / {name}_std[i]"
        scaled = f"{name}_clip({deviations}, -{normalize.CLIP}f, {normalize.CLIP}f)"
    parts = _bounded(name, arithmetic.head)
    if arithmetic.head == "argmax":
        parts = _discrete(name)
    size = f"{name.upper()}_OBSERVATION_SIZE"
    parts |= {"frames": "", "remember": "", "memory": "state", "count": size, "control": ""}
    if arithmetic.frames > 1:
        parts |= _remembering(name, arithmetic.frames, parts)
    if arithmetic.control:
        parts["control"] = _filled("c_header_control.txt", name)
    if "gait" in arithmetic.control:
        period = len(arithmetic.control["gait"])
        parts["control"] = _filled("c_header_gait.txt", name, period=period)
    return _filled(
        "c_header.txt",
        name,
        **parts,
        run=ascii(run),
        env=ascii(env),
        seed=seed,
        inputs=sizes[0] // arithmetic.frames,
        outputs=sizes[-1],
        sizes=", ".join(map(str, sizes)),
        layers=len(layers),
        width=max(sizes),
        constants=_FLOAT * sum(map(len, arrays.values())),
        stack=2 * _FLOAT * max(sizes),
        arrays="\n".join(declaration(f"{name}_{key}", array) for key, array in arrays.items()),
        scaled=scaled,
    )


def _filled(file: str, name: str, **placeholders: Any) -> str:
    """Returns the text of a template with its placeholders filled in."""
    template = string.Template(Path(__file__).with_name(file).read_text("utf-8"))
    return template.substitute(placeholders, name=name, NAME=name.upper())


def _bounded(name: str, head: str) -> dict[str, str]:
    """Returns the parts of the text that depend on the action, which is [A], by their names."""
    action = "x[i]"
    if head == "tanh":
        action = f"{name}_middle[i] + {name}_half[i] * tanhf(x[i])"
    size = "ACTION_SIZE"
    return {
        "size": size,
        "shape": "numbers, in the environment's order and units, clipped to their ranges",
        "use": f"float action[{name.upper()}_{size}]; {name}_act(observation, action);",
        "returned": "void",
        "arguments": "const float *observation, float *action",
        "ending": f"""\
    for (int i = 0; i < {name.upper()}_{size}; i++)
        action[i] = {name}_clip({action},
                                {name}_low[i], {name}_high[i]);""",
    }


def _discrete(name: str) -> dict[str, str]:
    """Returns the parts of the text that depend on the action, which is a number, as above."""
    size = "NUM_ACTIONS"
    return {
        "size": size,
        "shape": "choices, of which it is the number, from 0",
        "use": f"int action = {name}_act(observation);",
        "returned": "int",
        "arguments": "const float *observation",
        "ending": f"""\
    int greatest = 0;
    for (int i = 1; i < {name.upper()}_{size}; i++)
        if (x[i] > x[greatest])
            greatest = i;
    return greatest;""",
    }


def _remembering(name: str, frames: int, parts: dict[str, str]) -> dict[str, str]:
    """Returns the parts of the text that differ where the policy sees several observations."""
    size = f"{name.upper()}_OBSERVATION_SIZE"
    declared, _, call = parts["use"].rpartition(f"{name}_act(")
    return {
        "memory": "state of its own",
        "count": f"{name.upper()}_FRAMES * {size}",
        "use": f"struct {name}_state state; {name}_reset(&state);  // at an episode's start\n"
        f"//     {declared}{name}_act(&state, {call}",
        "arguments": f"struct {name}_state *state, {parts['arguments']}",
        "frames": _filled("c_header_frames.txt", name, number=frames),
        "remember": f"    {name}_remember(state, observation);\n",
    }


def declaration(name: str, array: np.ndarray) -> str:
    """Returns the C of an array [N], from which a compiler gets the same float32."""
    numbers = ", ".join(_literal(number) for number in array.tolist())
    text = f"static const float {name}[{len(array)}] = {{{numbers}}};"
    return textwrap.fill(text, 100, subsequent_indent="    ", break_on_hyphens=False)


def _literal(number: float) -> str:
    """Returns a number in C."""
    if np.isinf(number):
        return "INFINITY" if number > 0 else "-INFINITY"
    digits = f"{number:.9g}"
    # 1f is no number in C; 1.0f and 1e-05f are.
    if digits.lstrip("-").isdigit():
        digits += ".0"
    return f"{digits}f"

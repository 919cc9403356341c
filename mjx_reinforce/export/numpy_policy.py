"""A policy for NumPy: an archive of arrays, and a short module with a function ``act``."""

from pathlib import Path

from mjx_reinforce.export.arithmetic import Arithmetic
from mjx_reinforce.files import Arrays
from mjx_reinforce.learning import normalize

#: How the action follows from the last layer x, by the head.
_ENDINGS = {
    "clip": 'np.clip(x, P["low"], P["high"])',
    # Rounded, middle + half may be beyond high.
    "tanh": 'np.clip(P["middle"] + P["half"] * np.tanh(x), P["low"], P["high"])',
    "argmax": "np.argmax(x, axis=-1)",
}


def numpy_policy(arithmetic: Arithmetic, name: str, env: str, seed: int) -> tuple[Arrays, str]:
    """Returns the arrays, and the text of the module.

    Args:
      arithmetic: of one seed's policy.
      name: of the module, and of the archive of the arrays beside it.
      env: the id of the environment.
      seed: the number of the seed.
    """
    arrays = arithmetic.scale | arithmetic.bounds | arithmetic.control
    lines = []
    if arithmetic.scale:
        scaled = '(x - P["mean"]) / P["std"]'
        lines = [f"x = np.clip({scaled}, -{normalize.CLIP}, {normalize.CLIP})"]
    layers = arithmetic.layers
    for i, (weight, bias) in enumerate(layers):
        arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
        layer = f'x @ P["weight_{i}"] + P["bias_{i}"]'
        # The last layer is linear; its nonlinearity is in the ending.
        if i < len(layers) - 1:
            layer = f"np.tanh({layer})"
        lines.append(f"x = {layer}")
    lines.append(f"return {_ENDINGS[arithmetic.head]}")
    inputs = len(layers[0][0]) // arithmetic.frames
    outputs = len(layers[-1][1])
    results = ("an integer", "[N]")
    if arithmetic.head != "argmax":
        results = (f"[{outputs}]", f"[N, {outputs}]")
    shapes = f"[{inputs}] -> {results[0]}"
    if arithmetic.frames == 1:
        shapes += f", or [N, {inputs}] -> {results[1]}"
    if arithmetic.head != "argmax":
        shapes += "\n\nActions are clipped to the range that the environment declared."
    placeholders = {"use": "", "acting": name, "further": ""}
    if arithmetic.frames > 1:
        placeholders = {
            "use": f"policy = {name}.Policy()  # one an episode\n    ",
            "acting": "policy",
            "further": _text("frames").format(size=inputs, number=arithmetic.frames),
        }
    if "gait" in arithmetic.control:
        placeholders["further"] += _text("gait")
    elif arithmetic.control:
        placeholders["further"] += _text("control")
    template = Path(__file__).with_name("numpy_policy.txt").read_text("utf-8")
    body = "\n    ".join(lines)
    source = template.format(
        name=name, shapes=shapes, env=ascii(env), seed=seed, body=body, **placeholders
    )
    return arrays, source


def _text(part: str) -> str:
    """Returns what a module has more, if the policy sees several frames, or there is a control."""
    return Path(__file__).with_name(f"numpy_policy_{part}.txt").read_text("utf-8")

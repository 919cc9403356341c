"""From MJCF to a model that MJX runs, or a clear error."""

import contextlib
import importlib.resources
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from mujoco import MjModel, MjSpec  # pyright: ignore[reportAttributeAccessIssue] - a C extension

from mjx_reinforce.checks import explain

# MJX prints two lines when its optional Warp backend is not installed; this
# package asks for the JAX implementation by name, so they only worry people.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

#: Part of MJX's message -> what to change in the MJCF.
_REMEDIES = {
    "SOL_PGS": 'set <option solver="Newton"/>',
    "INT_IMPLICIT": 'set <option integrator="implicitfast"/>',
    "fluid drag": 'set <option integrator="Euler"/> or remove density and viscosity',
    "collisions": "keep that pair apart with contype and conaffinity, or use spheres, capsules, "
    "boxes and planes",
    "margin/gap": "remove margin and gap from those geoms",
    "condim=1": 'set <option cone="pyramidal"/> or condim="3"',
    "sensor": "remove that sensor",
    "Flex": "remove the flexible body",
}
_ELSE = "remove it; MuJoCo's documentation lists what MJX supports under 'MJX, feature parity'"


def load(xml_file: str) -> Any:
    """Compiles an MJCF file of the package's assets, or the user's own by a path.

    Args:
      xml_file: the name of an asset, or a path with a folder in it, such as "./mine.xml".

    Raises:
      ValueError: there is no such file, MuJoCo cannot compile it, or nothing in it can be moved.
    """
    if "/" in xml_file or "\\" in xml_file:
        if not Path(xml_file).is_file():
            raise ValueError(f"there is no model {xml_file!r} in {Path.cwd()}")
        model = _compile(MjModel.from_xml_path, xml_file, xml_file)
    else:
        asset = importlib.resources.files("mjx_reinforce.envs") / "assets" / xml_file
        if not asset.is_file():
            raise ValueError(
                f"the package has no model {xml_file!r}; give a path with a folder for your own, "
                f"such as './{xml_file}'"
            )
        with warnings.catch_warnings():
            # HalfCheetah's total mass is given as Gymnasium gives it, which MuJoCo deprecates.
            warnings.filterwarnings("ignore", ".*'settotalmass' is deprecated")
            text = asset.read_text(encoding="utf-8")
            model = _compile(lambda text: MjSpec.from_string(text).compile(), text, xml_file)
    if not model.nu:
        raise ValueError(f"the model {xml_file!r} has no actuators; add an <actuator> element")
    return model


def _compile(compiler: Callable[[str], Any], source: str, xml_file: str) -> Any:
    """Returns the model, or raises ValueError with the file's name and what MuJoCo says."""
    try:
        return compiler(source)
    except Exception as error:  # mujoco.FatalError is no ValueError
        raise ValueError(f"MuJoCo cannot compile {xml_file!r}: {explain(error)}") from error


def to_mjx(model: Any, xml_file: str) -> mjx.Model:
    """Returns MJX's version of a compiled model.

    Args:
      model: the compiled model.
      xml_file: where it came from, for the message.

    Raises:
      ValueError: MJX cannot run it; the message names the feature and what to change.
    """
    try:
        converted = mjx.put_model(model, impl="jax")
        # Notices what the model alone does not show; its arrays are not made.
        jax.eval_shape(lambda: mjx.make_data(model, impl="jax"))
    except NotImplementedError as error:
        feature = str(error)
        remedy = next((change for part, change in _REMEDIES.items() if part in feature), _ELSE)
        raise ValueError(f"MJX cannot run {xml_file!r}: {feature}; {remedy}") from error
    return converted

"""``python -m mjx_reinforce.new arm.xml`` writes the class of a task from a MuJoCo model."""

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mjx_reinforce.files import check_module, check_output, write_bytes
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.envs.mending.edits import Mended


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment for a MuJoCo model, with a reward for you to change."""

    model: tyro.conf.Positional[Path]
    """The model, .xml."""
    output: Path | None = None
    """The file to write, .py, in the folder of the model. By default the model's name."""
    fix: bool = False
    """Write a copy of the model, NAME_fixed.xml, with what makes it fast, accepted, and stable, and
    the class for this copy. Each change is printed."""
    overwrite: bool = False
    """Replace files that exist."""


def main() -> None:
    """Reads the command line, writes, and exits: 0 done, 2 bad input, 130 interrupted."""
    run_command(NewSettings, "new", write_class)


def write_class(settings: NewSettings) -> None:
    """Writes the file, and says what to do with it.

    Raises:
      ValueError: there is no such model, MuJoCo cannot run it, or the file's name does not fit or
        exists.
    """
    xml = settings.model
    if xml.suffix.lower() != ".xml":
        raise ValueError(f"{xml} is not a model; give an MJCF file that ends in .xml")
    mended = _mend(settings) if settings.fix else None
    if mended is not None:
        xml = xml.with_name(f"{xml.stem}_fixed.xml")
    output = settings.output or xml.with_name(f"{re.sub(r'[^0-9a-zA-Z]+', '_', xml.stem)}.py")
    check_module(output, "my_robot.py")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    check_output(output, settings.overwrite, ".py")
    if mended is not None:
        _write_fixed(mended, xml, settings.overwrite)
    from mjx_reinforce.envs import models, refusals
    from mjx_reinforce.envs.instability import instability
    from mjx_reinforce.envs.mending.ground import contact_counts
    from mjx_reinforce.templates import legged, model_class
    from mjx_reinforce.templates.facts import class_name, is_free

    path = _path(xml)
    model = models.load_model(path)
    in_c = refusals.best_in_c(model)
    if in_c is None:
        models.to_mjx(model, path)
    module = output.stem
    lack = legged.lacking(model) if is_free(model) else None
    is_legged = is_free(model) and lack is None
    template = legged if is_legged else model_class
    write_bytes(output, template.class_source(model, xml.name, module).encode())
    print(contact_counts(model))
    print(_player(model, in_c))
    if (warning := instability(model)) is not None:
        print(warning)
    if not settings.fix:
        _offer_fix(path)
    if lack is not None:
        print(f"for the class of a robot on legs the model lacks {lack}")
    task = f"{module}:{class_name(module)}"
    advice = "write its reward"
    preset, budget = "", ""
    if is_legged:
        advice = "it walks as commanded; read it"
        # The minute of other presets is too short to learn to walk.
        preset, budget = " legged", " --minutes 20"
    print(f"{output}: {advice}, then, in its folder:")
    print(f"  python -m mjx_reinforce.train{preset} --env {task}{budget} --output {module}_run")


def _player(model: Any, in_c: str | None) -> str:
    """Returns what plays a model on this CPU; ``in_c`` is of ``refusals.best_in_c``."""
    from mjx_reinforce.engine.play import cxx
    from mjx_reinforce.engine.team import supported

    if in_c is None:
        return "machine code will play it"
    compiler = cxx.compiler() if supported.why(model) is None else None
    if compiler is not None:
        return f"machine code by {compiler} will play it, and C MuJoCo where there is none: {in_c}"
    return f"C MuJoCo will play it: {in_c}"


def _path(xml: Path) -> str:
    """Returns a path with a folder: a name alone would mean one of the package's own models."""
    return str(Path.cwd() / xml if xml.parent == Path() else xml)


def _mend(settings: NewSettings) -> "Mended | None":
    """Returns a mended copy of the model, or says that there is nothing to mend.

    Raises:
      ValueError: the model cannot be loaded.
    """
    from mjx_reinforce.envs import models
    from mjx_reinforce.envs.mending import edits

    path = _path(settings.model)
    models.load_model(path)  # says what it lacks
    mended = edits.mend(path)
    if not mended.edits:
        print(f"{settings.model} needs no fix")
        return None
    return mended


def _write_fixed(mended: "Mended", output: Path, overwrite: bool) -> None:
    """Writes a mended model, and says what was changed; ValueError if there is such a file."""
    from mjx_reinforce.envs.mending import written

    check_output(output, overwrite, ".xml")
    write_bytes(output, written.text(mended.spec, output.parent).encode())
    print(f"{output}:", *mended.edits, sep="\n  ")


def _offer_fix(path: str) -> None:
    """Says what ``--fix`` would change in a model."""
    from mjx_reinforce.envs.mending import edits

    changes = edits.mend(path).edits
    if changes:
        print("--fix would write a copy with these changes:", *changes, sep="\n  ")


if __name__ == "__main__":
    main()

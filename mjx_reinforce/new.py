"""``python -m mjx_reinforce.new arm.xml`` writes the class of a task from a MuJoCo model."""

import dataclasses
import re
from pathlib import Path

import tyro

from mjx_reinforce.files import check_module, check_output, write_bytes
from mjx_reinforce.settings.flags import run_command


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment for a MuJoCo model, with a reward for you to change."""

    model: tyro.conf.Positional[Path]
    """The model, .xml."""
    output: Path | None = None
    """The file to write, .py, in the folder of the model. By default the model's name."""
    overwrite: bool = False
    """Replace a file that exists."""


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
    output = settings.output or xml.with_name(f"{re.sub(r'[^0-9a-zA-Z]+', '_', xml.stem)}.py")
    if xml.suffix.lower() != ".xml":
        raise ValueError(f"{xml} is not a model; give an MJCF file that ends in .xml")
    check_module(output, "my_robot.py")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    check_output(output, settings.overwrite, ".py")
    from mjx_reinforce.envs import models, refusals
    from mjx_reinforce.envs.instability import instability
    from mjx_reinforce.templates import legged, model_class
    from mjx_reinforce.templates.facts import class_name

    path = str(xml)
    # A file's name alone would mean one of the package's own models.
    if xml.parent == Path():
        path = str(Path.cwd() / xml)
    model = models.load_model(path)
    in_c = refusals.best_in_c(model)
    if in_c is None:
        models.to_mjx(model, path)
    module = output.stem
    is_legged = legged.is_legged(model)
    template = legged if is_legged else model_class
    write_bytes(output, template.class_source(model, xml.name, module).encode())
    command = "train legged" if is_legged else "train"
    options = f"--env {module}:{class_name(module)} --output {module}_run"
    if in_c is not None:
        print(f"C MuJoCo will play it: {in_c}")
    if (warning := instability(model)) is not None:
        print(warning)
    print(f"{output}: write its reward, then, in its folder:")
    print(f"python -m mjx_reinforce.{command} {options}")


if __name__ == "__main__":
    main()

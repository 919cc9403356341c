"""``python -m mjx_reinforce.export RUN`` takes a trained policy out of the program."""

import dataclasses
import sys
from pathlib import Path

import tyro

from mjx_reinforce.export.run_files import PolicyChoice, Run, SeedChoice, read_run
from mjx_reinforce.files import check_header, check_module, check_output
from mjx_reinforce.settings.flags import run_command


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExportSettings:
    """Write a trained policy for NumPy alone, for C as one header, or for ONNX, without noise."""

    run: tyro.conf.Positional[Path]
    """A run directory, or a task whose trained policy comes with the package."""
    seed: SeedChoice = "best"
    """Seed to export: best, worst or median by its final evaluation, or a number."""
    which: PolicyChoice = "last"
    """The policy at the end of training (last), or the best at any evaluation, if it was kept."""
    output: Path | None = None
    """For NumPy the archive, .npz, beside which goes a short .py; for C and C++ the header, .h; for
    ONNX the graph, .onnx, which needs mjx-reinforce[onnx]. By default seed_NUMBER.npz in the run
    directory, or the name of the task and .npz in the current folder for a policy of the package.
    """
    env: str | None = None
    """The task that the run was trained on, module:Class if it is your own. Its code runs, and what
    it applies of an action, home + scale * action and its gait, comes into the files."""
    overwrite: bool = False
    """Replace files that exist."""


def main() -> None:
    """Reads the command line, exports, and exits: 0 done, 2 bad input, 130 interrupted."""
    run_command(ExportSettings, "export", export_and_say)


def export_and_say(settings: ExportSettings) -> None:
    """Writes the files, prints their names, and says if a control is missing in them."""
    print(*export(settings), sep="\n")
    env = read_run(settings.run).env
    # Only a task of the user's own may have one; its code runs only where it is named.
    if settings.env is None and ":" in env:
        note = "the file has actions alone: for the task's control, home + scale * action, add"
        print(f"{note} --env {env}", file=sys.stderr)


def export(settings: ExportSettings) -> list[Path]:
    """Writes the files and returns their names.

    Raises:
      ValueError: a setting is out of range, or the run is damaged.
      OSError: a file cannot be written.
    """
    run = read_run(settings.run)
    if settings.env not in (None, run.env):
        raise ValueError(f"--env is {settings.env}, but {run.directory} was trained on {run.env}")
    from mjx_reinforce.export.arithmetic import policy_arithmetic
    from mjx_reinforce.export.c_header import c_header
    from mjx_reinforce.export.numpy_policy import numpy_policy
    from mjx_reinforce.export.policy_files import load_seed
    from mjx_reinforce.files import write_arrays, write_bytes

    player, saved = load_seed(run, settings.seed, settings.which)
    outputs = output_files(settings, run, player.seed)
    name = outputs[0].stem
    arithmetic = policy_arithmetic(saved)
    if settings.env is not None:
        from mjx_reinforce import envs
        from mjx_reinforce.export.control import affine_control

        task = envs.make_set(run.env, run.env_set)
        arithmetic = arithmetic._replace(control=affine_control(task))
    run_name = run.directory.resolve().name
    if outputs[0].suffix.lower() == ".onnx":
        from mjx_reinforce.export.onnx_policy import onnx_policy

        graph = onnx_policy(arithmetic, run_name, player.env, player.seed)
        write_bytes(outputs[0], graph)
        return outputs
    if outputs[0].suffix.lower() == ".h":
        source = c_header(arithmetic, name, run_name, player.env, player.seed)
    else:
        arrays, source = numpy_policy(arithmetic, name, player.env, player.seed)
        write_arrays(outputs[0], arrays)
    write_bytes(outputs[-1], source.encode())
    return outputs


def output_files(settings: ExportSettings, run: Run, seed: int) -> list[Path]:
    """Returns the files that are to be written.

    Raises:
      ValueError: their name does not fit, they exist, or they cannot be written.
    """
    default_path = run.directory / f"seed_{seed}.npz"
    if run.packaged:
        default_path = Path(f"{run.env.replace('-', '_')}.npz")
    output = settings.output or default_path
    check_output(output, settings.overwrite, ".npz", ".h", ".onnx")
    if output.suffix.lower() == ".h":
        check_header(output, "policy.h")
        return [output]
    if output.suffix.lower() == ".onnx":
        return [output]
    module = output.with_suffix(".py")
    check_module(module, "policy.npz")
    check_output(module, settings.overwrite, ".py")
    return [output, module]


if __name__ == "__main__":
    main()

"""From a function written out, such as a step of an episode, to machine code, kept on disk."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, observation_size
from mjx_reinforce.engine.cpu import handler, kernel, lanes, machine
from mjx_reinforce.engine.gpu import kernel as gpu_kernel
from mjx_reinforce.engine.gpu import lockstep, ptx
from mjx_reinforce.engine.gpu import seam as gpu_seam
from mjx_reinforce.engine.play import available, native_step, objects
from mjx_reinforce.engine.play.native_step import StepResult
from mjx_reinforce.engine.scalar import jaxprs, scalarized
from mjx_reinforce.engine.scalar.graph import Limits

#: Loops stay loops: the Runge-Kutta stages too, which are a scan of four.
LOOPS = Limits(scans=1, unrollable=1)
#: On GPUs a loop over few contacts is written out: an array that a loop reads is in memory there.
GPU_LOOPS = LOOPS._replace(unrollable=lockstep.WRITTEN_OUT)
#: The folders whose files decide what is written for a step.
_WRITERS = ("mjx_reinforce.engine",)


class NativeProgram(NamedTuple):
    """Machine code that plays.

    code: of ``seam.call`` on a CPU, of ``seam.launch`` on a GPU
    record: shape and dtype of the observation, the action and the reward of a step
    """

    code: machine.Code | ptx.Kernel
    record: list[jax.ShapeDtypeStruct]


def build_program(
    env: Environment, act: Act, actor: PyTree, distribution: Acts, length: int
) -> NativeProgram:
    """Returns the program of an environment and a policy, compiled unless memory or disk has it.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs of the distribution.
      actor: what ``act`` reads, or its shapes.
      distribution: the family whose parameters the outputs are.
      length: steps whose noise is drawn with one key.

    Raises:
      TooLarge: writing the step out would take minutes.
      UnsupportedPrimitive: the step has an operation that cannot be written.
    """
    examples = native_step.examples(env, actor)
    function = native_step.step_function(env, act, distribution, length)
    if available.platform() != "cpu":  # a thread without an episode does not play
        function, examples = while_running(function), examples[:-1]
    num_actor = len(jax.tree.leaves(actor))
    check = functools.partial(available.check_seconds, env, entries=observation_size(env))

    def write_cpu(written: scalarized.Scalarized, target: machine.Machine) -> str:
        buffers = [x for x in jax.tree.leaves((actor, examples[1].state)) if np.prod(x.shape)]
        sizes = [np.dtype(x.dtype).itemsize for x in written.out_avals[: lanes.NUM_RECORDS]]
        num_args = lanes.NUM_CONTROLS + len(buffers)
        entry = handler.handler_text(num_args, [*sizes, 4, 4, 4], target.lanes)
        flush = handler.flush(target.triple)
        return entry + kernel.player_text(written, num_actor, target.lanes, flush)

    def write_gpu(written: scalarized.Scalarized) -> str:
        return gpu_kernel.kernel_text(written, num_actor)

    code, shapes = load("play", name_of(env), function, examples, check, write_cpu, write_gpu)
    return NativeProgram(code, shapes.record)


def load(
    use: str,
    name: str,
    function: Callable[..., Any],
    examples: Sequence[PyTree],
    check: Callable[[jaxprs.Program], None],
    write_cpu: Callable[[scalarized.Scalarized, machine.Machine], str],
    write_gpu: Callable[[scalarized.Scalarized], str],
) -> tuple[machine.Code | ptx.Kernel, Any]:
    """Returns the machine code of a function, compiled unless memory or disk has it, and shapes.

    They are those of what the function returns.

    Args:
      use: what the writers write around the function.
      name: of the function, for people.
      function: what is written out.
      examples: its arguments, or their shapes.
      check: raises TooLarge for what takes too long to write and compile.
      write_cpu: what is written out, and for which machine -> LLVM IR.
      write_gpu: what is written out -> LLVM IR.
    """
    on_cpu = available.platform() == "cpu"
    target = machine.this_machine() if on_cpu else None
    traced, shapes = jaxprs.trace(function, *examples)
    source = f"{use} {jaxprs.fingerprint(traced)} {objects.source_digest(*_WRITERS)}"

    def write() -> str:
        check(traced)
        varying, limits = [True] * len(jax.tree.leaves(examples)), LOOPS if target else GPU_LOOPS
        written = scalarized.build(function, examples, varying, native_step.BRANCH_COST, limits)
        title = f"; {name}, {lockstep.operations(written.schedule):,} scalar operations\n"
        return title + (write_cpu(written, target) if target else write_gpu(written))

    if target:
        return machine.load_module(source, write, handler.NAMES, target, objects.folder()), shapes
    capability = gpu_seam.compute_capability()
    return ptx.load_kernel(source, write, capability, objects.folder()), shapes


def name_of(env: Any) -> str:
    """Returns the class of an environment, and of those in it if it wraps one."""
    inner = getattr(env, "env", None)
    return type(env).__name__ + ("" if inner is None else f" of {name_of(inner)}")


def refusal(error: Exception) -> str:
    """Returns in one line why machine code cannot be made, from what was raised."""
    if isinstance(error, TypeError):
        return " ".join(str(error).split())
    if type(error) is RuntimeError:
        return f"LLVM refuses its program: {' '.join(str(error).split())}"
    return scalar.refusal(error)


def while_running(function: Callable[..., StepResult]) -> Any:
    """Returns a step of episodes that are running."""
    return lambda *args: function(*args, jnp.int32(1))

"""From an environment and a policy to machine code, made once and kept on disk."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce import fused
from mjx_reinforce.engines import episode
from mjx_reinforce.engines.native import available, look, objects, outlook, step
from mjx_reinforce.engines.native.cpu import handler, kernel, machine, queue
from mjx_reinforce.engines.native.cpu.denormals import flush
from mjx_reinforce.engines.native.gpu import kernel as gpu_kernel
from mjx_reinforce.engines.native.gpu import ptx, scratch
from mjx_reinforce.engines.native.gpu import seam as gpu_seam
from mjx_reinforce.engines.native.gpu.lockstep import operations
from mjx_reinforce.engines.native.step import StepResult
from mjx_reinforce.fused import jaxprs, scalarized
from mjx_reinforce.fused.graph import Limits
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.types import Environment, PyTree

#: Loops stay loops: the Runge-Kutta stages too, which are a scan of four.
LOOPS = Limits(scans=1, unrollable=1)
#: On GPUs a loop over few contacts is written out: an array that a loop reads is in memory there.
GPU_LOOPS = LOOPS._replace(unrollable=scratch.WRITTEN_OUT)
#: The folders whose files decide what is written for a step.
WRITERS = ("mjx_reinforce.fused", "mjx_reinforce.engines")


class NativeProgram(NamedTuple):
    """Machine code that plays.

    code: of ``seam.call`` on a CPU, of ``seam.launch`` on a GPU
    record: shape and dtype of the observation, the action and the reward of a step
    """

    code: machine.Code | ptx.Kernel
    record: list[jax.ShapeDtypeStruct]


def build_program(
    env: Environment, act: episode.Act, actor: PyTree, distribution: Distribution, length: int
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
    examples = step.examples(env, actor)
    function = step.step_function(env, act, distribution, length)
    on_cpu = available.platform() == "cpu"
    if not on_cpu:  # a thread without an episode does not play
        function, examples = while_running(function), examples[:-1]
    traced, shapes = jaxprs.trace(function, *examples)
    source = f"{jaxprs.fingerprint(traced)} {objects.source_digest(*WRITERS)}"
    folder = objects.folder()
    target = machine.this_machine() if on_cpu else None

    def write() -> str:  # not called where memory or disk has the code
        outlook.check_seconds(env, traced, shapes.record[0].size)
        limits, varying = LOOPS if on_cpu else GPU_LOOPS, [True] * len(jax.tree.leaves(examples))
        written = scalarized.build(function, examples, varying, step.BRANCH_COST, limits)
        title = look.title(look.name_of(env), operations(written.schedule))
        if target is None:
            return title + gpu_kernel.kernel_text(written, len(jax.tree.leaves(actor)))
        return title + _write_cpu(written, examples, target)

    if target is None:
        code = ptx.load_kernel(source, write, gpu_seam.compute_capability(), folder)
    else:
        code = machine.load_module(source, write, handler.NAMES, target, folder)
    return NativeProgram(code, shapes.record)


def refusal(error: Exception) -> str:
    """Returns in one line why machine code cannot be made, from what was raised."""
    if isinstance(error, TypeError):
        return " ".join(str(error).split())
    if type(error) is RuntimeError:
        return f"LLVM refuses its program: {' '.join(str(error).split())}"
    return fused.refusal(error)


def while_running(function: Callable[..., StepResult]) -> Any:
    """Returns a step of episodes that are running."""
    return lambda *args: function(*args, jnp.int32(1))


def _write_cpu(
    written: scalarized.Scalarized, examples: tuple[Any, ...], target: machine.Machine
) -> str:
    """Writes a step, and all around it, as LLVM IR."""
    actor, carried, *_ = examples
    num_actor = len(jax.tree.leaves(actor))
    buffers = [x for x in jax.tree.leaves((actor, carried.state)) if np.prod(x.shape)]
    records = [np.dtype(x.dtype).itemsize for x in written.out_avals[: queue.NUM_RECORDS]]
    num_args, lanes = queue.NUM_CONTROLS + len(buffers), target.lanes
    entry = handler.handler_text(num_args, [*records, 4, 4, 4], lanes)
    return entry + kernel.player_text(written, num_actor, lanes, flush(target.triple))

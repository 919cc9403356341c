"""From a function written out, such as a step of an episode, to machine code, kept on disk."""

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine import base, episode, objects, scalar
from mjx_reinforce.engine.base import (
    Act,
    Acts,
    Environment,
    PyTree,
    observation_size,
    term_names,
)
from mjx_reinforce.engine.checks import explain
from mjx_reinforce.engine.cpu import handler, kernel, machine
from mjx_reinforce.engine.cpu import seam as cpu_seam
from mjx_reinforce.engine.gpu import cubin, team_kernel, thread_kernel
from mjx_reinforce.engine.gpu import seam as gpu_seam
from mjx_reinforce.engine.gpu.source import Source
from mjx_reinforce.engine.play import available, c_mujoco, cxx
from mjx_reinforce.engine.play import teams as team
from mjx_reinforce.engine.play.counter import at_counter, split
from mjx_reinforce.engine.scalar import jaxprs, scalarized

#: A branch of more scalar operations is skipped where no lane needs it.
BRANCH_COST = 40
#: Up to which length scans are written out: the Runge-Kutta stages, which are four, stay a loop.
SCANS = 1
#: For a thread of a GPU loops over few contacts are, too: what a loop reads is in memory there.
_GPU_SCANS = 25
#: The folders whose files decide what is written for a step.
_WRITERS = ("mjx_reinforce.engine",)


class Carried(NamedTuple):
    """What an episode carries from step to step.

    state: the leaves of the environment's state, bools as int32
    keys: [2, 2] uint32: the episode's key, and the key of the noise of its present chunk
    """

    state: list[Any]
    keys: Any


class StepResult(NamedTuple):
    """What a step returns.

    record: observation [O], action [A] or [], reward [], or with its K terms behind it [1 + K]
    alive: [] int32, 1 where the episode goes on
    broken: [] int32, 1 where it left the finite numbers
    carried: what the next step reads
    """

    record: list[Any]
    alive: Any
    broken: Any
    carried: Carried


def step_function(
    env: Environment, act: Act, distribution: Acts, length: int
) -> Callable[..., StepResult]:
    """Returns (actor, carried, t, deterministic, alive) -> ``StepResult``, for one episode.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs of the distribution.
      distribution: the family whose parameters the outputs are.
      length: steps whose noise is drawn with one key, as ``episode.play_chunks`` does.
    """
    leaves, tree = jax.tree.flatten(base.shapes(env.reset, jax.random.key(0)))
    step_noise = jax.eval_shape(lambda: distribution.noise(jax.random.key(0), ()))
    words_per_step = int(np.prod(step_noise.shape, dtype=int))
    terms = term_names(env)

    def step(actor, carry, t, deterministic, is_alive):
        """Plays one step of one episode, and draws no more noise than that takes."""
        state = tree.unflatten(
            restored(x, leaf.dtype) for x, leaf in zip(carry.state, leaves, strict=True)
        )
        is_alive = is_alive != 0
        # ``episode.draw_noise`` splits the key where a chunk begins, and draws the noise of all its
        # steps from the second half. That of this step begins so many words later.
        chunk_step = t % length
        keys = lax.cond(chunk_step == 0, lambda keys: split(keys[0]), lambda keys: keys, carry.keys)
        offset = (chunk_step * words_per_step).astype(jnp.uint32)
        noise = distribution.noise(at_counter(keys[1], offset), ())
        step_result = episode.step(
            env.step, act, distribution, actor, state, noise, is_alive, deterministic != 0, terms
        )
        next_state = jax.tree.leaves(episode.hold(is_alive, step_result.state, state))
        reward = step_result.reward
        if terms:
            term_rewards = [step_result.terms[name].astype(reward.dtype) for name in terms]
            reward = jnp.stack([reward, *term_rewards])
        return StepResult(
            record=[step_result.observation, step_result.action, reward],
            alive=step_result.alive.astype(jnp.int32),
            broken=step_result.broken.astype(jnp.int32),
            carried=Carried([stored(x) for x in next_state], keys),
        )

    return step


def stored(x: jax.Array) -> jax.Array:
    """Returns a leaf of the state as it is kept between steps: bools as int32."""
    return x.astype(jnp.int32) if x.dtype == bool else x


def restored(x: jax.Array, dtype: np.dtype) -> jax.Array:
    """Returns a leaf of the state as the environment has it, of what ``stored`` made of it."""
    return x != 0 if dtype == np.bool_ else x


def step_shapes(env: Environment, actor: PyTree) -> tuple[Any, ...]:
    """Returns the shapes of the arguments of a step."""
    shape = jax.ShapeDtypeStruct
    state = base.shapes(lambda: [stored(x) for x in jax.tree.leaves(env.reset(jax.random.key(0)))])
    flag = shape((), jnp.int32)
    actor = jax.tree.map(lambda x: shape(x.shape, x.dtype), actor)
    return actor, Carried(state, shape((2, 2), jnp.uint32)), flag, flag, flag


class NativeProgram(NamedTuple):
    """Machine code that plays.

    code: of ``seam.call`` on a CPU, of ``seam.launch`` on a GPU
    record: shape and dtype of the observation, the action and the reward of a step
    terms: names of the reward's terms, which are recorded behind it
    episodes_last: whether the records are [T, numbers, N], and not [T, N, numbers]
    """

    code: machine.Code | cubin.Kernel
    record: list[jax.ShapeDtypeStruct]
    terms: tuple[str, ...]
    episodes_last: bool = False


def has_one_lane(env: Any) -> bool:
    """Returns whether the device code with one lane plays on this CPU what C MuJoCo plays else."""
    if available.platform() != "cpu" or jax.config.values["jax_enable_x64"]:
        return False  # it is in float32
    is_best = c_mujoco.why_best(env) is not None and team.why_not(env) is None
    return is_best and cxx.compiler() is not None


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
    examples = step_shapes(env, actor)
    function = step_function(env, act, distribution, length)
    # A lane of a vector computes steps also where it has no episode; a thread of a GPU does not.
    one_lane = has_one_lane(env)
    if available.platform() != "cpu" or one_lane:
        function = while_running(function)
        examples = examples[:-1]
    num_actor = len(jax.tree.leaves(actor))

    def write_cpu(expansion: scalarized.Scalarized, target: machine.Machine) -> str:
        """Writes the step, the loop over episodes and the way from XLA to it, as LLVM IR."""
        buffers = [x for x in jax.tree.leaves((actor, examples[1].state)) if np.prod(x.shape)]
        sizes = [np.dtype(x.dtype).itemsize for x in expansion.out_avals[: kernel.NUM_RECORDS]]
        num_args = kernel.NUM_CONTROLS + len(buffers)
        entry = handler.handler_text(num_args, [*sizes, 4, 4, 4], target.lanes)
        entry += handler.flush(target.triple)
        return entry + kernel.kernel_text(expansion, num_actor, target.lanes)

    writers = Writers(
        write_cpu,
        functools.partial(thread_kernel.player_text, num_actor=num_actor),
        functools.partial(team_kernel.player_text, num_actor=num_actor),
        cxx.player_text,
    )
    code, shapes = load("play", env, function, examples, writers, name_of(env))
    episodes_last = isinstance(code, cubin.Kernel) or one_lane
    return NativeProgram(code, shapes.record, term_names(env), episodes_last)


class Writers(NamedTuple):
    """What writes a kernel around a function that is written out.

    cpu: what is written out, and for which machine -> LLVM IR
    gpu: what is written out -> CUDA C++, for a thread an episode
    team: what is written out, and with which physics -> CUDA C++, for several lanes an episode
    lane: what is written out, and that C++ -> the text of ``cxx.compiled``, for one lane
    """

    cpu: Callable[[scalarized.Scalarized, machine.Machine], str]
    gpu: Callable[[scalarized.Scalarized], Source]
    team: Callable[[scalarized.Scalarized, team_kernel.Physics], Source]
    lane: Callable[[scalarized.Scalarized, Source], str]


def load(
    job: str,
    env: Environment | None,
    function: Callable[..., Any],
    examples: Sequence[PyTree],
    writers: Writers,
    name: str,
) -> tuple[machine.Code | cubin.Kernel, Any]:
    """Returns the machine code of a function, compiled unless memory or disk has it, and shapes.

    They are those of what the function returns.

    Args:
      job: what the writers write around the function.
      env: the environment that the function plays, if it plays one.
      function: what is written out.
      examples: its arguments, or their shapes.
      writers: what is written around it.
      name: of the function, for people.

    Raises:
      TooLarge: writing it out and compiling it would take minutes.
      UnsupportedPrimitive: it has an operation that cannot be written.
    """
    if env is not None and has_one_lane(env):
        return _by_one_lane(job, env, function, examples, writers, name)
    target = machine.this_machine() if available.platform() == "cpu" else None
    unrolled = SCANS
    few = None
    if target is None:
        plays_few = team.play_few(env)
        if plays_few or team.why_not(env) is None:
            few, team_shapes = _by_teams(job, env, function, examples, writers, name)
            if few is not None and not plays_few:
                return few, team_shapes
        if env is not None and c_mujoco.why_best(env) is not None:
            raise scalar.UnsupportedPrimitive("a thread of a GPU plays it slower than C MuJoCo")
        unrolled = _GPU_SCANS
    program, shapes = scalarized.trace(function, *examples, unrolled=unrolled)
    source = f"{job} {jaxprs.fingerprint(program)} {objects.source_digest(*_WRITERS)}"

    def write() -> scalarized.Scalarized:
        """Returns the function written out: it takes seconds, and is done where code is made."""
        return _write_out(program, shapes, 0 if env is None else observation_size(env))

    if target:

        def write_cpu() -> str:
            expansion = write()
            return f"; {_title(name, expansion)}\n{writers.cpu(expansion, target)}"

        code = machine.load_module(source, write_cpu, handler.SYMBOLS, target, objects.folder())
        return code, shapes

    def write_gpu() -> Source:
        expansion = write()
        return _titled(writers.gpu(expansion), name, expansion)

    capability = gpu_seam.compute_capability()
    code = cubin.load_kernel(source, write_gpu, capability, objects.folder())
    return code._replace(few=few), shapes


def _title(name: str, expansion: scalarized.Scalarized) -> str:
    """Returns what a kernel is, for people."""
    return f"{name}, {sum(expansion.operations.values()):,} scalar operations"


def _titled(source: Source, name: str, expansion: scalarized.Scalarized) -> Source:
    """Returns a GPU's kernel whose text begins with what it is."""
    return source._replace(text=f"// {_title(name, expansion)}\n{source.text}")


def _write_out(program: jaxprs.Program, shapes: Any, entries: int = 0) -> scalarized.Scalarized:
    """Returns a traced function written out; of an observation of many entries it is too large.

    Raises:
      UnsupportedPrimitive: it closes over an array that has no value yet.
    """
    expansion = scalarized.build(program, shapes, BRANCH_COST, SCANS, entries=entries)
    if expansion.captured:
        raise scalar.UnsupportedPrimitive("it needs an array of an outer transformation")
    return expansion


def _by_teams(
    job: str,
    env: Any,
    function: Callable[..., Any],
    examples: Sequence[PyTree],
    writers: Writers,
    name: str,
) -> tuple[cubin.Kernel | None, Any]:
    """Returns what ``load`` does, for teams of lanes; no kernel if they do not play this."""
    model = team.physics_model(env)
    with base.keeping_whole():
        try:
            program, shapes = scalarized.trace(function, *examples)
            # A kernel has the tables of one model. A function that simulates another one is for a
            # thread an episode, which computes the physics as it was traced. So is one that
            # simulates none, unless only the device code has this environment's physics.
            simulated = {*scalar.simulated_models(program)}
            if model is None or not simulated <= {model.digest}:
                return None, None
            if not simulated and c_mujoco.why_best(env) is None:
                return None, None
            physics = team.team_physics(model)
            source = f"{jaxprs.fingerprint(program)} {physics} {objects.source_digest(*_WRITERS)}"

            def write() -> Source:
                expansion = _write_out(program, shapes)
                return _titled(writers.team(expansion, physics), name, expansion)

            capability = gpu_seam.compute_capability()
            return cubin.load_kernel(f"{job} {source}", write, capability, objects.folder()), shapes
        except (scalar.UnsupportedPrimitive, scalar.TooLarge, NotImplementedError) as error:
            warnings.warn(f"a thread plays each episode, as lanes cannot: {error}", stacklevel=2)
            return None, None


def _by_one_lane(
    job: str,
    env: Any,
    function: Callable[..., Any],
    examples: Sequence[PyTree],
    writers: Writers,
    name: str,
) -> tuple[machine.Code, Any]:
    """Returns what ``load`` does, for the device code with one lane."""
    model = team.physics_model(env)
    assert model is not None
    with base.keeping_whole():
        traced, shapes = scalarized.trace(function, *examples)
        physics = team.team_physics(model)
        dependencies = (cxx.version(), physics, objects.source_digest(*_WRITERS))
        source = f"{job} {jaxprs.fingerprint(traced)} {dependencies}"

        def write() -> str:
            expansion = _write_out(traced, shapes)
            device_kernel = _titled(writers.team(expansion, physics), name, expansion)
            text = writers.lane(expansion, device_kernel)
            cxx.check(text)  # here, so that another engine plays what the compiler refuses
            return text

        target = machine.this_machine()
        code = machine.load_module(
            source, write, handler.SYMBOLS, target, objects.folder(), cxx.compiled
        )
        return code, shapes


def machine_map(
    function: Callable[..., Any],
    *examples: PyTree,
    env: Environment | None = None,
    name: str = "a function",
) -> Callable[..., Any]:
    """Returns a function of a batch, compiled unless memory or disk has it.

    What it returns is as ``jax.vmap(function)`` up to rounding. All threads that XLA has compute
    it, or those of the GPU. Call it inside of any transformation except differentiation; vmapped,
    it remains one call.

    Args:
      function: of one example; pytrees of numbers of 32 or 64 bits and bools, in and out.
      *examples: its arguments, or their shapes.
      env: the environment that it plays, if it plays one.
      name: of the function, for people.

    Raises:
      TooLarge: writing it out would take minutes.
      UnsupportedPrimitive: it has an operation that cannot be written.
      TypeError: numbers of another size.
    """
    leaves, tree = jax.tree.flatten(examples)
    arguments = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]

    def flat(*values: jax.Array) -> list[Any]:
        args = tree.unflatten(
            restored(x, leaf.dtype) for x, leaf in zip(values, arguments, strict=True)
        )
        return [stored(x) for x in jax.tree.leaves(function(*args))]

    result_leaves, out_tree = jax.tree.flatten(base.shapes(function, *examples))
    stored_arguments = [jax.eval_shape(stored, x) for x in arguments]
    stored_results = [jax.eval_shape(stored, x) for x in result_leaves]
    for leaf in stored_arguments + stored_results:
        if np.dtype(leaf.dtype).itemsize not in (4, 8):
            raise TypeError(f"it has numbers of {leaf.dtype}, not of 32 or 64 bits")
    writers = Writers(
        _write_cpu, thread_kernel.mapping_text, team_kernel.mapping_text, cxx.mapping_text
    )
    code, _ = load("map", env, flat, stored_arguments, writers, name)

    def map_rows(*args: PyTree) -> Any:
        """Returns the function's results of arguments whose first axis is N, in every leaf."""
        values = jax.tree.leaves(args)
        batch = values[0].shape[0]
        # A leaf without numbers has no buffer: it is left out here, and zeros stand for it below.
        rows = [stored(x).reshape(batch, -1) for x in values if x.size]
        shapes = [jax.ShapeDtypeStruct((batch, x.size), x.dtype) for x in stored_results if x.size]
        if isinstance(code, machine.Code):
            # 0 threads stand for all that XLA has.
            columns = iter(cpu_seam.call(code, shapes, jnp.int32(0), *rows))
        else:
            columns = iter(gpu_seam.launch_map(code, shapes, *rows))
        outputs = []
        for x in result_leaves:
            if x.size:
                outputs.append(next(columns).reshape(batch, *x.shape).astype(x.dtype))
            else:
                outputs.append(jnp.zeros((batch, *x.shape), x.dtype))
        return out_tree.unflatten(outputs)

    return map_rows


def _write_cpu(expansion: scalarized.Scalarized, target: machine.Machine) -> str:
    """Writes a function, and all around it, as LLVM IR."""
    num_args = 1 + sum(bool(np.prod(x.shape)) for x in expansion.in_avals)
    sizes = [np.dtype(x.dtype).itemsize for x in expansion.out_avals if np.prod(x.shape)]
    entry = handler.handler_text(num_args, sizes, target.lanes, kernel.MAPPING, is_zeroed=False)
    return entry + handler.flush(target.triple) + kernel.mapping_text(expansion, target.lanes)


def name_of(env: Any) -> str:
    """Returns the class of an environment, and of those in it if it wraps one."""
    name = type(env).__name__
    inner_env = getattr(env, "env", None)
    if inner_env is None:
        return name
    return f"{name} of {name_of(inner_env)}"


def refusal(error: Exception) -> str:
    """Returns in one line why machine code cannot be made, from what was raised."""
    message = " ".join(str(error).split())
    if isinstance(error, (TypeError, scalar.TooLarge, scalar.UnsupportedPrimitive)):
        return message
    # llvmlite raises RuntimeError itself, JAX subclasses of it.
    if type(error) is RuntimeError:
        return f"LLVM refuses its program: {message}"
    return f"it cannot be written out ({explain(error)})"


def while_running(function: Callable[..., StepResult]) -> Any:
    """Returns a step of episodes that are running."""
    return lambda *args: function(*args, jnp.int32(1))

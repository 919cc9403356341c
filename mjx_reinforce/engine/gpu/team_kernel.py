"""The kernels in which a team of lanes plays one episode after the other, or maps a function.

A team whose episode is over takes the next one, of whatever seed. What a team computes depends on
its episode alone: results are the same for any number of teams.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import ptx
from mjx_reinforce.engine.gpu.kernel import CONTROLS, RESULTS
from mjx_reinforce.engine.gpu.source import WARP, Launch, Source
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries
from mjx_reinforce.engine.team.operations import type_of
from mjx_reinforce.engine.team.text import CText

#: Warps of a block where there are few episodes, whose threads have 128 registers each.
FEW_WARPS = 16
#: Where there are many, whose threads have 80.
MANY_WARPS = 24
#: The arguments of a step behind the actor and the state: keys, t, deterministic.
_NUM_OTHERS = 3


class _Leaf(NamedTuple):
    """An argument or a result of a step: its C++ type, how many entries of how many bytes."""

    type: str
    size: int
    itemsize: int


class Physics(NamedTuple):
    """The physics of an environment for teams.

    text: the device code, with the tables of the model
    far: words of 4 bytes for the contacts that a team has no room for
    skip: physics steps of an env step
    lanes: of a team
    shared: bytes of shared memory that a block may have
    warps: of a block where items are many; see ``for_items``
    """

    text: str
    far: int
    skip: int
    lanes: int
    shared: int
    warps: int = FEW_WARPS


_PLAY_LOOP = """
extern "C" KERNEL play({parameters}) {{
  OWN_PLACE
  const int seeds = sizes[0], episodes = sizes[1], horizon = sizes[2], items = seeds * episodes;
  int item = 0, at = 0, limit = 0, mode = 0;
  bool running = false, asks = true;
  Word *own = scratch, *following = scratch + {own};
  scratch += 2 * {own};
  for (bool first = true; ; first = false) {{
    while (first || (!running && asks)) {{
      const int k = first ? 0 : t.next(next);
      if (k >= items) {{ asks = false; break; }}
      const int steps = limits[k];
      if (!first && steps == 0) continue;
      item = k; at = 0; mode = steps < 0; limit = steps < 0 ? -steps : steps;
      running = !first; first = false;
{begin}
      t.sync();
    }}
    if (!t.meet(running)) break;
    if (!t.some(running)) {{ t.attend({meets}); continue; }}
    const int seed = item / episodes;
    const int in_at[1] = {{at}}, in_mode[1] = {{mode}};
{step}
    if (running) {{
      const size_t row = size_t(seed) * horizon + at;
      const size_t column = item - seed * episodes;
{record}
      Word* const before = own;
      own = following; following = before;
      at++;
      if (at >= limit || !alive) {{
        running = false;
        if (t.lane == 0) {{
          length[item] = at; broken[item] = is_broken; t.add(simulated + seed, at);
        }}
      }}
    }}
    t.sync();
  }}
}}
"""
_MAP_LOOP = """
extern "C" KERNEL play({parameters}) {{
  OWN_PLACE
  for (int item = t.first(); t.meet(item < sizes[0]); item += t.stride()) {{
    if (!t.some(item < sizes[0])) {{ t.attend({meets}); continue; }}
    const int k = item < sizes[0] ? item : sizes[0] - 1;
{step}
    t.sync();
  }}
}}
"""


def player_text(program: scalarized.Scalarized, physics: Physics, num_actor: int) -> Source:
    """Returns the C++ of a kernel with the arguments of ``gpu.kernel.kernel_text``.

    Args:
      program: of ``program.step_function`` where an episode is running, the physics kept whole.
      physics: that of the environment.
      num_actor: how many leaves of its arguments are the actor's.
    """
    leaves = _leaves(program.in_avals)
    keys = len(leaves) - _NUM_OTHERS
    step_input = keys + 1
    mode = keys + 2
    carry_inputs = range(num_actor, step_input)  # the state, and the keys behind it
    words = [-(-leaves[k].size * leaves[k].itemsize // 4) for k in carry_inputs]
    offsets = dict(zip(carry_inputs, np.cumsum([0, *words]).tolist(), strict=False))

    input_names = {step_input: "in_at", mode: "in_mode"}
    text = CText(program, lambda number: input_names.get(number, f"in{number}"), physics.skip)
    observation, action, (reward,), (is_alive,), (is_broken,), *new_values = program.outputs
    text.line(f"const bool alive = {text.get(is_alive)} != 0;")
    text.line(f"const int is_broken = {text.get(is_broken)};")
    record = [f"if (t.lane == 0) reward[row * episodes + column] = {text.get(reward)};"]
    record += [
        f"EACH(i, {len(x)}) {field}[(row * {len(x)} + i) * episodes + column] = {text.array(x)}[i];"
        for field, x in (("observation", observation), ("action", action))
    ]
    # Only what the step reads is carried on. To compute a leaf may read others, which then are
    # carried on, too: until no unwritten leaf is read.
    next_carries = dict(zip(carry_inputs, new_values, strict=True))
    while ready_inputs := sorted(next_carries.keys() & text.read):
        for number in ready_inputs:
            text.fill(f"out{number}", next_carries.pop(number))
    pointers, initial = _carried_text(text, leaves, offsets, num_actor, keys)
    inputs = [*zip(("int", "int", "unsigned"), CONTROLS, strict=True)]
    inputs += [(leaves[k].type, f"actor{k}") for k in range(num_actor) if leaves[k].size]
    inputs += [
        (leaves[k].type, f"state{k - num_actor}") for k in range(num_actor, keys) if leaves[k].size
    ]
    record_types = [leaf.type for leaf in _leaves(program.out_avals[:3])]
    result_fields = [*zip([*record_types, *["int"] * 4], RESULTS, strict=True)]
    # XLA passes the zeros that the results are written over as arguments, too.
    inputs += [(type_name, f"zero_{name}") for type_name, name in result_fields]
    loop = _PLAY_LOOP.format(
        parameters=_parameters(inputs, result_fields),
        own=sum(words),
        begin="\n".join(initial),
        step="\n".join([*pointers, *text.lines]),
        record="\n".join(record),
        meets=text.meets,
    )
    return _kernel(physics, text, loop, 2 * sum(words) + text.words)


def _carried_text(
    text: CText, leaves: list[_Leaf], offsets: dict[int, int], num_actor: int, keys: int
) -> tuple[list[str], list[str]]:
    """Returns the pointers to the arguments that a step reads, and how an episode begins.

    A team has two copies of the state: a step reads ``own`` and writes ``following``, so that no
    lane reads what another one has written already.

    Args:
      text: of the step.
      leaves: the step's arguments.
      offsets: where each leaf of the state is in a copy, in words of 4 bytes.
      num_actor: how many leaves are the actor's.
      keys: the number of the keys.
    """
    pointers = []
    initial = []
    for number in sorted(text.read & {*range(keys + 1)}):
        leaf = leaves[number]
        if number < num_actor:
            row = f"actor{number} + size_t(seed) * {leaf.size}"
            pointers.append(f"const {leaf.type}* in{number} = {row};")
            continue
        place = f"reinterpret_cast<{leaf.type}*>({{}} + {offsets[number]})"
        pointers.append(f"const {leaf.type}* in{number} = {place.format('own')};")
        pointers.append(f"{leaf.type}* out{number} = {place.format('following')};")
        state_name = f"state{number - num_actor}"
        size = leaf.size
        if number == keys:
            # An episode begins with one key, of two words. The key of its noise, behind it in the
            # step's argument, is made by the first step.
            state_name = "keys"
            size = 2
        source = f"{state_name}[size_t(k) * {size} + i]"
        initial.append(f"EACH(i, {size}) {place.format('own')}[i] = {source};")
    return pointers, initial


def mapping_text(program: scalarized.Scalarized, physics: Physics) -> Source:
    """Returns the C++ of a kernel with the arguments of ``gpu.kernel.mapping_text``.

    Args:
      program: the function, the physics kept whole.
      physics: that of the environment.
    """
    text = CText(program, lambda number: f"in{number}", physics.skip)
    pointers = []
    inputs = [("int", "sizes")]
    outputs = []
    for number, leaf in enumerate(_leaves(program.in_avals)):
        if leaf.size:
            row = f"argument{number} + size_t(k) * {leaf.size}"
            pointers.append(f"const {leaf.type}* in{number} = {row};")
            inputs.append((leaf.type, f"argument{number}"))
    for number, leaf in enumerate(_leaves(program.out_avals)):
        if leaf.size:
            row = f"result{number} + size_t(k) * {leaf.size}"
            pointers.append(f"{leaf.type}* out{number} = {row};")
            outputs.append((leaf.type, f"result{number}"))
            text.fill(f"out{number}", program.outputs[number])
    loop = _MAP_LOOP.format(
        parameters=_parameters(inputs, outputs),
        step="\n".join(pointers + text.lines),
        meets=text.meets,
    )
    return _kernel(physics, text, loop, text.words)


def _leaves(avals: Iterable[jax.ShapeDtypeStruct]) -> list[_Leaf]:
    return [_Leaf(type_of(x.dtype), num_entries(x), np.dtype(x.dtype).itemsize) for x in avals]


def _parameters(inputs: Iterable[tuple[str, str]], outputs: Sequence[tuple[str, str]]) -> str:
    """Returns the parameters of a kernel by their types and names: what it reads and writes."""
    parameters = [f"const {type_name}* __restrict__ {name}" for type_name, name in inputs]
    parameters += [f"{type_name}* {name}" for type_name, name in outputs]
    return ", ".join([*parameters, "Word* scratch"])


def _kernel(physics: Physics, text: CText, loop: str, words: int) -> Source:
    """Returns a kernel whose teams have so many words of scratch each, besides far contacts."""
    # At least one, as a team's scratch is found by this number and XLA has no empty buffer.
    thread_words = max(1, -(-(physics.far + words) // physics.lanes))
    launch = Launch(
        threads=WARP * FEW_WARPS,
        blocks=1,
        scratch=thread_words,
        lanes=physics.lanes,
        shared=physics.shared,
        most_threads=WARP * physics.warps,
    )
    macros = f"#define REPORTS ({' | '.join(text.reports) or 0})\n#define FAR_WORDS {physics.far}\n"
    return Source("cuda", f"{macros}{physics.text}\n{loop}", launch)


def for_items(kernel: ptx.Kernel, num_items: int, processors: int, capability: str) -> ptx.Kernel:
    """Returns a kernel whose blocks are of the size that so many items are played fastest with.

    Args:
      kernel: with the blocks for few items.
      num_items: how many it plays.
      processors: the GPU's multiprocessors.
      capability: the GPU's compute capability.
    """
    # Where a team of the small blocks has one episode at most, more teams would have none.
    launch = kernel.launch
    is_small = num_items * launch.lanes <= launch.threads * processors
    if is_small or launch.most_threads in (0, launch.threads):
        return kernel
    source = kernel.source._replace(launch=launch._replace(threads=launch.most_threads))
    name = f"{kernel.key} {launch.most_threads} threads"
    return ptx.load_kernel(name, lambda: source, capability, objects.folder())

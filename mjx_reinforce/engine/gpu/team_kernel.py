"""The kernels in which a team of lanes plays one episode after the other, or maps a function."""

from typing import NamedTuple

import numpy as np

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import cubin, loops
from mjx_reinforce.engine.gpu.loops import StepArguments
from mjx_reinforce.engine.gpu.source import WARP, Launch, Source
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.team.text import CText

#: Warps of a block where there are few episodes, whose threads have 128 registers each.
FEW_WARPS = 16
#: Where there are many, whose threads have 80.
MANY_WARPS = 24
#: Of all kernels' parameters the last.
_SCRATCH = ("Word* scratch",)


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


def player_text(program: scalarized.Scalarized, physics: Physics, num_actor: int) -> Source:
    """Returns the C++ of a kernel that plays; its arguments are those of ``loops.play_loop``.

    Args:
      program: of ``program.step_function`` where an episode is running, the physics kept whole.
      physics: that of the environment.
      num_actor: how many leaves of its arguments are the actor's.
    """
    arguments = loops.step_arguments(program, num_actor)
    carried_leaves = [arguments.leaves[k] for k in arguments.carried]
    words = [-(-leaf.size * leaf.itemsize // 4) for leaf in carried_leaves]
    offsets = dict(zip(arguments.carried, np.cumsum([0, *words]).tolist(), strict=False))
    text = CText(program, arguments.name, physics.skip)
    observation, action, rewards, (is_alive,), (is_broken,), *new_values = program.outputs
    text.line(f"const bool alive = {text.get(is_alive)} != 0;")
    text.line(f"const int is_broken = {text.get(is_broken)};")
    record = []
    records = [("observation", observation), ("action", action)]
    if len(rewards) == 1:
        record = [f"if (t.lane == 0) reward[row * episodes + column] = {text.get(rewards[0])};"]
    else:  # the reward's terms are behind it
        records.append(("reward", rewards))
    record += [
        f"EACH(i, {len(x)}) {field}[(row * {len(x)} + i) * episodes + column] = {text.array(x)}[i];"
        for field, x in records
    ]
    # Only what the step reads is carried on. To compute a leaf may read others, which then are
    # carried on, too: until no unwritten leaf is read.
    next_carries = dict(zip(arguments.carried, new_values, strict=True))
    while ready_inputs := sorted(next_carries.keys() & text.read):
        for number in ready_inputs:
            text.fill(f"out{number}", next_carries.pop(number))
    pointers, initial = _carried_text(text, arguments, offsets)
    worker = loops.Worker(
        room=[
            f"  Word *own = scratch, *following = scratch + {sum(words)};",
            f"  scratch += 2 * {sum(words)};",
        ],
        begin=initial,
        met=_waiting(text, "running"),
        step=[*pointers, *text.lines],
        record=[
            *record,
            "      Word* const before = own;",
            "      own = following; following = before;",
        ],
        steps="at",
    )
    loop = loops.play_loop(program, num_actor, worker, _SCRATCH)
    return _source(physics, text, loop, 2 * sum(words) + text.words)


def _carried_text(
    text: CText, arguments: StepArguments, offsets: dict[int, int]
) -> tuple[list[str], list[str]]:
    """Returns the pointers to the arguments that a step reads, and how an episode begins.

    A team has two copies of the state: a step reads ``own`` and writes ``following``, so that no
    lane reads what another one has written already.

    Args:
      text: of the step.
      arguments: the step's.
      offsets: where each leaf of the state is in a copy, in words of 4 bytes.
    """
    pointers = []
    initial = []
    for number in sorted(text.read & {*range(arguments.keys + 1)}):
        leaf = arguments.leaves[number]
        if number < arguments.num_actor:
            row = f"actor{number} + size_t(seed) * {leaf.size}"
            pointers.append(f"const {leaf.type}* in{number} = {row};")
            continue
        place = f"reinterpret_cast<{leaf.type}*>({{}} + {offsets[number]})"
        pointers.append(f"const {leaf.type}* in{number} = {place.format('own')};")
        pointers.append(f"{leaf.type}* out{number} = {place.format('following')};")
        array, size = arguments.start(number)
        source = f"{array}[size_t(k) * {size} + i]"
        initial.append(f"EACH(i, {size}) {place.format('own')}[i] = {source};")
    return pointers, initial


def mapping_text(program: scalarized.Scalarized, physics: Physics) -> Source:
    """Returns the C++ of a kernel that maps; its arguments are those of ``loops.map_loop``.

    Args:
      program: the function, the physics kept whole.
      physics: that of the environment.
    """
    text = CText(program, lambda number: f"in{number}", physics.skip)
    for number, entries in enumerate(program.outputs):
        if entries:
            text.fill(f"out{number}", entries)
    loop = loops.map_loop(program, text.lines, _waiting(text, "item < sizes[0]"), _SCRATCH)
    return _source(physics, text, loop, text.words)


def _waiting(text: CText, has_item: str) -> str:
    """Returns what a warp does that has no item: it meets the others of its block."""
    return f"if (!t.some({has_item})) {{ t.attend({text.meets}); continue; }}"


def _source(physics: Physics, text: CText, loop: str, words: int) -> Source:
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
    return Source(f"{macros}{physics.text}\n{loop}", launch)


def for_items(
    kernel: cubin.Kernel, num_items: int, processors: int, capability: str
) -> cubin.Kernel:
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
    return cubin.load_kernel(name, lambda: source, capability, objects.folder())

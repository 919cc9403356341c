"""The kernels in which a team of lanes plays one episode after the other, or maps a function."""

from collections.abc import Collection
from typing import NamedTuple

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.gpu import cubin, loops
from mjx_reinforce.engine.gpu.loops import StepArguments
from mjx_reinforce.engine.gpu.source import WARP, Launch, Source
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.nodes import Node, Scalar
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
    observation, action, rewards, (is_alive,), (is_broken,), *new_values = program.outputs
    next_carries = dict(zip(arguments.carried, new_values, strict=True))
    constants = [number for number, x in next_carries.items() if _is_argument(number, x)]
    for number in constants:
        del next_carries[number]
    text = CText(program, arguments.name, physics.skip, constants)
    record = [_record(text, "observation", observation), _record(text, "action", action)]
    _carry_on(text, next_carries)
    # What looks at all numbers, as these do, finds them in memory by now.
    record.append(_record(text, "reward", rewards))  # the reward's terms are behind it
    text.line(f"const bool alive = {text.get(is_alive)} != 0;")
    text.line(f"const int is_broken = {text.get(is_broken)};")
    _carry_on(text, next_carries)
    carried = _Carried(text, arguments, constants)
    worker = loops.Worker(
        room=[
            f"  Word *own = scratch, *following = scratch + {carried.words};",
            f"  Word* const lasting = scratch + {2 * carried.words};",
            f"  scratch += {2 * carried.words + carried.lasting_words};",
        ],
        begin=carried.begin,
        met=_waiting(text, "running"),
        step=[*carried.pointers, *text.lines],
        record=[
            *record,
            "      Word* const before = own;",
            "      own = following; following = before;",
        ],
        steps="at",
    )
    loop = loops.play_loop(program, num_actor, worker, _SCRATCH)
    return _source(physics, text, loop, 2 * carried.words + carried.lasting_words + text.words)


def _is_argument(number: int, entries: list[Scalar]) -> bool:
    """Returns whether an array is an argument as it came."""
    places = [x.position for x in entries if isinstance(x, Node) and not x.op and not x.owner]
    return places == [(number, k) for k in range(len(entries))]


def _record(text: CText, field: str, entries: list[Scalar]) -> str:
    """Returns a line that records an array of a step."""
    size = len(entries)
    place = f"{field}[(row * {size} + i) * episodes + column]"
    return f"EACH(i, {size}) {place} = {text.array(entries)}[i];"


def _carry_on(text: CText, next_carries: dict[int, list[Scalar]]) -> None:
    """Writes what the next step reads: the arguments that were read so far.

    Args:
      text: of the step.
      next_carries: what the arguments are to be, by their numbers; those written are taken out.
    """
    # To compute one may read others, which then are carried on, too.
    while ready_inputs := sorted(next_carries.keys() & text.read):
        for number in ready_inputs:
            text.keep(f"out{number}", next_carries.pop(number))


class _Carried:
    """What a step reads besides the actor, and what it hands on to the next step.

    A team has two copies of it: a step reads ``own`` and writes ``following``, so that no lane
    reads what another one has written already. What never changes in an episode has one place.

    words: of 4 bytes of a copy
    lasting_words: of what never changes
    pointers: the lines that say where the arguments are
    begin: the lines with which an episode begins
    """

    def __init__(self, text: CText, arguments: StepArguments, constants: Collection[int]):
        """Gives each argument a place.

        Args:
          text: of the step.
          arguments: the step's.
          constants: the numbers of those that never change in an episode.
        """
        self.words = 0
        self.lasting_words = 0
        self.pointers: list[str] = []
        self.begin: list[str] = []
        for number in sorted(text.read & {*range(arguments.num_actor)}):
            leaf = arguments.leaves[number]
            row = f"actor{number} + size_t(seed) * {leaf.size}"
            self.pointers.append(f"const {leaf.type}* in{number} = {row};")
        for number in sorted(text.read & {*arguments.carried}):
            self._give_place(number, arguments, is_constant=number in constants)
        for number in sorted(text.first_read):
            leaf = arguments.leaves[number]
            array, size = arguments.start(number)
            self.begin.append(f"const {leaf.type}* in{number} = {array} + size_t(k) * {size};")
        self.begin += text.first_lines

    def _give_place(self, number: int, arguments: StepArguments, *, is_constant: bool) -> None:
        """Adds the lines of an argument that an episode has."""
        leaf = arguments.leaves[number]
        words = -(-leaf.size * leaf.itemsize // 4)
        if is_constant:
            first = f"reinterpret_cast<{leaf.type}*>(lasting + {self.lasting_words})"
            self.lasting_words += words
        else:
            place = f"reinterpret_cast<{leaf.type}*>({{}} + {self.words})"
            first = place.format("own")
            self.pointers.append(f"{leaf.type}* out{number} = {place.format('following')};")
            self.words += words
        self.pointers.append(f"const {leaf.type}* in{number} = {first};")
        array, size = arguments.start(number)
        self.begin.append(f"EACH(i, {size}) {first}[i] = {array}[size_t(k) * {size} + i];")


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
    """Returns the kernel, and the size of its blocks, that play so many items fastest.

    Args:
      kernel: of threads, or of teams with the blocks for few items.
      num_items: how many it plays.
      processors: the GPU's multiprocessors.
      capability: the GPU's compute capability.
    """
    if kernel.few is not None and _has_one_each(kernel.few.launch, num_items, processors):
        return kernel.few
    launch = kernel.launch
    # Where a team of the small blocks has one episode at most, more teams would have none.
    is_small = _has_one_each(launch, num_items, processors)
    if is_small or launch.most_threads in (0, launch.threads):
        return kernel
    source = kernel.source._replace(launch=launch._replace(threads=launch.most_threads))
    name = f"{kernel.key} {launch.most_threads} threads"
    return cubin.load_kernel(name, lambda: source, capability, objects.folder())


def _has_one_each(launch: Launch, num_items: int, processors: int) -> bool:
    """Returns whether a team has one item at most, with a block on each multiprocessor."""
    return num_items * launch.lanes <= launch.threads * processors

"""What all kernels have in common: their arguments, and the loops that play episodes and map.

What plays, a thread or a team of lanes, is a *worker*. A worker whose episode is over takes the
next one, of whatever seed, so few wait for longer episodes beside theirs. What a worker computes
depends on its episode alone: results are the same for any number of workers.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries
from mjx_reinforce.engine.team.operations import type_of

#: The kernel's name.
ENTRY = "play"
#: What a kernel reads before the actor and the state, by name; see ``play_loop``.
CONTROLS = ("sizes", "limits", "keys")
#: What it writes.
RESULTS = ("observation", "action", "reward", "length", "broken", "simulated", "next")
#: The arguments of a step behind the actor and the state: keys, t, deterministic.
_NUM_OTHERS = 3
#: An episode begins with one key, of two words. The key of its noise, behind it in the step's
#: argument, is made by the first step.
_KEY_WORDS = 2
#: A worker without an episode has the values of the first one, so that it computes sound numbers,
#: which nothing keeps, beside others that have one.
_PLAY_LOOP = """
extern "C" KERNEL play({parameters}) {{
  OWN_PLACE
  const int seeds = sizes[0], episodes = sizes[1], horizon = sizes[2], items = seeds * episodes;
  int item = 0, at = 0, limit = 0, mode = 0;
  bool running = false, asks = true;
{room}
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
    {met}
    const int seed = item / episodes;
    const int in_at[1] = {{at}}, in_mode[1] = {{mode}};
{step}
    if (running) {{
      const size_t row = size_t(seed) * horizon + at;
      const size_t column = item - seed * episodes;
{record}
      at++;
      if (at >= limit || !alive) {{
        running = false;
        if (t.lane == 0) {{
          length[item] = at; broken[item] = is_broken; t.add(simulated + seed, {steps});
        }}
      }}
    }}
    t.sync();
  }}
{end}}}
"""
_MAP_LOOP = """
extern "C" KERNEL play({parameters}) {{
  OWN_PLACE
  for (int item = t.first(); t.meet(item < sizes[0]); item += t.stride()) {{
    {met}
    const int k = item < sizes[0] ? item : sizes[0] - 1;
{step}
    t.sync();
  }}
}}
"""


class Leaf(NamedTuple):
    """An argument or a result of a step: its C++ type, how many entries of how many bytes."""

    type: str
    size: int
    itemsize: int


class StepArguments(NamedTuple):
    """The arguments of a step by their numbers.

    leaves: the actor's, the state's, and behind them keys, t and deterministic
    num_actor: how many are the actor's
    """

    leaves: list[Leaf]
    num_actor: int

    @property
    def keys(self) -> int:
        """The number of the keys."""
        return len(self.leaves) - _NUM_OTHERS

    @property
    def carried(self) -> range:
        """The numbers of what a step hands on to the next: the state, and the keys behind it."""
        return range(self.num_actor, self.keys + 1)

    def name(self, number: int) -> str:
        """Returns what the text calls an argument."""
        return {self.keys + 1: "in_at", self.keys + 2: "in_mode"}.get(number, f"in{number}")

    def start(self, number: int) -> tuple[str, int]:
        """Returns the array that a carried leaf begins from, and the entries of an episode."""
        if number == self.keys:
            return "keys", _KEY_WORDS
        return f"state{number - self.num_actor}", self.leaves[number].size


class Worker(NamedTuple):
    """What one kind of worker does its own way in ``_PLAY_LOOP``, as C++.

    room: what it keeps an episode in
    begin: fills that from the start of episode k
    met: what it does once the workers of its block have met
    step: computes a step; it leaves ``alive`` and ``is_broken``
    record: writes the step's records, and carries on what the next step reads
    steps: how many steps it has simulated where an episode ends
    end: what it does in the end
    """

    room: Iterable[str]
    begin: Iterable[str]
    met: str
    step: Iterable[str]
    record: Iterable[str]
    steps: str
    end: str = ""


def step_arguments(program: scalarized.Scalarized, num_actor: int) -> StepArguments:
    """Returns the arguments of a step, the first of which are the actor's."""
    return StepArguments(leaves(program.in_avals), num_actor)


def leaves(avals: Iterable[jax.ShapeDtypeStruct]) -> list[Leaf]:
    """Returns arguments or results of a function."""
    return [Leaf(type_of(x.dtype), num_entries(x), np.dtype(x.dtype).itemsize) for x in avals]


def play_loop(
    program: scalarized.Scalarized, num_actor: int, worker: Worker, scratch: Sequence[str] = ()
) -> str:
    """Returns the C++ of ``play``.

    Its arguments are pointers to: sizes [3] int32 (seeds S, episodes N, steps T), limits [S, N]
    int32 (of ``episode.signed_limits``), keys [S, N, 2] uint32, the leaves of the actor [S, ...]
    and of the state [S, N, ...] that are not empty; as many again as there are results, which it
    does not read; and the results, which are zero when it starts: observation [S, T, O, N], action
    [S, T, A, N], reward [S, T, 1 + K, N] with its K terms behind it, length [S, N] int32, broken
    [S, N] int32, simulated [S] int32 and next [1] int32, the item to be fetched next. Item k is
    episode k % N of seed k / N.
    Episodes are the last axis of the records: workers side by side write to places side by side.

    Args:
      program: a step.
      num_actor: how many leaves of its arguments are the actor's.
      worker: what plays.
      scratch: a parameter behind the results, if the worker needs it.
    """
    arguments = step_arguments(program, num_actor)
    inputs: list[tuple[str, str]] = [*zip(("int", "int", "unsigned"), CONTROLS, strict=True)]
    for number, leaf in enumerate(arguments.leaves[: arguments.keys]):
        # XLA passes no empty array: such a leaf has no parameter, and nothing reads it.
        if leaf.size:
            is_actors = number < num_actor
            name = f"actor{number}" if is_actors else arguments.start(number)[0]
            inputs.append((leaf.type, name))
    record_types = [leaf.type for leaf in leaves(program.out_avals[:3])]
    result_fields = [*zip([*record_types, *["int"] * 4], RESULTS, strict=True)]
    # XLA passes the zeros that the results are written over as arguments, too.
    inputs += [(type_name, f"zero_{name}") for type_name, name in result_fields]
    return _PLAY_LOOP.format(
        parameters=_parameters(inputs, result_fields, scratch),
        room="\n".join(worker.room),
        begin="\n".join(worker.begin),
        met=worker.met,
        step="\n".join(worker.step),
        record="\n".join(worker.record),
        steps=worker.steps,
        end=worker.end,
    )


def is_written_over(arguments: Sequence[Any], results: Sequence[Any]) -> bool:
    """Returns whether a thread may write the results of a mapped function over its arguments.

    It may if the first arguments are like the several results, one by one, as the state is that a
    step returns. XLA then copies no state in a loop of steps.

    Args:
      arguments: shapes and dtypes; those without numbers are ignored.
      results: the same.
    """
    sizes = [
        [(np.prod(x.shape, dtype=int), x.dtype) for x in avals if np.prod(x.shape, dtype=int)]
        for avals in (arguments, results)
    ]
    return len(sizes[1]) > 1 and sizes[0][: len(sizes[1])] == sizes[1]


def map_loop(
    program: scalarized.Scalarized, lines: Iterable[str], met: str = "", scratch: Sequence[str] = ()
) -> str:
    """Returns the C++ of ``play`` that maps a function.

    Its arguments are pointers to: sizes [1] int32 (examples N), the leaves [N, ...] of the
    function's arguments that are not empty, and those of its result, likewise; see
    ``is_written_over``. A worker without an example computes the last one again beside the others.

    Args:
      program: the function.
      lines: compute its results, out0 and so on, of its arguments, in0 and so on.
      met: what a worker does once those of its block have met.
      scratch: a parameter behind the results, if the worker needs it.
    """
    pointers = []
    inputs = [("int", "sizes")]
    outputs = []
    for number, leaf in enumerate(leaves(program.in_avals)):
        if leaf.size:
            row = f"argument{number} + size_t(k) * {leaf.size}"
            pointers.append(f"const {leaf.type}* in{number} = {row};")
            inputs.append((leaf.type, f"argument{number}"))
    for number, leaf in enumerate(leaves(program.out_avals)):
        if leaf.size:
            row = f"result{number} + size_t(k) * {leaf.size}"
            pointers.append(f"{leaf.type}* out{number} = {row};")
            outputs.append((leaf.type, f"result{number}"))
    parameters = _parameters(inputs, outputs, scratch)
    if is_written_over(program.in_avals, program.out_avals):
        parameters = parameters.replace(" __restrict__", "")
    return _MAP_LOOP.format(parameters=parameters, met=met, step="\n".join([*pointers, *lines]))


def _parameters(
    inputs: Iterable[tuple[str, str]],
    outputs: Iterable[tuple[str, str]],
    scratch: Sequence[str],
) -> str:
    """Returns the parameters of a kernel by their types and names: what it reads and writes."""
    parameters = [f"const {type_name}* __restrict__ {name}" for type_name, name in inputs]
    parameters += [f"{type_name}* {name}" for type_name, name in outputs]
    return ", ".join([*parameters, *scratch])

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
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries
from mjx_reinforce.engine.team.operations import type_of
from mjx_reinforce.engine.team.text import CText

#: Warps of a block where there are few episodes, whose threads have 128 registers each, and where
#: there are many, which have 80.
FEW_WARPS, _MANY_WARPS = 16, 24


class Physics(NamedTuple):
    """The physics of an environment for teams.

    text: the device code, with the tables of the model
    far: words of 4 bytes for the contacts that a team has no room for
    skip: physics steps of an env step
    lanes: of a team
    shared: bytes of shared memory that a block may have
    """

    text: str
    far: int
    skip: int
    lanes: int
    shared: int


_PLAY = """
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
_MAP = """
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


def player_text(written: scalarized.Scalarized, physics: Physics, num_actor: int) -> str:
    """Returns the C++ of a kernel with the arguments of ``gpu.kernel.kernel_text``.

    Args:
      written: of ``program.step_function`` where an episode is running, the physics kept whole.
      physics: that of the environment.
      num_actor: how many leaves of its arguments are the actor's.
    """
    kinds, counts = _kinds(written.in_avals), [*map(num_entries, written.in_avals)]
    keys, at = len(kinds) - 3, len(kinds) - 2
    own = range(num_actor, at)  # the state, and the keys behind it
    words = [-(-counts[k] * np.dtype(written.in_avals[k].dtype).itemsize // 4) for k in own]
    offsets = dict(zip(own, np.cumsum([0, *words]).tolist(), strict=False))

    names = {at: "in_at", at + 1: "in_mode"}
    text = CText(written, lambda number: names.get(number, f"in{number}"), physics.skip)
    observation, action, (reward,), (goes_on,), (broken,), *carried = written.outputs
    text.line(f"const bool alive = {text.get(goes_on)} != 0;")
    text.line(f"const int is_broken = {text.get(broken)};")
    record = [f"if (t.lane == 0) reward[row * episodes + column] = {text.get(reward)};"]
    record += [
        f"EACH(i, {len(x)}) {field}[(row * {len(x)} + i) * episodes + column] = {text.array(x)}[i];"
        for field, x in (("observation", observation), ("action", action))
    ]
    waiting = dict(zip(own, carried, strict=True))
    while ready := sorted(waiting.keys() & text.read):  # what nothing reads is not carried on
        for number in ready:
            text.fill(f"out{number}", waiting.pop(number))
    before, begin = [], []
    for number in sorted(text.read - {at, at + 1}):
        kind, size = kinds[number], counts[number]
        if number < num_actor:
            before.append(f"const {kind}* in{number} = actor{number} + size_t(seed) * {size};")
            continue
        place = f"reinterpret_cast<{kind}*>({{}} + {offsets[number]})"
        before.append(f"const {kind}* in{number} = {place.format('own')};")
        before.append(f"{kind}* out{number} = {place.format('following')};")
        given, size = ("keys", 2) if number == keys else (f"state{number - num_actor}", size)
        source = f"{given}[size_t(k) * {size} + i]"
        begin.append(f"EACH(i, {size}) {place.format('own')}[i] = {source};")
    given = [*zip(("int", "int", "unsigned"), CONTROLS, strict=True)]
    given += [(kinds[k], f"actor{k}") for k in range(num_actor) if counts[k]]
    given += [(kinds[k], f"state{k - num_actor}") for k in range(num_actor, keys) if counts[k]]
    made = [*zip([*_kinds(written.out_avals[:3]), *["int"] * 4], RESULTS, strict=True)]
    loop = _PLAY.format(
        parameters=_parameters([*given, *((kind, f"zero_{name}") for kind, name in made)], made),
        own=sum(words),
        begin="\n".join(begin),
        step="\n".join([*before, *text.lines]),
        record="\n".join(record),
        meets=text.meets,
    )
    return _kernel(physics, text, loop, 2 * sum(words) + text.words)


def mapping_text(written: scalarized.Scalarized, physics: Physics) -> str:
    """Returns the C++ of a kernel with the arguments of ``gpu.kernel.mapping_text``.

    Args:
      written: the function, the physics kept whole.
      physics: that of the environment.
    """
    text = CText(written, lambda number: f"in{number}", physics.skip)
    given, made = (
        [(k, type_of(x.dtype), num_entries(x)) for k, x in enumerate(avals) if num_entries(x)]
        for avals in (written.in_avals, written.out_avals)
    )
    before = [f"const {kind}* in{k} = given{k} + size_t(k) * {n};" for k, kind, n in given]
    for k, kind, size in made:
        before.append(f"{kind}* out{k} = made{k} + size_t(k) * {size};")
        text.fill(f"out{k}", written.outputs[k])
    parameters = _parameters(
        [("int", "sizes"), *((kind, f"given{k}") for k, kind, _ in given)],
        [(kind, f"made{k}") for k, kind, _ in made],
    )
    loop = _MAP.format(parameters=parameters, step="\n".join(before + text.lines), meets=text.meets)
    return _kernel(physics, text, loop, text.words)


def _kinds(avals: Iterable[jax.ShapeDtypeStruct]) -> list[str]:
    return [type_of(x.dtype) for x in avals]


def _parameters(given: Iterable[tuple[str, str]], made: Sequence[tuple[str, str]]) -> str:
    """Returns the parameters of a kernel by their types and names: what it reads and writes."""
    read = (f"const {kind}* __restrict__ {name}" for kind, name in given)
    return ", ".join([*read, *(f"{kind}* {name}" for kind, name in made), "Word* scratch"])


def _kernel(physics: Physics, text: CText, loop: str, words: int) -> str:
    """Returns a kernel whose teams have so many words of scratch each, besides far contacts."""
    a_thread = max(1, -(-(physics.far + words) // physics.lanes))
    head = f"#define W {physics.lanes}\n#define SHARED {physics.shared}\n"
    head += f"#define REPORTS ({' | '.join(text.reports) or 0})\n"
    head += f"#define FAR_WORDS {physics.far}\n#define THREAD_WORDS {a_thread}\n"
    whole = f"{_warps(FEW_WARPS)}{head}{physics.text}\n{loop}"
    return ptx.team_text(whole, physics.lanes, 32 * FEW_WARPS, physics.shared, a_thread)


def _warps(number: int) -> str:
    return f"#define WARPS {number}\n"


def for_items(kernel: ptx.Kernel, items: int, processors: int, capability: str) -> ptx.Kernel:
    """Returns a kernel whose blocks are of the size that so many items are played fastest with.

    Args:
      kernel: with the blocks for few items.
      items: how many it plays.
      processors: the GPU's multiprocessors.
      capability: the GPU's compute capability.
    """
    if items * kernel.lanes <= kernel.threads * processors:
        return kernel

    def write() -> str:
        text = kernel.text.partition("\n")[2].replace(_warps(FEW_WARPS), _warps(_MANY_WARPS), 1)
        return ptx.team_text(text, kernel.lanes, 32 * _MANY_WARPS, kernel.shared, kernel.scratch)

    return ptx.load_kernel(f"{kernel.key} {_MANY_WARPS} warps", write, capability, objects.folder())

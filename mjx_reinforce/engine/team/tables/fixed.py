"""The tables as C++: what the compiler knows, and the struct Fixed, which the lanes share."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from mjx_reinforce.engine.team import hulls, records
from mjx_reinforce.engine.team.tables import draws, solver
from mjx_reinforce.engine.team.tables.store import Tables


def text(tables: Tables) -> str:
    """Returns the tables as C++."""
    return "\n".join([*_known(tables), *hulls.text(tables.hulls), *_shared(tables)])


def _known(tables: Tables) -> Iterator[str]:
    """Yields the lines of what the compiler knows."""
    for name, number in tables.constants.items():
        yield f"constexpr int {name} = {int(number)};"
    # Not constexpr: a constant of floats would be a symbol of the machine code.
    for name, number in tables.real_constants.items():
        yield f"#define {name} real({number!r})"
    mask = "unsigned long long" if tables.model.nv > 32 else "unsigned"
    yield f"typedef {mask} Mask;"
    for name, values in tables.functions.items():
        table = ", ".join(str(int(x)) for x in values) or "0"
        yield f"DEV constexpr int {name}(int i) {{"
        yield f"  constexpr int table[] = {{{table}}};\n  return table[i];\n}}"


def _shared(tables: Tables) -> Iterator[str]:
    """Yields the lines of the struct Fixed, of its initial values, and of a team's view of it."""
    layout = draws.Layout(tables)
    ints = tables.ints
    reals: dict[str, Any] = {x: y for x, y in tables.reals.items() if x not in layout.starts}
    if layout.places:
        ints = ints | {"drawn_place": layout.places}
        reals["drawn_base"] = layout.base
    yield "struct Fixed {"
    yield "  real timestep, smallest_gain;"
    timestep = f"real({float(tables.model.opt.timestep)!r})"
    initial_values = [timestep, solver.smallest_gain(tables.model)]
    empty = []
    for type_name, literal, arrays in (
        ("int", lambda x: f"{int(x):d}", ints),
        ("Mask", lambda x: f"{int(x):d}ull", tables.masks),
        ("real", lambda x: f"real({float(x)!r})", reals),
    ):
        for name, values in arrays.items():
            entries = np.asarray(values).ravel().tolist()
            struct = records.STRUCTS.get(name, type_name)
            if not entries:
                is_row = struct in records.FIELDS
                empty.append(f"Some<{struct}, 0> {name};" if is_row else f"{struct} {name}[1];")
                continue
            row_size = records.size(struct)
            yield f"  {struct} {name}[{-(-len(entries) // row_size)}];"
            initial_values.append("{" + ",".join(map(literal, entries)) + "}")
    # C++ has no empty array: those that are share a place.
    yield f"  union {{ int none; {' '.join(empty)} }};"
    yield "};"
    names = ["timestep", "smallest_gain", *ints, *tables.masks, *reals]
    yield from draws.view(names, layout) if layout.places else draws.NO_VIEW
    yield from records.checks()
    yield "#define MODEL_INIT {" + ",\\\n".join([*initial_values, "{0}"]) + "}"

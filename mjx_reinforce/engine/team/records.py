"""The rows of a model's tables that have several numbers: the structs of ``device/records.h``.

Both have the same fields in the same order, which ``checks`` lets the compiler of C++ see.
"""

from typing import NamedTuple

from mjx_reinforce.engine.team.supported import GEOM_BITS


class Softness(NamedTuple):
    """The Softness of ``device/records.h``."""

    stiffness: float
    damping: float
    least: float
    rise: float
    width: float
    middle: float
    power: float


_ACTUATOR = """
    gear control_low control_high gain bias bias_by_length bias_by_speed force_low force_high
    gain_by_length gain_by_speed
    """
#: How many reals each field of a struct has.
FIELDS = {
    "Softness": dict.fromkeys(Softness._fields, 1),
    "Actuator": dict.fromkeys(_ACTUATOR.split(), 1),
    "Limit": {"range": 2, "margin": 1, "weight": 1},
    "Loss": {"most": 1, "weight": 1},
    "Range": {"low": 1, "high": 1},
    "Friction": {"along": 5},
    "GeomBox": {"center": 3, "half": 3},
    "Part": {"at": 3, "gear": 6},
    "Tendon": {"stiffness": 3, "damping": 3, "rest": 2},
    "Law": {"stiffness": 3, "damping": 3},
    "FluidBody": {
        "at": 3,
        "axes": 9,
        "viscous_torque": 1,
        "viscous_force": 1,
        "drag_torque": 3,
        "drag_force": 3,
    },
    "Compensation": {"moment": 3, "mass": 1},
}
#: The structs of the tables whose rows are some.
STRUCTS = {
    "item": "Item",
    "paired": "Pair",
    "jump": "Pair",
    "soft": "Softness",
    "actuator": "Actuator",
    "dof_limit": "Limit",
    "dof_loss": "Loss",
    "dof_force": "Range",
    "kind_friction": "Friction",
    "geom_box": "GeomBox",
    "part": "Part",
    "tendon": "Tendon",
    "bound": "Limit",
    "dof_law": "Law",
    "fluid_body": "FluidBody",
    "compensated": "Compensation",
}


def size(type_name: str) -> int:
    """Returns how many numbers a value of a type has."""
    return sum(FIELDS.get(type_name, {"": 1}).values())


def column(table: str, field: str) -> int:
    """Returns the first column of a field of a table's rows; 0 of a table without fields, ""."""
    if not field:
        return 0
    field_sizes = FIELDS[STRUCTS[table]]
    names = list(field_sizes)
    return sum(field_sizes[name] for name in names[: names.index(field)])


def packed(low: int, high: int) -> int:
    """Returns the Pair of ``device/records.h``."""
    return low | high << 16


def packed_item(geom1: int, geom2: int, part: int) -> int:
    """Returns the Item of ``device/records.h``."""
    return geom1 | geom2 << GEOM_BITS | part << 2 * GEOM_BITS


def checks() -> list[str]:
    """Returns C++ that does not compile unless ``device/records.h`` has the rows written here."""
    item = f"Item{{{packed_item(0xABC, 0xDEF, 5)}}}"
    pair = f"Pair{{{packed(0xABCD, 0x7654)}}}"
    conditions = [
        f"{item}.first() == 0xabc && {item}.second() == 0xdef && {item}.part() == 5",
        f"{pair}.low() == 0xabcd && {pair}.high() == 0x7654",
    ]
    for struct, field_sizes in FIELDS.items():
        num_reals = sum(field_sizes.values())
        conditions.append(f"sizeof({struct}) == {num_reals} * sizeof(real)")
        # A struct of 0, 1, 2, ...: a field shows where it begins. NVRTC 13.0 has no offsetof.
        numbered = f"{struct}{{{', '.join(map(str, range(num_reals)))}}}"
        offset = 0
        for field, count in field_sizes.items():
            entry = "[0]" if count > 1 else ""
            conditions.append(f"{numbered}.{field}{entry} == {offset}")
            offset += count
    return [f'static_assert({x}, "a row of tables");' for x in conditions]

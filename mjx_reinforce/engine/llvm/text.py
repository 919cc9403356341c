"""LLVM IR as text: what every part of the LLVM backend writes into."""

import functools
import math
import struct
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike

#: The LLVM type of one value of each dtype. A bool in memory is a byte.
_SCALARS = {
    "bool": "i1",
    "int8": "i8",
    "int32": "i32",
    "int64": "i64",
    "uint8": "i8",
    "uint32": "i32",
    "uint64": "i64",
    "float32": "float",
    "float64": "double",
}
#: Room for an array begins at a multiple of so many bytes at least: a line of the cache.
_LEAST_ALIGN = 64


Written = TypeVar("Written")


def scalar_type(dtype: DTypeLike) -> str:
    """Returns the LLVM type of one value.

    Raises:
      TypeError: the dtype has none here.
    """
    return _scalar_type(np.dtype(dtype))


@functools.cache
def _scalar_type(dtype: np.dtype) -> str:
    if dtype.name not in _SCALARS:
        raise TypeError(f"machine code is not written for values of {dtype.name}")
    return _SCALARS[dtype.name]


def sign_letter(dtype: np.dtype) -> str:
    """Returns how LLVM marks what it does with integers of a dtype: signed or unsigned."""
    return "s" if dtype.kind == "i" else "u"


def literal(number: Any) -> str:
    """Returns a NumPy scalar as LLVM writes it."""
    number = np.asarray(number)
    if number.dtype == np.bool_:
        return "true" if number else "false"
    if number.dtype.kind == "f":
        # The bits of the double of the same value, for float32 too. LLVM refuses a decimal that the
        # type does not hold exactly.
        (bits,) = struct.unpack("<Q", struct.pack("<d", float(number)))
        return f"0x{bits:016X}"
    return str(int(number))


class Hole(NamedTuple):
    """An instruction that is written later.

    name: its result.
    place: the number of its line.
    """

    name: str
    place: int


class Text:
    """The body of a function as it is written; a value is the text of an operand.

    lanes: how many values a lane vector holds.
    declared: the intrinsics and library functions that were called, as declarations.
    block: the basic block that is being written.
    """

    def __init__(self, lanes: int, most_on_stack: float = math.inf):
        """Starts an empty body.

        Args:
          lanes: how many values a lane vector holds.
          most_on_stack: so many bytes the function takes of the stack at most. The rest of what it
            reserves is allocated, until ``leave``.
        """
        self.lanes = lanes
        self._stack_left = most_on_stack
        self._allocated: list[str] = []
        self.declared: set[str] = set()
        self.block = "start"
        self._reserved: list[str] = []
        self._tables: dict[str, str] = {}
        self._lines: list[str] = []
        self._count = 0
        self._known: dict[Hashable, Any] = {}

    def function(self, signature: str) -> str:
        """Returns a module with a function of this signature, such as "void @f(ptr %x)"."""
        tables = [f"{name} = internal constant {value}" for value, name in self._tables.items()]
        # What is reserved stands in a block of its own in front: there LLVM turns what is small
        # into registers, and a loop does not reserve it again and again.
        body = ["entry:", *self._reserved, "  br label %start", "start:", *self._lines]
        lines = [*tables, f"define {signature} {{", *body, "}", *sorted(self.declared)]
        return "\n".join(lines) + "\n"

    def type(self, dtype: DTypeLike) -> str:
        """Returns the type of a lane vector."""
        return f"<{self.lanes} x {scalar_type(dtype)}>"

    def constant(self, number: Any) -> str:
        """Returns a NumPy scalar as a lane vector that has it in every lane."""
        return f"splat ({scalar_type(np.asarray(number).dtype)} {literal(number)})"

    def line(self, text: str) -> None:
        """Writes an instruction that has no result."""
        self._lines.append(f"  {text}")

    def let(self, expression: str) -> str:
        """Writes an instruction; returns its result."""
        name = self.name()
        self._lines.append(f"  {name} = {expression}")
        return name

    def name(self) -> str:
        """Returns a name that is used nowhere else."""
        self._count += 1
        return f"%v{self._count}"

    def call(self, function: str, dtype: DTypeLike, *operands: str) -> str:
        """Calls an intrinsic such as "llvm.sqrt" on lane vectors of one dtype."""
        kind = self.type(dtype)
        name = f"@{function}.{self._suffix(dtype)}"
        self.declared.add(f"declare {kind} {name}({', '.join([kind] * len(operands))})")
        return self.let(f"call {kind} {name}({', '.join(f'{kind} {x}' for x in operands)})")

    def _suffix(self, dtype: DTypeLike) -> str:
        """Returns how intrinsics' names end for lane vectors, such as "v8f32"."""
        scalar = {"float": "f32", "double": "f64"}.get(scalar_type(dtype), scalar_type(dtype))
        return f"v{self.lanes}{scalar}"

    def label(self) -> str:
        """Returns the name of a basic block to come."""
        self._count += 1
        return f"b{self._count}"

    def start(self, block: str) -> None:
        """Begins a basic block."""
        self._lines.append(f"{block}:")
        self.block = block
        # The next block may be entered from elsewhere, where nothing of this one was computed.
        self._known = {}

    def once(self, key: Hashable, write: Callable[[], Written]) -> Written:
        """Returns what was written under a key where it is known to have been, or writes it.

        It is known until the next ``start``, but that what is done ``when`` ends no knowledge.
        """
        if key not in self._known:
            self._known[key] = write()
        return self._known[key]

    def phi(self, dtype: DTypeLike, values: dict[str, str]) -> str:
        """Returns at the start of a basic block the value of the block from which it is entered."""
        pairs = ", ".join(f"[{value}, %{block}]" for block, value in values.items())
        return self.let(f"phi {self.type(dtype)} {pairs}")

    def any(self, mask: str) -> str:
        """Returns an i1: whether some lane of a mask is set."""
        kind = f"<{self.lanes} x i1>"
        name = f"@llvm.vector.reduce.or.v{self.lanes}i1"
        self.declared.add(f"declare i1 {name}({kind})")
        return self.let(f"call i1 {name}({kind} {mask})")

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """Writes what is done only if an i1 is set; what is known before stays known."""
        body_label = self.label()
        end_label = self.label()
        outer_known = self._known
        self.line(f"br i1 {condition}, label %{body_label}, label %{end_label}")
        self.start(body_label)
        yield
        self.line(f"br label %{end_label}")
        self.start(end_label)
        # The block after is entered from the one before alone, or through the one inside.
        self._known = outer_known

    def hole(self) -> Hole:
        """Leaves a line for an instruction that reads what comes later."""
        self._lines.append("")
        return Hole(self.name(), len(self._lines) - 1)

    def fill(self, hole: Hole, expression: str) -> None:
        """Writes the instruction of a hole."""
        self._lines[hole.place] = f"  {hole.name} = {expression}"

    def reserve(self, dtype: DTypeLike, count: int) -> str:
        """Returns a pointer to room for lane vectors, which lasts until the function returns."""
        name = self.name()
        align = max(_LEAST_ALIGN, np.dtype(dtype).itemsize * self.lanes)
        size = count * np.dtype(dtype).itemsize * self.lanes
        if size > self._stack_left:
            self._allocate(name, size, align)
            return name
        self._stack_left -= size
        self._reserved.append(f"  {name} = alloca [{count} x {self.type(dtype)}], align {align}")
        return name

    def _allocate(self, name: str, size: int, align: int) -> None:
        """Writes at the function's start what gives a name to so many bytes of the heap."""
        # malloc aligns for the largest scalar alone: room for one more alignment is taken, and the
        # place in it is rounded up.
        room, address, end_address, aligned_address = (self.name() for _ in range(4))
        self._reserved += [
            f"  {room} = call ptr @malloc(i64 {size + align})",
            f"  {address} = ptrtoint ptr {room} to i64",
            f"  {end_address} = add i64 {address}, {align - 1}",
            f"  {aligned_address} = and i64 {end_address}, {-align}",
            f"  {name} = inttoptr i64 {aligned_address} to ptr",
        ]
        self._allocated.append(room)

    def leave(self) -> None:
        """Ends the function, and frees what it allocated."""
        for room in self._allocated:
            self.line(f"call void @free(ptr {room})")
        self.line("ret void")

    def table(self, dtype: DTypeLike, literals: list[str]) -> str:
        """Returns a pointer to constant scalars."""
        scalar = scalar_type(dtype)
        entries = ", ".join(f"{scalar} {x}" for x in literals)
        value = f"[{len(literals)} x {scalar}] [{entries}]"
        return self._tables.setdefault(value, f"@t{len(self._tables)}")

    def spread(self, dtype: DTypeLike, table_name: str, index: str) -> str:
        """Returns an entry of a table in every lane."""
        scalar = scalar_type(dtype)
        place = self.let(f"getelementptr inbounds {scalar}, ptr {table_name}, i64 {index}")
        element = self.let(f"load {scalar}, ptr {place}")
        return self.broadcast(scalar, element)

    def broadcast(self, scalar: str, value: str) -> str:
        """Returns a scalar in every lane."""
        kind = f"<{self.lanes} x {scalar}>"
        first_lane = self.let(f"insertelement {kind} poison, {scalar} {value}, i64 0")
        zero_mask = f"<{self.lanes} x i32> zeroinitializer"
        return self.let(f"shufflevector {kind} {first_lane}, {kind} poison, {zero_mask}")

    def at(self, pointer: str, dtype: DTypeLike, index: int | str) -> str:
        """Returns the pointer to a lane vector of an array of them."""
        return self.let(f"getelementptr inbounds {self.type(dtype)}, ptr {pointer}, i64 {index}")

    def load(self, pointer: str, dtype: DTypeLike) -> str:
        """Loads a lane vector."""
        return self.let(f"load {self.type(dtype)}, ptr {pointer}")

    def store(self, value: str, pointer: str, dtype: DTypeLike) -> None:
        """Stores a lane vector."""
        self.line(f"store {self.type(dtype)} {value}, ptr {pointer}")

    def gather(self, base: str, index: str, dtype: DTypeLike) -> str:
        """Loads for each lane the entry at its own index of an array."""
        places = self._places(base, index, dtype)
        kind = self.type(dtype)
        name = f"@llvm.masked.gather.{self._suffix(dtype)}.v{self.lanes}p0"
        pointers = f"<{self.lanes} x ptr>"
        bools = self.type(bool)
        self.declared.add(f"declare {kind} {name}({pointers}, i32, {bools}, {kind})")
        align = np.dtype(dtype).itemsize
        all_lanes = self.constant(np.True_)
        operands = f"{pointers} {places}, i32 {align}, {bools} {all_lanes}, {kind} poison"
        return self.let(f"call {kind} {name}({operands})")

    def scatter(self, value: str, base: str, index: str, mask: str, dtype: DTypeLike) -> None:
        """Stores each lane's value at its own index of an array, where the mask is set."""
        kind = self.type(dtype)
        places = self._places(base, index, dtype)
        align = np.dtype(dtype).itemsize
        name = f"@llvm.masked.scatter.{self._suffix(dtype)}.v{self.lanes}p0"
        pointers = f"<{self.lanes} x ptr>"
        bools = self.type(bool)
        self.declared.add(f"declare void {name}({kind}, {pointers}, i32, {bools})")
        operands = f"{kind} {value}, {pointers} {places}, i32 {align}, {bools} {mask}"
        self.line(f"call void {name}({operands})")

    def _places(self, base: str, index: str, dtype: DTypeLike) -> str:
        """Returns the pointer to each lane's entry of an array."""
        scalar = scalar_type(dtype)
        indices = self.type(np.int64)
        return self.let(f"getelementptr inbounds {scalar}, ptr {base}, {indices} {index}")

    def mask(self, flags: str) -> str:
        """Returns a vector of bools as an integer of as many bits."""
        return self.let(f"bitcast {self.type(bool)} {flags} to i{self.lanes}")

    def bit(self, mask: str, number: int) -> str:
        """Returns an i1: whether a bit of a mask is set."""
        bit_mask = self.let(f"and i{self.lanes} {mask}, {1 << number}")
        return self.let(f"icmp ne i{self.lanes} {bit_mask}, 0")

    def saturate(self, dtype: DTypeLike, source_dtype: Any, value: str) -> str:
        """Converts a float to the nearest integer that there is, and NaN to 0."""
        sign = sign_letter(np.dtype(dtype))
        target_type = self.type(dtype)
        source_type = self.type(source_dtype)
        name = f"@llvm.fpto{sign}i.sat.{self._suffix(dtype)}.{self._suffix(source_dtype)}"
        self.declared.add(f"declare {target_type} {name}({source_type})")
        return self.let(f"call {target_type} {name}({source_type} {value})")

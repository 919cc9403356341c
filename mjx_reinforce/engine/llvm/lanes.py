"""Lane vectors under Python's operators, so that formulas written in LLVM IR read as formulas."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.llvm.text import Text, sign_letter

INFINITY = float("inf")
#: With this as c, x + c - c is the integer nearest to a float32 x, |x| < 2^22, and the lowest bits
#: of x + c are those of that integer.
ROUND_BITS = 1.5 * 2.0**23

_BIT_DTYPES = {"float32": np.int32, "float64": np.int64, "int32": np.float32, "int64": np.float64}


def _writes(float_op: str, integer_op: str = "") -> Any:
    """Returns an operator: an instruction on floats, and one on integers where it is another."""

    def operator(x: "Lanes", y: "Lanes | float") -> "Lanes":
        if x.dtype.kind == "f" or not integer_op:
            return x.write(float_op, y)
        return x.write(integer_op, y)

    return operator


def _compares(predicate: str) -> Any:
    return lambda x, y: x.compare(predicate, y)


@dataclasses.dataclass(eq=False, slots=True)
class Lanes:
    """A lane vector and where it is written; a Python number beside it stands in every lane.

    A product that a sum takes may become one fused operation, rounded once, where the machine
    has it. Comparisons with NaN are false.

    text: where operations are written.
    dtype: the dtype of a lane.
    name: the operand.
    """

    text: Text
    dtype: np.dtype
    name: str

    def like(self, number: "Lanes | float") -> "Lanes":
        """Returns a number as a lane vector of this dtype."""
        if isinstance(number, Lanes):
            return number
        return self.named(self.text.constant(np.asarray(number, self.dtype)))

    def write(
        self, operation: str, *operands: "Lanes | float", dtype: DTypeLike | None = None
    ) -> "Lanes":
        """Writes an instruction on this and further operands; returns its result."""
        operation = f"{operation} {self.text.type(self.dtype)} "
        names = ", ".join([self.name, *(self.like(x).name for x in operands)])
        return Lanes(self.text, np.dtype(dtype or self.dtype), self.text.let(operation + names))

    __add__ = __radd__ = _writes("fadd contract", "add")
    __sub__ = _writes("fsub contract", "sub")
    __mul__ = __rmul__ = _writes("fmul contract", "mul")
    __truediv__ = _writes("fdiv contract")
    __and__, __or__, __xor__ = map(_writes, ("and", "or", "xor"))
    __lshift__, __rshift__ = map(_writes, ("shl", "ashr"))
    __lt__, __le__, __gt__, __ge__ = map(_compares, ("lt", "le", "gt", "ge"))

    def __rsub__(self, minuend):
        return self.like(minuend) - self

    def __rtruediv__(self, dividend):
        return self.like(dividend) / self

    def __neg__(self):
        return self.write("fneg")

    def compare(self, predicate: str, right: "Lanes | float") -> "Lanes":
        """Returns a mask: "eq", "ne", "lt", "le", "gt" or "ge"; with NaN only "ne" is true."""
        if self.dtype.kind == "f":
            # "Unordered" comparisons are true with NaN, "ordered" ones false.
            instruction = "fcmp une" if predicate == "ne" else f"fcmp o{predicate}"
        elif predicate in ("eq", "ne"):
            instruction = f"icmp {predicate}"
        else:
            instruction = f"icmp {sign_letter(self.dtype)}{predicate}"
        return self.write(instruction, right, dtype=bool)

    def where(self, x: "Lanes | float", y: "Lanes | float") -> "Lanes":
        """Returns one value where this mask is set and the other where it is not."""
        # One of the two may be a Python number, and then has the dtype of the other.
        lanes = x if isinstance(x, Lanes) else y
        assert isinstance(lanes, Lanes)
        kind = self.text.type(lanes.dtype)
        x = lanes.like(x)
        y = lanes.like(y)
        mask = f"{self.text.type(bool)} {self.name}"
        return lanes.named(self.text.let(f"select {mask}, {kind} {x.name}, {kind} {y.name}"))

    def named(self, name: str) -> "Lanes":
        """Returns another operand of this dtype."""
        return Lanes(self.text, self.dtype, name)

    def call(self, function: str, *operands: "Lanes | float") -> "Lanes":
        """Calls an intrinsic, such as "fabs", whose operands and result have this dtype."""
        names = [self.like(x).name for x in operands]
        return self.named(self.text.call(f"llvm.{function}", self.dtype, self.name, *names))

    def __abs__(self):
        return self.call("fabs")

    def convert(self, operation: str, dtype: DTypeLike) -> "Lanes":
        """Converts to another dtype by an instruction such as "sitofp"."""
        kind = self.text.type(np.dtype(dtype))
        source = f"{self.text.type(self.dtype)} {self.name}"
        return Lanes(self.text, np.dtype(dtype), self.text.let(f"{operation} {source} to {kind}"))

    def bits(self) -> "Lanes":
        """Returns the same bits as integers, or integers' as floats."""
        return self.convert("bitcast", _BIT_DTYPES[self.dtype.name])

    def polynomial(self, *coefficients: float) -> "Lanes":
        """Returns the polynomial of this with these coefficients, the highest power first."""
        value = self.like(coefficients[0])
        for coefficient in coefficients[1:]:
            value = value * self + coefficient
        return value

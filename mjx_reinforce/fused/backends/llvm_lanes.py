"""Lane vectors under Python's operators, so that formulas written in LLVM IR read as formulas."""

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.fused.backends.llvm_text import Text

INFINITY = float("inf")
#: x + ROUND - ROUND is the integer nearest to a float32 x, |x| < 2^22, and the lowest bits of
#: x + ROUND are those of that integer.
ROUND = 1.5 * 2.0**23

_BITS = {"float32": np.int32, "float64": np.int64, "int32": np.float32, "int64": np.float64}
#: Instructions on floats, and on integers.
_INSTRUCTIONS = {
    "+": ("fadd contract", "add"),
    "-": ("fsub contract", "sub"),
    "*": ("fmul contract", "mul"),
}


class Lanes(NamedTuple):
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
        scalar = np.asarray(number, self.dtype)
        return Lanes(self.text, self.dtype, self.text.constant(scalar))

    def write(
        self, operation: str, *operands: "Lanes | float", dtype: DTypeLike | None = None
    ) -> "Lanes":
        """Writes an instruction on this and further operands; returns its result."""
        operation = f"{operation} {self.text.type(self.dtype)} "
        names = ", ".join([self.name, *(self.like(x).name for x in operands)])
        return Lanes(self.text, np.dtype(dtype or self.dtype), self.text.let(operation + names))

    def _arithmetic(self, sign: str, other: "Lanes | float") -> "Lanes":
        return self.write(_INSTRUCTIONS[sign][self.dtype.kind != "f"], other)

    def __add__(self, other):
        return self._arithmetic("+", other)

    def __sub__(self, other):
        return self._arithmetic("-", other)

    def __mul__(self, other):
        return self._arithmetic("*", other)

    def __truediv__(self, other):
        return self.write("fdiv contract", other)

    __radd__ = __add__
    __rmul__ = __mul__

    def __rsub__(self, other):
        return self.like(other) - self

    def __rtruediv__(self, other):
        return self.like(other) / self

    def __neg__(self):
        return self.write("fneg")

    def __and__(self, other):
        return self.write("and", other)

    def __or__(self, other):
        return self.write("or", other)

    def __xor__(self, other):
        return self.write("xor", other)

    def __lshift__(self, other):
        return self.write("shl", other)

    def __rshift__(self, other):
        return self.write("ashr", other)

    def __lt__(self, other):  # pyright: ignore[reportIncompatibleMethodOverride] (lanes)
        return self.compare("lt", other)

    def __le__(self, other):  # pyright: ignore[reportIncompatibleMethodOverride] (lanes)
        return self.compare("le", other)

    def __gt__(self, other):  # pyright: ignore[reportIncompatibleMethodOverride] (lanes)
        return self.compare("gt", other)

    def __ge__(self, other):  # pyright: ignore[reportIncompatibleMethodOverride] (lanes)
        return self.compare("ge", other)

    def compare(self, predicate: str, other: "Lanes | float") -> "Lanes":
        """Returns a mask: "eq", "ne", "lt", "le", "gt" or "ge"; with NaN only "ne" is true."""
        if self.dtype.kind == "f":
            return self.write(
                f"fcmp {'u' if predicate == 'ne' else 'o'}{predicate}", other, dtype=bool
            )
        signed = "" if predicate in ("eq", "ne") else "s"
        return self.write(f"icmp {signed}{predicate}", other, dtype=bool)

    def where(self, yes: "Lanes | float", no: "Lanes | float") -> "Lanes":
        """Returns one value where this mask is set and the other where it is not."""
        of = yes if isinstance(yes, Lanes) else no
        assert isinstance(of, Lanes)
        kind = self.text.type(of.dtype)
        yes, no = of.like(yes), of.like(no)
        mask = f"{self.text.type(bool)} {self.name}"
        name = self.text.let(f"select {mask}, {kind} {yes.name}, {kind} {no.name}")
        return Lanes(self.text, of.dtype, name)

    def call(self, function: str, *operands: "Lanes | float") -> "Lanes":
        """Calls an intrinsic, such as "fabs", whose operands and result have this dtype."""
        names = [self.like(x).name for x in operands]
        name = self.text.call(f"llvm.{function}", self.dtype, self.name, *names)
        return Lanes(self.text, self.dtype, name)

    def __abs__(self):
        return self.call("fabs")

    def convert(self, operation: str, dtype: DTypeLike) -> "Lanes":
        """Converts to another dtype by an instruction such as "sitofp"."""
        kind = self.text.type(np.dtype(dtype))
        source = f"{self.text.type(self.dtype)} {self.name}"
        return Lanes(self.text, np.dtype(dtype), self.text.let(f"{operation} {source} to {kind}"))

    def bits(self) -> "Lanes":
        """Returns the same bits as integers, or integers' as floats."""
        return self.convert("bitcast", _BITS[self.dtype.name])

    def polynomial(self, *coefficients: float) -> "Lanes":
        """Returns the polynomial of this with these coefficients, the highest power first."""
        result = self.like(coefficients[0])
        for c in coefficients[1:]:
            result = result * self + c
        return result

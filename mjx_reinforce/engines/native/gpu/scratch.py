"""Long arrays of a thread, in a buffer of XLA's.

CUDA sets local memory aside for as many threads as a GPU can hold, whatever a kernel uses: the
arrays of Humanoid's contacts, 48 kB a thread, would take 12.5 GB of an H200. A buffer for the
threads that run takes 1.6 GB.
"""

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.fused.backends.llvm_text import Text

#: Threads of a warp. They have their words side by side.
WARP = 32
#: Bytes of a word.
_WORD = 4
#: On a GPU loops over so many contacts are written out. The arrays of longer loops are long.
WRITTEN_OUT = 25
_NUMBER = "call i32 @llvm.nvvm.read.ptx.sreg.{}()"


class ScratchText(Text):
    """Text for one thread of a GPU, whose long arrays are in the kernel's argument ``%scratch``.

    words: how many words of it each thread has, so far.
    """

    def __init__(self):
        """Starts an empty body."""
        super().__init__(1)
        self.words = 0
        self._apart: set[str] = set()

    def function(self, signature: str) -> str:
        """Returns a module with a function, and with the number of words as "scratch", if any."""
        if not self.words:
            return super().function(signature)
        self._reserved[:0] = self._place_of_thread()
        return f"@scratch = constant i32 {self.words}\n{super().function(signature)}"

    def reserve_long(self, dtype: DTypeLike, count: int) -> str:
        """Returns what ``reserve`` does, in the buffer if the array is long; ``at`` reads it."""
        if count <= WRITTEN_OUT or np.dtype(dtype).itemsize > _WORD:
            return self.reserve(dtype, count)
        name = self.name()
        first = self.words * _WORD * WARP
        self._reserved.append(f"  {name} = getelementptr inbounds i8, ptr %own, i64 {first}")
        self.words += count
        self._apart.add(name)
        return name

    def at(self, pointer: str, dtype: DTypeLike, index: int | str) -> str:
        """Returns the pointer to an entry of an array."""
        if pointer not in self._apart:
            return super().at(pointer, dtype, index)
        step = _WORD * WARP
        offset = index * step if isinstance(index, int) else self.let(f"mul i64 {index}, {step}")
        return self.let(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def _place_of_thread(self) -> list[str]:
        """Returns what finds the first word of the thread, ``%own``."""
        self.declared |= {
            f"declare i32 @llvm.nvvm.read.ptx.sreg.{x}()" for x in ("tid.x", "ctaid.x", "ntid.x")
        }
        return [
            f"  {line}"
            for line in (
                f"%thread = {_NUMBER.format('tid.x')}",
                f"%block = {_NUMBER.format('ctaid.x')}",
                f"%threads = {_NUMBER.format('ntid.x')}",
                "%before = mul i32 %block, %threads",
                "%number = add i32 %before, %thread",
                f"%lane = and i32 %number, {WARP - 1}",
                "%others = sub i32 %number, %lane",
                "%others.wide = zext i32 %others to i64",
                "%lane.wide = zext i32 %lane to i64",
                f"%warp.first = mul i64 %others.wide, {self.words}",
                "%first = add i64 %warp.first, %lane.wide",
                "%own = getelementptr inbounds i32, ptr %scratch, i64 %first",
            )
        ]

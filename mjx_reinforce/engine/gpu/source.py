"""What the text of a GPU's kernel is written in, and how the kernel is launched."""

from typing import Literal, NamedTuple

#: LLVM IR and CUDA C++ are written here; PTX is what LLVM makes of its own.
Language = Literal["llvm", "ptx", "cuda"]
#: Threads of a warp.
WARP = 32


class Facts(NamedTuple):
    """How a kernel is launched.

    threads: of a block, at most
    blocks: on a multiprocessor; its registers are as many as that leaves each thread
    scratch: 4-byte words of a buffer that each thread needs
    lanes: threads that play an episode together
    shared: bytes of shared memory of a block
    """

    threads: int
    blocks: int
    scratch: int = 0
    lanes: int = 1
    shared: int = 0


class Source(NamedTuple):
    """A kernel as it is written. Its entry is ``kernel.ENTRY``."""

    language: Language
    text: str
    facts: Facts

    def for_compiler(self) -> str:
        """Returns the text as its compiler reads it: CUDA C++ reads the facts as macros."""
        if self.language != "cuda":
            return self.text
        facts = self.facts
        return (
            f"// teams of {facts.lanes}, {facts.threads} threads, {facts.shared} bytes, "
            f"scratch = {facts.scratch}\n"
            f"#define WARPS {facts.threads // WARP}\n"
            f"#define W {facts.lanes}\n"
            f"#define SHARED {facts.shared}\n"
            f"#define THREAD_WORDS {facts.scratch}\n"
            f"{self.text}"
        )

"""What the text of a GPU's kernel is written in, and how the kernel is launched."""

from typing import Literal, NamedTuple

#: LLVM IR and CUDA C++ are written here; PTX is what LLVM makes of its own.
Language = Literal["llvm", "ptx", "cuda"]
#: Threads of a warp.
WARP = 32


class Launch(NamedTuple):
    """How a kernel is launched.

    The fields' names are keys of the first line of a kept kernel (``ptx.described``); macros of
    CUDA C++ have their values, but for ``blocks`` (``Source.for_compiler``).

    threads: of a block, at most
    blocks: on a multiprocessor; its registers are as many as that leaves each thread
    scratch: 4-byte words of a buffer that each thread needs
    lanes: threads that play an episode together
    shared: bytes of shared memory of a block
    most_threads: threads of a block where items are many; 0 are as ``threads``
    """

    threads: int
    blocks: int
    scratch: int = 0
    lanes: int = 1
    shared: int = 0
    most_threads: int = 0


class Source(NamedTuple):
    """A kernel as it is written. Its entry is ``kernel.ENTRY``."""

    language: Language
    text: str
    launch: Launch

    def for_compiler(self) -> str:
        """Returns the text as its compiler reads it: CUDA C++ reads the launch as macros."""
        if self.language != "cuda":
            return self.text
        launch = self.launch
        return (
            f"// teams of {launch.lanes}, {launch.threads} threads, {launch.shared} bytes, "
            f"scratch = {launch.scratch}\n"
            f"#define WARPS {launch.threads // WARP}\n"
            f"#define W {launch.lanes}\n"
            f"#define SHARED {launch.shared}\n"
            f"#define THREAD_WORDS {launch.scratch}\n"
            f"{self.text}"
        )

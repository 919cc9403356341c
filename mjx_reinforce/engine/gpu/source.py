"""The text of a GPU's kernel, which is CUDA C++, and how the kernel is launched."""

from typing import NamedTuple

#: Threads of a warp.
WARP = 32


class Launch(NamedTuple):
    """How a kernel is launched.

    The fields' names are keys of the first line of a kept kernel (``cubin.described``); macros of
    its text have their values, but for ``blocks`` (``Source.for_compiler``).

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
    """A kernel as it is written. Its entry is ``loops.ENTRY``."""

    text: str
    launch: Launch

    def for_compiler(self) -> str:
        """Returns the text as its compiler reads it, with the launch as macros."""
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

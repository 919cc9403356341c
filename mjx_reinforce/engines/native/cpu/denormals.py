"""Numbers too small for full precision count as zero, as on XLA's own threads.

All threads of a job do the same, so that an episode is the same on any of them.
"""

from typing import NamedTuple


class Flush(NamedTuple):
    """LLVM IR for one architecture.

    declarations: the intrinsics
    begin: what takes such numbers as zero from now on
    end: what undoes it
    """

    declarations: str = ""
    begin: str = ""
    end: str = ""


_FLUSHES = {
    "x86_64": Flush(  # MXCSR: flush to zero, and denormals are zero
        """declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
""",
        """%control = alloca [2 x i32]
  call void @llvm.x86.sse.stmxcsr(ptr %control)
  %control.old = load i32, ptr %control
  %control.new = or i32 %control.old, 32832
  %control.at = getelementptr inbounds i32, ptr %control, i64 1
  store i32 %control.new, ptr %control.at
  call void @llvm.x86.sse.ldmxcsr(ptr %control.at)""",
        "call void @llvm.x86.sse.ldmxcsr(ptr %control)",
    ),
    "aarch64": Flush(  # FPCR: flush to zero
        """declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)
""",
        """%control.old = call i64 @llvm.aarch64.get.fpcr()
  %control.new = or i64 %control.old, 16777216
  call void @llvm.aarch64.set.fpcr(i64 %control.new)""",
        "call void @llvm.aarch64.set.fpcr(i64 %control.old)",
    ),
}


def flush(triple: str) -> Flush:
    """Returns what flushes on a machine; nothing where that is not known."""
    architecture = triple.partition("-")[0].replace("arm64", "aarch64")
    return _FLUSHES.get(architecture, Flush())

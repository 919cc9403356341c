#!/usr/bin/env bash
# nvidia-cuda-nvrtc 13.5.37 (Linux x86-64, no GPU needed, 2026-11-29).
#
# A warp shuffle whose lanes may not be together is in the machine code twice: once for a warp that is
# together, and once, some six instructions long, for one that is not. A branch on a lane's own data
# is enough for that, although __shfl_sync with a full mask requires all lanes to come. 64 shuffles are
# 152 instructions for sm_90 in straight code, and 568 in such a branch. __syncwarp() at the start of
# the branch brings them back to 152 for sm_90, but not for sm_80. A mask of half a warp that depends
# on the lane costs the most, also in straight code: 728.
#
# Expected: code of about the same length. The cold copies are not run, but they are most of a kernel
# that is rich in shuffles, and registers are allocated for both. Seen:
#
#     sm_80 straight 152, branch 544, branch with __syncwarp 552, half-warp mask 488
#     sm_90 straight 152, branch 568, branch with __syncwarp 152, half-warp mask 728
#
# This script ends with status 1 where that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check nvidia-cuda-nvrtc==13.5.37
cat > "$folder/count.py" <<'PYTHON'
import ctypes
import pathlib
import struct
import sys
import sysconfig

site = pathlib.Path(sysconfig.get_paths()["purelib"])
nvrtc = ctypes.CDLL(str(next(site.glob("nvidia/cu*/lib/libnvrtc.so.??"))))
KERNEL = """
extern "C" __global__ void shuffles(float* numbers) {
  float x = numbers[threadIdx.x];
  const unsigned lane = threadIdx.x & 31, mask = MASK;
  BRANCH {
    SYNC
#pragma unroll
    for (int i = 0; i < 64; i++) x = 1.5f * x + __shfl_sync(mask, x, i & 31);
  }
  numbers[threadIdx.x] = x;
}
"""
WHOLE = "0xffffffffu"
CASES = {
    "straight": (WHOLE, "", ""),
    "branch": (WHOLE, "if (x > 0)", ""),
    "branch with __syncwarp": (WHOLE, "if (x > 0)", "__syncwarp();"),
    "half-warp mask": ("lane < 16 ? 0xffffu : 0xffff0000u", "", ""),
}


def cubin(text, architecture):
    """Returns the machine code of a text."""
    program = ctypes.c_void_p()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"a.cu", 0, None, None)
    options = (ctypes.c_char_p * 1)(f"--gpu-architecture={architecture}".encode())
    assert nvrtc.nvrtcCompileProgram(program, 1, options) == 0
    size = ctypes.c_size_t()
    nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
    buffer = ctypes.create_string_buffer(size.value)
    nvrtc.nvrtcGetCUBIN(program, buffer)
    return buffer.raw


def num_instructions(elf):
    """Returns how many instructions of 16 bytes the kernel has: the size of its ELF section."""
    (table,) = struct.unpack_from("<Q", elf, 0x28)
    entry_size, count, names = struct.unpack_from("<HHH", elf, 0x3A)
    sections = [struct.unpack_from("<IIQQQQ", elf, table + i * entry_size) for i in range(count)]
    start = sections[names][4]
    for section in sections:
        if elf[start + section[0] :].startswith(b".text.shuffles\0"):
            return section[5] // 16
    raise LookupError(".text.shuffles")


lengths = {}
for architecture in ("sm_80", "sm_90"):
    for name, (mask, branch, sync) in CASES.items():
        text = KERNEL.replace("MASK", mask).replace("BRANCH", branch).replace("SYNC", sync)
        lengths[architecture, name] = num_instructions(cubin(text, architecture))
    print(architecture, ", ".join(f"{name} {lengths[architecture, name]}" for name in CASES))
as_before = (
    lengths["sm_90", "branch"] > 3 * lengths["sm_90", "straight"]
    and lengths["sm_90", "branch with __syncwarp"] < 1.2 * lengths["sm_90", "straight"]
    and lengths["sm_80", "branch with __syncwarp"] > 3 * lengths["sm_80", "straight"]
    and lengths["sm_90", "half-warp mask"] > 4 * lengths["sm_90", "straight"]
)
sys.exit(0 if as_before else 1)
PYTHON
"$folder/venv/bin/python" "$folder/count.py"

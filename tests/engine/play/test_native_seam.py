"""Machine code made at run time, called from compiled JAX on whatever threads."""

import ctypes
import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import native_items as items
import numpy as np
import pytest
from jax import lax
from places import PYTHONPATH

from mjx_reinforce.engine import objects
from mjx_reinforce.engine.cpu import handler, machine, seam
from mjx_reinforce.engine.play import available

pytestmark = pytest.mark.cpu
ACTIVE = [1, 0, 1, 1, 0, 7]


@pytest.fixture
def code():
    """The test kernel."""
    return items.load()


def test_results_under_jit(code):
    play = jax.jit(lambda active: items.play(code, active))
    for active in (ACTIVE, [0, 0], [1], 1, [[1, 0, 1], [0, 0, 1]]):
        for _ in range(2):
            items.check(play(jnp.array(active)), active)


def test_in_a_scan_and_a_while_loop(code):
    """Each call gets what the last one gave, without going back to Python."""

    def turn(active):
        return (items.play(code, active)[3][:, 0] % 2).astype(jnp.int32)

    start = jnp.array([1, 1, 1, 1])
    steps = lax.scan(lambda a, _: (1 - turn(a), items.play(code, a)), start, length=3)[1]
    expected = np.array(ACTIVE[:4]) * 0 + 1
    for step in range(3):
        items.check([x[step] for x in steps], expected)
        expected = 1 - (expected * (1 + 3 * np.arange(4))) % 2
    last = lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, 1 - turn(c[1])), (0, start))[1]
    np.testing.assert_array_equal(last, expected)


def test_vmapped_and_vmapped_again(code):
    active = np.array(ACTIVE * 4).reshape(2, 3, 4)
    play = lambda active: items.play(code, active)  # noqa: E731
    items.check(jax.jit(jax.vmap(play))(active[0]), active[0])
    items.check(jax.jit(jax.vmap(jax.vmap(play)))(active), active)
    moved = jax.vmap(play, in_axes=1)(active[0])
    items.check(moved, active[0].T)


def test_derivatives_are_refused_by_jax(code):
    def total(x):
        limits, keys = jnp.ones((2, items.N), jnp.int32), jnp.zeros((2, items.N, 2), jnp.uint32)
        args = (limits, jnp.zeros(2, jnp.int32), keys, x)
        return seam.call(code, items.shapes((2,)), *args)[2].sum()

    with pytest.raises(ValueError, match=r"differentiat|JVP"):
        jax.grad(total)(jnp.zeros(2))


def run(program, **environment):
    """Runs a program in a process of its own, beside the test kernel; returns what it prints."""
    program = f"import jax, sys\nimport native_items as items\n{program}"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": PYTHONPATH, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("pool", ["1", pytest.param("4", marks=pytest.mark.slow)])
def test_on_eight_devices_at_once(pool):
    run(
        """
from mjx_reinforce.engine.devices import RUNS, Devices
devices, code = Devices(), items.load()
assert devices.count == 8
active = jax.numpy.arange(16) % 3
def local(active):
    def again(_, results): return items.play(code, active + (results[3][:, 0] < 0))
    return jax.lax.fori_loop(0, 200, again, items.play(code, active))
results = devices.jit(local, RUNS, RUNS)(devices.put(active, RUNS))
for device in range(8):
    items.check([x[2 * device:2 * device + 2] for x in results], active[2 * device:2 * device + 2])
""",
        NPROC=pool,
        XLA_FLAGS="--xla_force_host_platform_device_count=8",
    )


@pytest.mark.slow
def test_no_memory_is_lost():
    """10,000 jobs of 4 kB on a pool of 4; tasks that come late free what they hold."""
    before, after = run(
        """
import jax.numpy as jnp
from pathlib import Path
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4
code, active = items.load(), jnp.ones(500, jnp.int32)
@jax.jit
def many(active):
    def again(_, active): return active + (items.play(code, active)[5] < 0)
    return jax.lax.fori_loop(0, 5000, again, active)
many(active).block_until_ready()
print(resident())
for _ in range(2): many(active).block_until_ready()
print(resident())
""",
        NPROC="4",
    )
    assert int(after) - int(before) < 20_000  # kB, of 40,000 that were in use


def test_results_are_zeroed_by_all_threads():
    """Buffers of several parts, of sizes that divide into none, with bounds around them."""
    seeds, horizon = 2, 200_001
    given = [np.ones((seeds, items.N), np.int32), np.zeros(seeds, np.int32)]
    given += [np.zeros((seeds, items.N, 2), np.uint32), np.zeros(seeds, np.int32)]
    sizes = [seeds * n for n in (horizon * 6, horizon * 3, horizon * 3, items.N, items.N, 1)]
    made = [np.full(size + 2, 7, np.int32) for size in sizes]
    items.by_hand(items.text(), given, [x[1:-1] for x in made], (seeds, items.N, horizon))
    assert all(x[0] == x[-1] == 7 for x in made)
    observation, action, reward, length, broken, simulated = (x[1:-1] for x in made)
    assert not any(x.any() for x in (observation, action, broken))
    items_played = seeds * items.N
    assert np.count_nonzero(reward) == items_played
    np.testing.assert_array_equal(length, 1 + np.arange(items_played))
    np.testing.assert_array_equal(simulated, [3, 0])


@pytest.mark.slow
def test_a_second_process_compiles_nothing(tmp_path):
    """Neither LLVM nor XLA."""
    program = """
from mjx_reinforce.engine import objects
events = []
jax.monitoring.register_event_listener(lambda e, **_: events.append(e))
code = items.load(objects.folder())
items.check(jax.jit(lambda a: items.play(code, a))(jax.numpy.array([1, 0, 1])), [1, 0, 1])
print(code.compiled, *(e.rsplit('/')[-1] for e in events if 'cache_' in e))
"""
    where = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    assert run(program, **where)[0] == "True"
    compiled, *events = run(program, **where)
    assert compiled == "False"
    assert "cache_hits" in events
    assert "cache_misses" not in events


@pytest.fixture
def cache(tmp_path):
    """Where JAX keeps programs, for the test."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_damaged_object_is_none(tmp_path):
    objects.write_object(tmp_path, "key", b"data")
    assert objects.read_object(tmp_path, "key") == b"data"
    whole = (tmp_path / "key.o").read_bytes()
    for damage in (b"", b"short", bytes(2000), whole[:-1] + bytes([whole[-1] ^ 1])):
        (tmp_path / "key.o").write_bytes(damage)
        assert objects.read_object(tmp_path, "key") is None


def test_the_cache_forgets_what_was_used_longest_ago(tmp_path):
    for age, key in enumerate("abc"):
        objects.write_object(tmp_path, key, bytes(1000), limit=3200)
        os.utime(tmp_path / f"{key}.o", (100 + age, 100 + age))
    assert objects.read_object(tmp_path, "a") == bytes(1000)  # and is now the newest
    objects.write_object(tmp_path, "d", b"1" * 1000, limit=3200)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.o", "c.o", "d.o"]
    assert objects.read_object(tmp_path, "b") is None


def test_a_cache_that_cannot_be_written_is_none(tmp_path):
    (tmp_path / "file").touch()
    objects.write_object(tmp_path / "file" / "cache", "key", b"data")
    assert objects.read_object(tmp_path / "file" / "cache", "key") is None


def test_objects_are_kept_where_jax_keeps_programs_and_nobody_else_may_write(cache):
    assert objects.folder() == cache / "native"
    objects.make_folder(cache / "native")
    (cache / "native").chmod(0o777)
    with pytest.warns(UserWarning, match="others may write to .* no machine code is kept"):
        assert objects.folder() is None
    for folder in (None, "gs://bucket/cache"):
        jax.config.update("jax_compilation_cache_dir", folder)
        assert objects.folder() is None


VECTORS = """
define void @add(ptr %to) {
  %x = load <16 x float>, ptr %to
  %y = fmul <16 x float> %x, %x
  store <16 x float> %y, ptr %to
  ret void
}
"""


@pytest.mark.parametrize("level", machine.LEVELS)
def test_code_for_older_cpus(level, monkeypatch):
    """The registers are those of the level, and the numbers the same."""
    import llvmlite.binding as llvm

    monkeypatch.setenv(machine.VARIABLE, "pentium")
    with pytest.raises(ValueError, match="pentium"):
        machine.this_machine()
    lanes, features = machine.LEVELS[level]
    monkeypatch.setenv(machine.VARIABLE, level)
    if not all(llvm.get_host_cpu_features().get(feature) for feature in features):
        with pytest.raises(ValueError, match=f"{level!r}, which this CPU is not: no "):
            machine.this_machine()
        return
    found = machine.this_machine()
    assert found.lanes == lanes
    target = machine._target(found)
    assembly = target.emit_assembly(llvm.parse_assembly(VECTORS))
    widest = {4: "xmm", 8: "ymm", 16: "zmm"}[lanes]
    assert set(re.findall("[xyz]mm", assembly)) == {widest}
    numbers = np.arange(32, dtype=np.float32)
    aligned = numbers[(-numbers.ctypes.data % 64) // 4 :][:16]
    expected = aligned**2
    code = machine.load_module(VECTORS, lambda: VECTORS, ("add",), found, None)
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(code.addresses["add"])(aligned.ctypes.data)
    np.testing.assert_array_equal(aligned, expected)
    items.check(items.play(items.load(), ACTIVE), ACTIVE)


def test_it_says_why_it_is_unavailable(monkeypatch):
    assert available.unavailable() is None
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "llvmlite", None)
        assert "llvmlite cannot be loaded" in (available.unavailable() or "")
    with monkeypatch.context() as patch:
        patch.setattr("llvmlite.binding.llvm_version_info", (15, 0, 7))
        assert "too old" in (available.unavailable() or "")
    with monkeypatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "tpu")
        assert "JAX on a tpu" in (available.unavailable() or "")
    with jax.default_prng_impl("rbg"):
        assert "not as rbg" in (available.unavailable() or "")


def test_the_engine_is_imported_without_llvmlite():
    names = ("objects", "cpu.machine", "cpu.handler", "cpu.seam", "gpu.cubin", "gpu.seam")
    program = "".join(f"import mjx_reinforce.engine.{name}\n" for name in names)
    assert run(f"{program}print('llvmlite' in sys.modules)") == ["False"]


def test_offsets_are_those_of_jaxs_header():
    """Every struct is of pointers, 8-byte integers, 4-byte enums and ints, and structs of these."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text("utf-8")
    assert "#define XLA_FFI_API_MAJOR 0\n" in header
    header = re.sub(r"//.*", "", header)
    header = re.sub(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\)", r"void* \1", header)
    enums = set(
        re.findall(r"\}\s*(XLA_FFI_\w+);", "".join(re.findall(r"enum \{.*?;", header, re.S)))
    )
    enums |= {"int", "int32_t", "XLA_FFI_Handler_Traits"}
    bodies = {
        name: re.findall(r"([\w ]+?\**)\s*(\w+);", body.replace("const ", ""))
        for name, body in re.findall(r"struct (XLA_FFI_\w+) \{(.*?)\n\}", header, re.S)
    }

    def layout(struct):
        """Size of a struct, and its members' offsets."""
        offset, found = 0, {}
        for kind, name in bodies[struct]:
            kind = kind.strip()
            size, inner = (4, {}) if kind in enums else (8, {})
            if kind in bodies:
                size, inner = layout(kind)
            offset += -offset % min(size, 8)
            found[name] = offset
            found |= {f"{name}.{member}": offset + at for member, at in inner.items()}
            offset += size
        return offset + -offset % 8, found

    for path, offset in handler.OFFSETS.items():
        struct, _, member = path.partition(".")
        assert layout(struct)[1][member] == offset, path


# -------------------------------------------------------------------------------------------------
# By which name XLA knows machine kept_code, and how a program on disk finds it again.

#: XLA takes one handler of a name, so that each test has kept_code of its own.
NUMBERS = itertools.count(20)


@pytest.fixture
def kept_code(tmp_path, monkeypatch):
    """Code that is on disk, of which this process forgets how it is called."""
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    monkeypatch.setattr(seam, "_HANDLER_KEYS", set())
    monkeypatch.setattr(machine, "_CACHE", {})
    return items.load(tmp_path, lanes=next(NUMBERS))


def test_the_name_of_a_handler_is_that_of_its_code(kept_code):
    assert seam.targets() == [f"mjx_reinforce_{kept_code.key}"]
    assert len(kept_code.key) == 64


def test_a_program_on_disk_finds_its_code(kept_code, monkeypatch):
    program = b"... mjx_reinforce_" + kept_code.key.encode() + b" ..."
    assert seam.restore(program)
    monkeypatch.setattr(machine, "_CACHE", {})
    assert seam.restore(program * 2)
    assert seam.targets() == [f"mjx_reinforce_{kept_code.key}"]


def test_code_that_is_gone_is_not_restored(kept_code, tmp_path, monkeypatch):
    assert not seam.restore(b"mjx_reinforce_" + b"0" * 64)
    monkeypatch.setattr(machine, "_CACHE", {})
    for path in tmp_path.iterdir():
        path.unlink()
    assert not seam.restore(seam._target(kept_code.key).encode())

"""A function of one example in machine code: ``jax.vmap``'s results of batches of any size."""

import jax
import jax.numpy as jnp
import native_items as items
import numpy as np
import pytest
from scenes import FEET, Scene

from mjx_reinforce.engine.cpu import machine
from mjx_reinforce.engine.cpu.handler import flush
from mjx_reinforce.engine.cpu.machine import this_machine
from mjx_reinforce.engine.physics import touching
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.engine.play import program
from mjx_reinforce.engine.play.program import machine_map

pytest.importorskip("llvmlite", reason="machine code is written by llvmlite")
pytestmark = pytest.mark.cpu


def function(x, nothing, more):
    """Leaves of every kind; two results, one of them empty, one a bool, one an integer."""
    flag, count = more
    y = jnp.where(flag, x, -2 * x) + count
    return {"y": y, "none": nothing * 2, "big": y.sum() > 1, "n": count * 2 + 1, "x": x[1]}


def batch(size):
    rng = np.random.default_rng(size)
    flags, counts = rng.integers(0, 2, size) > 0, rng.integers(-5, 5, size).astype(np.int32)
    x = rng.normal(size=(size, 3)).astype(np.float32)
    return jnp.asarray(x), jnp.zeros((size, 0)), (jnp.asarray(flags), jnp.asarray(counts))


@pytest.fixture(scope="module")
def mapped():
    return jax.jit(machine_map(function, *jax.tree.map(lambda x: x[0], batch(1))))


def test_results_are_those_of_vmap(mapped):
    """The last lanes have no example where the size is no multiple of theirs."""
    for size in (1, 16, 37):
        got, want = mapped(*batch(size)), jax.vmap(function)(*batch(size))
        assert jax.tree.structure(got) == jax.tree.structure(want)
        for x, exact in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
            assert (x.shape, x.dtype) == (exact.shape, exact.dtype)
            np.testing.assert_allclose(x, exact, rtol=1e-6)
        assert size % this_machine().lanes or size == 16


def test_a_loop_reads_what_one_before_it_has_kept():
    """In its order, backwards and in parts."""

    def sums(x):
        kept = jax.lax.scan(lambda y, _: (0.9 * y, jnp.sin(y)), x, None, 7)[1]
        add = lambda y, row: (0.5 * y + row, None)  # noqa: E731
        parts = kept, kept[::-1], kept[:4], kept[3:], kept[4::-1], kept[:2:-1], kept[::2]
        return [jax.lax.scan(add, x, part)[0] for part in parts]

    x, *_ = batch(37)
    got = jax.jit(machine_map(sums, x[0]))(x)
    np.testing.assert_allclose(got, jax.vmap(sums)(x), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_loops_may_keep_more_than_a_stack_has_room_for():
    """Some 13 MB for 16 lanes: without the heap, the process ends."""

    def there_and_back(x):
        kept = jax.lax.scan(lambda y, _: (0.999 * y, y), x, None, 200_000)[1]
        return jax.lax.scan(lambda y, row: (0.5 * y + row, None), x, kept[::-1])[0]

    x = jnp.arange(1.0, 4.0)
    got = jax.jit(machine_map(there_and_back, x[0]))(x)
    np.testing.assert_allclose(got, x / (1 - 0.5 * 0.999), rtol=1e-5)


def test_integers_divide_as_everywhere():
    """By zero, and the least one by -1, for both of which a processor stops the program."""
    edges = jnp.int32([-(2**31), -7, -1, 0, 1, 5, 2**31 - 1])
    x, y = (x.ravel() for x in jnp.meshgrid(edges, edges))
    for function in (jax.lax.div, jax.lax.rem):
        got = jax.jit(machine_map(function, x[0], y[0]))(x, y)
        np.testing.assert_array_equal(got, jax.vmap(function)(x, y))


def test_a_long_text_takes_less_effort_and_gives_the_same_bits(mapped, monkeypatch):
    efforts = []
    effort = machine._effort

    def noted(text):
        efforts.append(effort(text))
        return efforts[-1]

    def named(x, nothing, more):
        return function(x, nothing, more) | {"one": x[0] * 0}  # XLA has not met its handler

    monkeypatch.setattr(machine, "_effort", noted)
    monkeypatch.setattr(machine, "_LONG_TEXT", 0)
    monkeypatch.setattr(machine, "_CACHE", {})
    monkeypatch.setattr(program.objects, "folder", lambda: None)
    other = jax.jit(machine_map(named, *jax.tree.map(lambda x: x[0], batch(1))))(*batch(37))
    for name, x in mapped(*batch(37)).items():
        np.testing.assert_array_equal(x, other[name])
    assert set(efforts) == {1}


def test_numbers_of_8_bits_are_refused():
    with pytest.raises(TypeError, match="it has numbers of int8, not of 32 or 64 bits"):
        machine_map(lambda x: x, jnp.int8(1))
    with pytest.raises(TypeError, match="numbers of uint8"):
        machine_map(lambda x: x.astype(jnp.uint8), jnp.int32(1))


def test_numbers_below_the_smallest_normal_are_zero(monkeypatch):
    """Also in threads of Python's: XLA has its own flush too."""
    if flush(this_machine().triple) == flush("riscv64-linux"):
        pytest.skip("unknown on this machine")
    texts, load = [], machine.load_module
    noted = lambda source, write, *x: texts.append(write()) or load(source, write, *x)  # noqa: E731
    monkeypatch.setattr(machine, "load_module", noted)
    machine_map(lambda x, y: x * y, jnp.float32(0), jnp.float32(0))
    monkeypatch.setattr(machine, "load_module", load)
    x = np.float32([1e-20, 1e-19, 1.0, 1e-38]).repeat(9)
    y = np.float32([1e-20, 1e-18, 1e-39, 0.5]).repeat(9)
    small = np.full(x.shape, np.nan, np.float32)
    items.by_hand(texts[0], [np.zeros(1, np.int32), x, y], [small], (1, x.size, 1))
    np.testing.assert_array_equal(small, np.where(x * y < 2.0**-126, 0, x * y))
    assert (x * y > 0).all()


def test_flushing_is_known_by_the_architecture():
    assert flush("arm64-apple-darwin") == flush("aarch64-unknown-linux-gnu")
    systems = ("aarch64-linux", "x86_64-pc-linux-gnu", "riscv64-linux")
    assert len(set(map(flush, systems))) == 3


# -------------------------------------------------------------------------------------------------
# Machine code visits pairs of geoms, contacts and rows in loops, and skips what is apart.


def forwards(env):
    """What the physics makes of 64 random states, by machine code and by ``vmap``."""
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64)).info
    in_machine_code = machine_map(env.forward, jax.tree.map(lambda x: x[0], starts))
    both = in_machine_code, jax.vmap(env.forward)
    return tuple(np.asarray(jax.jit(mapped)(starts)) for mapped in both)


def assert_equal(ours, theirs):
    scale = 1 + np.abs(theirs).max(axis=1)
    assert np.max(np.abs(ours - theirs).max(axis=1) / scale) < 1e-11


@pytest.mark.slow
def test_contacts(monkeypatch):
    """Where there is room in `touching` for those that touch, and where there is not."""
    room = 2
    monkeypatch.setattr(touching, "_room", lambda *_: room)
    with jax.enable_x64(True):
        env = Scene(FEET)
        ours, theirs = forwards(env)
    jax.clear_caches()
    dims = jax_fields(env.data).contact.dim
    touches = theirs[:, -len(dims) :]
    assert sorted(np.unique(dims)) == [1, 3, 4, 6]
    for dim in np.unique(dims):
        assert 0 < touches[:, dims == dim].mean() < 1, dim
    most = np.max([touches[:, dims == dim].sum(axis=1) for dim in np.unique(dims)], axis=0)
    assert {room - 1, room, room + 1} <= {*most.astype(int)}
    np.testing.assert_array_equal(ours[:, -len(dims) :], touches)
    assert_equal(ours, theirs)


#: Models made for MJX say how many pairs and contacts to look at: those that are nearest.
NEAREST = """
<mujoco>
  <custom>
    <numeric name="max_geom_pairs" data="2"/><numeric name="max_contact_points" data="3"/>
  </custom>
  <worldbody><geom type="plane" size="5 5 1"/>{}</worldbody>
</mujoco>""".format(
    "".join(
        f"""<body pos="{x} 0 0"><joint type="slide" axis="1 0 0"/>
        <joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.15"/></body>"""
        for x in (0.0, 0.2, 0.4)
    )
)


@pytest.mark.slow
def test_the_nearest_pairs_and_contacts():
    with jax.enable_x64(True):
        ours, theirs = forwards(Scene(NEAREST))
    jax.clear_caches()
    assert {1, 2, 3} <= {*theirs[:, -3:].sum(axis=1).astype(int)}
    assert_equal(ours, theirs)


BALL = """
<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1"/></body>
</worldbody></mujoco>"""


class LostBall(Scene):
    """Where the ball is NaN, its acceleration and the force on it are."""

    def forward(self, info):
        qpos, *others = info
        return super().forward((jnp.where(qpos > 0.1, jnp.nan, qpos), *others))


@pytest.mark.slow
def test_a_nan_gets_to_the_acceleration():
    ours, theirs = forwards(LostBall(BALL))
    assert 0 < np.isnan(theirs).any(axis=1).sum() < 64
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))

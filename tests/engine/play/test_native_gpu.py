"""The native engine's kernels for GPUs: what they play, run on this CPU, and what they are."""

import re
import shutil
import subprocess

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from players import actor_and_act, assert_same_episodes, only_active, played
from scenes import THREE_FEET, Scene
from toys import Busy, Bytes, Chain, Drifting, categorical

from mjx_reinforce import Box, make_vec
from mjx_reinforce.engine import scalar
from mjx_reinforce.engine.gpu import kernel as kernels
from mjx_reinforce.engine.gpu import ptx, seam
from mjx_reinforce.engine.physics import touching
from mjx_reinforce.engine.play import available, native, program, rollouts
from mjx_reinforce.engine.scalar import scalarized

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)


@pytest.fixture(scope="module")
def busy():
    env = Busy()
    return env, actor_and_act(env, (5, 6))


def assert_identical(got, want):
    for name in ("observation", "action", "reward", "mask", "nonfinite"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)


@pytest.mark.parametrize(
    ("env", "distribution"),
    [
        pytest.param(Busy(), None, id="loops", marks=pytest.mark.slow),
        pytest.param(Bytes(), None, id="8 bits"),
        pytest.param(Chain(), categorical(2), id="integer actions", marks=pytest.mark.slow),
    ],
)
def test_the_same_episodes_as_everywhere(env, distribution, monkeypatch):
    """Of toys whose state has a counter, a flag, a limit and a number of 8 bits."""
    who = actor_and_act(env, (4,), distribution=distribution)
    options = {"deterministic": jnp.arange(5) < 2, "horizon": 100}
    options["limit"] = jnp.array([200, 7, 100, 1, 63])
    want = None
    for threads in (1, 3):
        gpu_on_cpu.emulate(monkeypatch, threads)
        got = played(native.native_rollout, env, who, **options)
        want = want or played(rollouts.vmap_rollout, env, who, **options)
        assert got.action.dtype == want.action.dtype
        assert got.mask[:, 0].all()
        assert not got.mask[:, -1].all()
        assert_same_episodes(got, want, rounding=2e-5)
        if threads == 1:
            np.testing.assert_array_equal(got.simulated, got.mask.sum((1, 2)))


@pytest.mark.slow
def test_episodes_that_are_not_active_are_not_played(busy, monkeypatch):
    """Also in step with others: a thread that never had an episode counts no steps."""
    monkeypatch.setattr(kernels, "LONG_BODY", 0)
    chosen = np.array([[0] * 5, [0, 1, 0, 0, 1], [0] * 5]).astype(bool)
    options = {"horizon": 20, "deterministic": jnp.arange(5) % 2 == 1}
    for threads in (1, 3):
        block = gpu_on_cpu.Block(threads)
        gpu_on_cpu.emulate(monkeypatch, block=block)
        some = only_active(native.native_rollout, *busy, chosen, **options)
        assert block.apart is None
        assert not some.simulated[[0, 2]].any()
        lengths = some.mask[1].sum(axis=0)
        assert some.simulated[1] == (lengths.sum() if threads == 1 else 2 * lengths.max())


@pytest.mark.slow
def test_in_step_or_apart_an_episode_is_the_same(busy, monkeypatch):
    """Loops and branches are entered by all threads together or by each alone.

    Threads of a block meet at one place, also where their episodes have ended.
    """
    gpu_on_cpu.emulate(monkeypatch)
    want = played(native.native_rollout, *busy, horizon=30)
    meetings = []
    for long in (10**9, 4, 0):
        block = gpu_on_cpu.Block(3)
        gpu_on_cpu.emulate(monkeypatch, block=block)
        monkeypatch.setattr(kernels, "LONG_BODY", long)
        got = played(native.native_rollout, *busy, horizon=30)
        assert block.apart is None
        meetings.append(block.meetings)
        assert_identical(got, want)
    assert 0 < meetings[0] < meetings[1] < meetings[2]


@pytest.mark.slow
def test_threads_meet_where_some_have_no_room_for_their_contacts(monkeypatch):
    monkeypatch.setattr(touching, "_room", lambda model: 1)
    env = Scene(THREE_FEET)
    who = actor_and_act(env, ())
    size = {"num_episodes": 12, "horizon": 2}
    gpu_on_cpu.emulate(monkeypatch)
    want = played(native.native_rollout, env, who, **size)
    touch = want.observation[:, 1, :, -3:].sum(axis=-1)
    assert {0, 1, 2} <= {*touch.ravel().astype(int)}
    block = gpu_on_cpu.Block(3)
    gpu_on_cpu.emulate(monkeypatch, block=block)
    monkeypatch.setattr(kernels, "LONG_BODY", 0)
    assert_identical(played(native.native_rollout, env, who, **size), want)
    assert block.apart is None


def kernel_text(env, actor, act, distribution):
    examples = program.step_shapes(env, actor)[:-1]
    function = program.step_function(env, act, distribution, 50)
    traced = scalarized.trace(program.while_running(function), *examples, unrolled=25)
    written = scalarized.build(*traced, program.BRANCH_COST, program.SCANS)
    return kernels.kernel_text(written, len(jax.tree.leaves(actor)))


def test_a_division_that_llvm_spells_otherwise_is_not_left():
    """That of doubles is exact, as in XLA."""
    text = "div.rn.ftz.f32 %f1, %f2, %f3;\n\tdiv.rn.f64 %d1, %d2, %d3;"
    assert ptx._with_xla_divisions(text) == text.replace("div.rn.ftz", "div.full.ftz")
    with pytest.raises(AssertionError, match="another name"):
        ptx._with_xla_divisions("div.rn.f32 %f1, %f2, %f3;")


@pytest.mark.parametrize("long", [False, True])
def test_ptx(busy, long, tmp_path, monkeypatch):
    """It is one kernel that calls nothing; NVIDIA's assembler takes it, where there is one."""
    env, player = busy
    if long:
        monkeypatch.setattr(kernels, "LONG_BODY", 4)
    llvm = kernel_text(env, *player)

    def on_disk():
        pytest.fail("it is on disk")

    for capability in ("7.5", "9.0"):
        made = ptx.load_kernel(llvm.text, lambda: llvm, capability, tmp_path)
        assert (made.compiled, made.language) == (True, "ptx")
        threads, blocks = made.launch[:2]
        assert (threads, blocks) == ((256, 1) if long else (32, 16))
        assert f".maxntid {threads}" in made.text
        assert f".minnctapersm {blocks}" in made.text
        assert made.text.count(".entry play(") == 1
        assert f".target sm_{capability.replace('.', '')}" in made.text
        assert "call" not in made.text
        assert '.pragma "nounroll";' in made.text  # the assembler leaves our loops as they are
        meetings = re.findall(r"(bar.warp.sync 0xffffffff; )?bar(?:rier)?\.(?:sync|red)", made.text)
        assert meetings
        assert all(meetings)  # a warp comes together before each: an H200 waited forever without
        ptx._CACHE.clear()
        again = ptx.load_kernel(llvm.text, on_disk, capability, tmp_path)
        assert again == made._replace(compiled=False)
        if shutil.which("ptxas"):
            source = tmp_path / "play.ptx"
            source.write_text(made.text)
            architecture = f"-arch=sm_{capability.replace('.', '')}"
            subprocess.run(["ptxas", "-O0", architecture, source, "-o", "/dev/null"], check=True)


def test_a_gpu_that_llvm_does_not_know_is_refused():
    text = "define ptx_kernel void @play() { ret void }"
    assert ".target sm_90" in ptx._compile(text, "9.0")
    with pytest.raises(RuntimeError, match="does not know GPUs of compute capability 99"):
        ptx._compile(text, "99.0")


def test_what_no_kernel_computes_is_refused():
    with pytest.raises(scalar.UnsupportedPrimitive, match="cosh: no kernel"):
        ptx._compile("declare double @cosh(double)\n", "9.0")


def test_one_launch_for_all_seeds_in_loops(busy, monkeypatch):
    """Vmapped twice, in a scan, it is one custom call that writes over zeros."""
    env, (actor, act, distribution) = busy

    def one(key):
        return native.native_rollout(env, act, actor, distribution, key, num_episodes=8, horizon=50)

    def repeated(keys):
        def body(keys, _):
            seeds = jax.vmap(jax.vmap(one))(keys)
            return jax.vmap(jax.vmap(lambda k: jax.random.split(k)[0]))(keys), seeds.reward.sum()

        return jax.lax.scan(body, keys, length=3)

    text = gpu_on_cpu.lowered(monkeypatch, repeated, jax.random.split(jax.random.key(0), (2, 3)))
    calls = [line for line in text.splitlines() if "@mjx_reinforce_gpu_" in line]
    assert len(calls) == 1
    assert "tensor<6x50x2x8xf32>" in calls[0]
    assert calls[0].count("operand_index") == len(kernels.RESULTS)
    assert "blocks = 2 : i32" in calls[0]
    assert "threads = 32 : i32" in calls[0]


@pytest.mark.cpu
def test_it_says_why_there_are_no_kernels(monkeypatch):
    monkeypatch.setattr(seam, "compute_capability", lambda: "gfx90a")
    assert "this is 'gfx90a'" in (seam.kernels_unavailable() or "")
    monkeypatch.setattr(seam, "compute_capability", lambda: "9.0")
    with monkeypatch.context() as patch:
        patch.setattr("llvmlite.binding.llvm_version_info", (20, 1, 8))
        assert "llvmlite>=0.48" in (seam.kernels_unavailable() or "")
    with jax.enable_x64(True):
        assert "float32 alone" in (seam.kernels_unavailable() or "")
    assert "libcuda.so.1, is not found" in (seam.kernels_unavailable() or "")
    monkeypatch.setattr(available, "platform", lambda: "gpu")
    assert "libcuda.so.1, is not found" in (available.unavailable() or "")


def test_few_episodes_are_spread_over_all_multiprocessors(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: [type("GPU", (), {"core_count": 100})])
    assert seam._grid(1, 512, 2) == (1, 32)
    assert seam._grid(1_600, 512, 2) == (50, 32)
    assert seam._grid(6_400, 512, 2) == (100, 64)
    assert seam._grid(15_000, 512, 2) == (94, 160)
    assert seam._grid(51_200, 512, 2) == (100, 512)
    assert seam._grid(10**7, 512, 2) == (200, 512)
    assert seam._grid(10**7, 32, 16) == (1_600, 32)


# -------------------------------------------------------------------------------------------------
# The kernels that step environments on a GPU, run on this CPU.

SPACE = Box(np.array([-3.0]), np.array([1.0]))
TOY = Drifting(SPACE)


def play(env, steps=25, num=5, engine="native"):
    vec = make_vec(env, num, max_episode_steps=9, autoreset="same_step", engine=engine)
    reset, step = jax.jit(vec.reset), jax.jit(vec.step)
    state, found = reset(jax.random.key(0)), []
    for t in range(steps):
        state = step(state, vec.sample_actions(jax.random.key(t)))
        found.append(jax.tree.map(np.asarray, state))
    return jax.tree.map(lambda *x: np.stack(x), *found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "threads"),
    [(TOY, 8), ("InvertedPendulum-v5", 3), ("CartPole-v1", 1)],
    ids=["toy", "pendulum", "cart"],
)
def test_the_same_steps_as_on_a_cpu(monkeypatch, env, threads):
    """Also where threads have several environments each, or none."""
    want = play(env)
    gpu_on_cpu.emulate(monkeypatch, threads)
    got = play(env)
    assert np.any(got.truncated)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=2e-5, atol=2e-5)


def test_mapped_over_it_remains_one_launch(monkeypatch):
    gpu_on_cpu.emulate(monkeypatch, 2)
    vec = make_vec(TOY, 4, engine="native")
    keys = jax.random.split(jax.random.key(3), 2)
    both = jax.jit(jax.vmap(vec.reset))(keys)
    after = jax.jit(jax.vmap(vec.step))(both, jnp.ones((2, 4, 1)))
    one = jax.jit(vec.step)(jax.tree.map(lambda x: x[1], both), jnp.ones((4, 1)))
    np.testing.assert_array_equal(after.obs[1], one.obs)
    text = str(jax.make_jaxpr(jax.vmap(vec.step))(both, jnp.ones((2, 4, 1))))
    assert text.count("pure_callback[") == 1


def test_machine_code_for_a_gpu_is_chosen(monkeypatch):
    gpu_on_cpu.emulate(monkeypatch)
    assert make_vec(TOY, 4).engine.name == "native"

"""Programs of runs on disk: a second start traces nothing, and gives the same numbers."""

import contextlib
import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from one_slot import compile_run
from toys import Survive

from mjx_reinforce import envs
from mjx_reinforce.console import jax_setup
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.engine import cache, objects
from mjx_reinforce.engine.cpu import machine, seam
from mjx_reinforce.engine.gpu import cubin
from mjx_reinforce.engine.gpu import seam as gpu
from mjx_reinforce.engine.gpu.source import Launch
from mjx_reinforce.runs import compile_times
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup import ready

CONFIG = Config(env="CartPole-v1", num_seeds=2, num_episodes=4, env_steps=4000, eval_episodes=2)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A folder with the programs of ``CONFIG``, and the numbers that they compute."""
    made = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objects, "folder", lambda: made)
        patch.setattr(machine, "_CACHE", {})  # as in a process that has loaded nothing
        return made, numbers(ready.load_or_build_ready(CONFIG, CONFIG), CONFIG)


@pytest.fixture
def expected(filled, folder):
    """The numbers; the test's own folder has the programs."""
    shutil.copytree(filled[0], folder, dirs_exist_ok=True, copy_function=shutil.copy2)
    return filled[1]


def numbers(prepared, config):
    """Everything that two blocks of updates, an evaluation and a test leave.

    How much was simulated is left out: threads share the episodes, whichever is first.
    """
    slots, measured = compile_run(prepared.programs(), config), []
    for _ in range(2):
        [(_, metrics, eval_metrics)] = slots.advance()
        measured += [metrics, eval_metrics, slots.evaluate().eval_metrics]
    state = slots.states().train_states
    leaves = [jax.random.key_data(state.key), state.env_steps, *jax.tree.leaves(state.actor)]
    measured.append(slots.test(state.actor))
    for each in measured:
        del each["simulated_steps"]
    return [measured, leaves]


@pytest.mark.slow
def test_a_second_start_traces_nothing_and_gives_the_same(monkeypatch):
    settings = {"estimator": "value-baseline", "optimizer": "sgd", "decay_steps": None}
    config = dataclasses.replace(CONFIG, **settings)
    plain = ready.build_ready(envs.make(config.env), config)
    first = ready.load_or_build_ready(config, config)
    expected = numbers(first, config)
    with monkeypatch.context() as patch:
        patch.setattr(envs, "make", lambda *_: pytest.fail("the environment was built"))
        second = ready.load_or_build_ready(config, config)
        assert jax.tree.structure(second.programs().like) == jax.tree.structure(
            plain.programs().like
        )
        shapes = [
            [(x.shape, x.dtype) for x in jax.tree.leaves(y.programs().like)]
            for y in (second, plain)
        ]
        assert shapes[0] == shapes[1]
        for prepared in (first, second):
            assert prepared[:5] == plain[:5]
        jax.tree.map(np.testing.assert_array_equal, numbers(second, config), expected)
    jax.tree.map(np.testing.assert_array_equal, numbers(plain, config), expected)


def test_seeds_and_budgets_are_inputs_and_all_else_is_not():
    key = ready.key_of(CONFIG)
    for change in ({"seed": 7}, {"env_steps": 999}, {"log": ("wandb",)}):
        assert ready.key_of(dataclasses.replace(CONFIG, **change)) == key
    changes = ({"num_seeds": 3}, {"discount": 0.5}, {"horizon": 9}, {"eval_every": 2})
    others = [ready.key_of(dataclasses.replace(CONFIG, **change)) for change in changes]
    assert len({key, *others}) == 1 + len(changes)


def test_programs_depend_on_sources_versions_the_machine_and_its_devices(monkeypatch):
    key, another = ready.key_of(CONFIG), {"git_commit": "", "python": "another"}
    for owner, name, value in (
        *((objects, "source_digest", another), (ready, "provenance", another)),
        *((cache, "made_for", another), (ready, "version", another), (jax, "device_count", 8)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, lambda *_, value=value: value)
            assert ready.key_of(CONFIG) != key, name


def test_programs_depend_on_what_jax_is_told(monkeypatch):
    keys = {ready.key_of(CONFIG)}
    with jax.default_matmul_precision("float32"):
        keys.add(ready.key_of(CONFIG))
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    keys.add(ready.key_of(CONFIG))
    monkeypatch.setattr(cache, "platform", lambda: "tpu")
    keys.add(ready.key_of(CONFIG))
    assert len(keys) == 4
    assert None in keys


def test_a_program_that_launches_a_gpus_kernel_is_kept(monkeypatch):
    kernel = cubin.Kernel("0" * 64, "", Launch(threads=1, blocks=1), compiled=True)
    monkeypatch.setattr(cubin, "_CACHE", {kernel.key: kernel})
    monkeypatch.setattr(gpu, "_handler", lambda kernel: gpu._target(kernel.key))

    def add(x):
        return gpu._call(kernel, (1, 1), [jnp.ones(1, jnp.int32), x], [x], {1: 0})

    place = cache.Cache.find()
    place.keep("key", add, (jax.ShapeDtypeStruct((1,), np.int32),))
    assert gpu._target(kernel.key).encode() in place.read("key")


def test_a_program_whose_kernel_is_gone_is_not_read():
    name = gpu._target("0" * 64).encode()
    for each in ("facts", *ready._PROGRAM_NAMES):
        cache.Cache.find().write(f"key-{each}", name if each == "advance" else b"{}")
    assert ready.load_ready("key") is None


def test_a_commit_that_changes_no_source_changes_nothing(monkeypatch):
    made_by, key = ready.provenance(), ready.key_of(CONFIG)
    monkeypatch.setattr(ready, "provenance", lambda: made_by | {"git_commit": "0123"})
    assert ready.key_of(CONFIG) == key


@pytest.mark.slow
def test_resumed_runs_and_other_seeds_find_their_programs(expected, monkeypatch):
    """A config.json has the time limit, which the command line had left out."""
    monkeypatch.setattr(envs, "make", lambda *_: pytest.fail("the environment was built"))
    resumed = dataclasses.replace(CONFIG, horizon=500, resume=Path("run"), env_steps=999)
    assert ready.load_or_build_ready(resumed, CONFIG).horizon == 500
    with pytest.raises(pytest.fail.Exception, match="was built"):
        ready.load_or_build_ready(dataclasses.replace(resumed, horizon=400), CONFIG)
    other = dataclasses.replace(CONFIG, seed=1)
    found = numbers(ready.load_or_build_ready(other, other), other)
    assert not np.array_equal(found[1][0], expected[1][0])


@pytest.mark.slow
@pytest.mark.cpu
def test_what_is_damaged_is_made_again(expected, folder, monkeypatch):
    whole = {path: path.read_bytes() for path in folder.iterdir()}
    for name in ("facts", "advance", ""):  # the last is the machine code
        monkeypatch.setattr(machine, "_CACHE", {})
        for path, content in whole.items():
            path.write_bytes(content)
        assert ready.load_ready(ready.key_of(CONFIG)) is not None
        monkeypatch.setattr(machine, "_CACHE", {})
        (path,) = (path for path in whole if path.stem.partition("-")[2] == name)
        path.write_bytes(whole[path][:-1])
        assert ready.load_ready(ready.key_of(CONFIG)) is None, name
    again = numbers(ready.load_or_build_ready(CONFIG, CONFIG), CONFIG)
    jax.tree.map(np.testing.assert_array_equal, again, expected)
    assert ready.load_ready(ready.key_of(CONFIG)) is not None


@pytest.mark.slow
def test_bad_input_is_refused_of_what_is_kept_too(expected):
    idle = dataclasses.replace(CONFIG, initial_std=2.0)
    with pytest.raises(ValueError, match=r"--initial-std 2\.0 would do nothing"):
        ready.load_or_build_ready(idle, CONFIG)


@pytest.mark.slow
def test_programs_need_no_code_of_others(folder, monkeypatch):
    """A process that plays other tasks has their code in memory too."""
    own = seam.targets
    monkeypatch.setattr(seam, "targets", lambda: [*own(), "mjx_reinforce_" + 64 * "0"])
    prepared = ready.load_or_build_ready(CONFIG, CONFIG)
    compile_run(prepared.programs(), CONFIG)
    assert ready.load_ready(ready.key_of(CONFIG)) is not None


def test_nothing_is_kept_of_code_of_the_users_or_where_kernels_are_looked_at(monkeypatch):
    assert ready.key_of(CONFIG) is not None
    for name in ("Survive-v0", "toys:Survive"):
        assert ready.key_of(Config(env=name)) is None
    for looks in ("jax_debug_nans", "jax_debug_infs"):
        jax.config.update(looks, True)
        try:
            assert ready.key_of(CONFIG) is None
        finally:
            jax.config.update(looks, False)
    for owner, name, value in (
        (objects, "is_described", lambda: True),
        (objects, "folder", lambda: None),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            assert ready.key_of(CONFIG) is None


@contextlib.contextmanager
def cache_of_jax(folder):
    """Lets JAX keep programs in a folder, as the commands do."""
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        compilation_cache.reset_cache()
        configure_jax()
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        compilation_cache.reset_cache()


def compile_and_run():
    def shifted_sine(x):
        return jnp.sin(x) + 2

    return float(jax.jit(shifted_sine)(1.0))


def test_a_cache_of_jax_in_which_others_may_write_is_not_used(tmp_path, capsys):
    """What is in it is run."""
    cache = tmp_path / "cache"
    cache.mkdir()
    cache.chmod(0o777)
    with cache_of_jax(cache):
        compile_and_run()
        assert jax.config.values["jax_compilation_cache_dir"] is None
    (said,) = capsys.readouterr().err.splitlines()
    assert f"the cache {cache} is not used (others may write to {cache})" in said
    assert said.endswith("set JAX_COMPILATION_CACHE_DIR to a folder of your own")
    assert not list(cache.iterdir())


def test_a_cache_of_jax_that_does_not_work_is_named_once(tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    with cache_of_jax(file):
        assert compile_and_run() == compile_and_run()
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith(f"warning: the cache {file} is not used (FileExistsError")


def test_a_cache_of_jax_that_can_only_be_read_is_used_and_named(tmp_path, capsys, monkeypatch):
    """The programs that are there serve; nothing says else that no other is kept."""
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK and access(path, mode))
    jax_setup.warn.cache_clear()
    with cache_of_jax(tmp_path):
        assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path)
    (said,) = capsys.readouterr().err.splitlines()
    assert f"nothing can be kept in the cache {tmp_path} (it cannot be written), so the" in said


def test_how_long_compiling_takes_is_said_before(folder, monkeypatch):
    """At first in general, then as it was with these settings, on any seed and budget."""
    first = compile_times.describe_compiling(CONFIG)
    assert first.startswith("compiling, usually 5 to 40 s on a quiet machine, less where")
    compile_times.keep_seconds(CONFIG, (), 12.4)
    other = dataclasses.replace(CONFIG, seed=3, env_steps=10**12)
    assert compile_times.describe_compiling(other) == "compiling, about 12 s the last time"
    larger = dataclasses.replace(CONFIG, hidden_sizes=(999,))
    for config, swept in ((larger, ()), (CONFIG, ("discount",))):
        assert compile_times.describe_compiling(config, swept) == first
    monkeypatch.setattr(objects, "folder", lambda: None)
    assert "nothing is kept here, so the next start compiles again" in (
        compile_times.describe_compiling(CONFIG)
    )


def test_a_program_that_calls_python_is_not_kept(folder):
    def calls_python():
        return jax.pure_callback(lambda: np.float32(3), jax.ShapeDtypeStruct((), "f4"))

    program = cache.Cache.find().keep("key", calls_python, ())
    assert float(jax.jit(program)()) == 3
    assert not list(folder.iterdir())


def test_a_tree_of_other_classes_is_neither_described_nor_rebuilt():
    with pytest.raises(TypeError, match="another package"):
        ready.describe_tree({"a": Survive().reset(jax.random.key(0))})
    with pytest.raises(TypeError, match="a leaf of"):
        ready.describe_tree([3])
    assert ready.rebuild(ready.describe_tree((optax.EmptyState(), None))) == (
        optax.EmptyState(),
        None,
    )
    with pytest.raises(ValueError, match="another package"):
        ready.rebuild({"class": "subprocess:Popen", "fields": {"args": {"dict": {}}}})


_SECOND = """
import jax, numpy, sys
from mjx_reinforce import envs
from mjx_reinforce.setup import ready
from mjx_reinforce.settings.config import Config
from mjx_reinforce.console.jax_setup import configure_jax
from mjx_reinforce.training.slots import Slots, compile_slots
configure_jax()
if sys.argv[1] == "second":
    envs.make = None
config = Config(env="InvertedPendulum-v5", num_seeds=2, num_episodes=2, eval_episodes=2)
prepared = ready.load_or_build_ready(config, config)
slots = Slots(compile_slots(prepared.programs(), config, 2), numpy.arange(2))
[(_, metrics, eval_metrics)] = slots.advance()
print(prepared.engine, metrics["episode_return"].tolist(), eval_metrics["eval_return"])
print("mujoco" in sys.modules)
"""


@pytest.mark.slow
def test_a_second_process_loads_the_machine_code_and_no_simulator(tmp_path):
    def run(which):
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", _SECOND, which],
            check=True,
            capture_output=True,
            text=True,
            env=environment,
        )
        return done.stdout.splitlines()

    first, second = run("first"), run("second")
    assert first[0].startswith("native")
    assert second[0] == first[0]
    assert (first[1], second[1]) == ("True", "False")

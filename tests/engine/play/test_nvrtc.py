"""NVIDIA's compiler takes every kind of kernel; it needs no GPU."""

from typing import Any

import gpu_on_cpu
import jax
import jax.numpy as jnp
import mujoco
import pytest
from players import actor_and_act

from experiments.speed.benchmark.robots import EllipticQuadruped
from mjx_reinforce import envs
from mjx_reinforce.engine.gpu import cubin, nvrtc
from mjx_reinforce.engine.gpu.loops import ENTRY
from mjx_reinforce.engine.play import native, teams
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.tasks.humanoids import Humanoid

_C: Any = mujoco  # a C extension without stubs
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(nvrtc.library() is None, reason=nvrtc.version()),
]


class RandomHumanoid(Humanoid):
    """Masses and friction differ from episode to episode, so that states of teams are larger."""

    def randomize(self, rng):
        scale = jax.random.uniform(rng, minval=0.8, maxval=1.2)
        fields = ("body_mass", "geom_friction")
        return {name: scale * jnp.asarray(getattr(self.mj_model, name)) for name in fields}


class AntOnTray(MujocoEnv):
    """The floor of the ant is a tray, elsewhere in each episode."""

    def __init__(self):
        spec = models.spec("ant.xml")
        tray = spec.worldbody.add_body(name="tray", mocap=True)
        tray.add_geom(type=_C.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
        super().__init__(xml_file=spec, frame_skip=5, max_episode_steps=20, reward_threshold=None)

    def initial(self, rng):
        return {"mocap_pos": 0.1 * jax.random.normal(rng, (1, 3))}

    def outcome(self, before, data, action):
        return data.body("tray").xpos[2] - data.mocap_pos[0, 2], False, {}


@pytest.fixture
def sources(monkeypatch):
    """Returns a list of the kernels that are written from now on, as for a GPU; none runs."""
    written = []

    def load(key, write, capability, folder):
        written.append(write())
        return cubin.Kernel(key, written[-1].text, written[-1].launch, compiled=True)

    gpu_on_cpu.emulate(monkeypatch)
    monkeypatch.setattr(teams, "_shared_memory", lambda: 232_448)  # of an H100
    monkeypatch.setattr(cubin, "load_kernel", load)

    def write(env):
        actor, act, distribution = actor_and_act(env, (5,))

        def play(actor, key):
            options = {"num_episodes": 5, "horizon": 20}
            return native.native_rollout(env, act, actor, distribution, key, **options)

        jax.eval_shape(play, actor, jax.random.key(0))

    return write, written


@pytest.mark.parametrize(
    ("make_env", "lanes"),
    [
        pytest.param(lambda: envs.make("Hopper-v5"), 1, id="a thread an episode"),
        pytest.param(lambda: envs.make("Ant-v5"), 16, id="16 lanes"),
        pytest.param(AntOnTray, 16, id="16 lanes, a mocap body"),
        pytest.param(EllipticQuadruped, 32, id="32 lanes, cones"),
        pytest.param(RandomHumanoid, 32, id="32 lanes, random models"),
    ],
)
def test_kernels_compile_for_few_and_for_many_episodes(sources, make_env, lanes):
    """What they assert of shared memory holds, and each has its entry.

    Of models of episodes' own, for many alone: it takes most memory, and the rest is as of others.
    """
    write, written = sources
    write(make_env())
    assert written
    for source in written:
        launch = source.launch
        assert launch.lanes == lanes
        sizes = {launch.most_threads or launch.threads}
        if make_env is not RandomHumanoid:
            sizes.add(launch.threads)
        for threads in sizes:
            sized = source._replace(launch=launch._replace(threads=threads))
            _, code = nvrtc.compile("9.0", sized.for_compiler())
            assert ENTRY.encode() in code

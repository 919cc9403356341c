"""Models that are objects, parts by their names, and what differs from episode to episode."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_reinforce import make_vec, mlp_policy, normal, playing, reinforce, rollout
from mjx_reinforce.engine.episode import episode_keys
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco
from mjx_reinforce.envs.refusals import UnsupportedError
from mjx_reinforce.export.policy_files import Player
from mjx_reinforce.learning import normalize
from mjx_reinforce.learning.policy import Actor

SOURCE = """
<mujoco><option timestep="0.01"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body name="box" pos="0 0 0.1"><joint name="x" type="slide" axis="1 0 0"/>
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom name="ball" type="sphere" size="0.1" mass="1"/><site name="tip" pos="0.1 0 0"/>
    <body name="flag" pos="0 0 0.2"><joint name="turn" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.02 0.1" mass="0.1"/></body></body></worldbody>
  <actuator><motor name="push" joint="x" gear="60"/></actuator>
  <sensor><jointpos name="where" joint="x"/><jointvel name="speed" joint="turn"/></sensor>
</mujoco>"""
SPEC = mujoco.MjSpec.from_string(SOURCE)  # pyright: ignore[reportAttributeAccessIssue]
MODEL = SPEC.compile()


class Box(MujocoEnv):
    """Push a box to a goal."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Box."""

        frame_skip: int = 2
        max_episode_steps: int = 20
        reward_threshold: float | None = None

    def initial(self, rng):
        """Begins near the middle."""
        qpos = 0.05 * jax.random.normal(rng, (self.mj_model.nq,)).at[1].set(0.0)
        return qpos, jnp.zeros(self.mj_model.nv)

    def outcome(self, before, data, action):
        """Rewards what moves."""
        moved = data.site("tip").xpos[0] - before.joint("x").qpos[0]
        return moved, False, {}


class Reach(Box):
    """The goal, the command, the friction, the mass, the damping and the gear are drawn."""

    def randomize(self, rng):
        """Draws one of each kind."""
        keys = jax.random.split(rng, 4)
        friction = self.model.geom_friction * jax.random.uniform(keys[1], (), minval=0.1)
        return {
            "goal": jax.random.uniform(keys[0], (), minval=-1.0),
            "command": jax.random.randint(keys[2], (), 0, 3),
            "geom_friction": friction,
            "body_mass": self.model.body_mass * (1 + jax.random.uniform(keys[3], ())),
            "dof_damping": self.model.dof_damping * 3,
            "actuator_gear": self.model.actuator_gear * 0.5,
        }

    def observe(self, data):
        """Shows goal and command."""
        own = jnp.stack([data.episode["goal"], data.episode["command"].astype(float)])
        return jnp.concatenate([data.qpos, data.qvel, own])

    def outcome(self, before, data, action):
        """Costs the distance; the goal is that of the whole episode."""
        away = data.body("box").xpos[0] - data.episode["goal"]
        return -jnp.abs(away) + 0 * before.episode["goal"], jnp.abs(away) > 3, {}


def test_a_model_may_be_a_file_a_spec_or_a_model(tmp_path):
    path = tmp_path / "box.xml"
    path.write_text(SOURCE)
    seen = []
    for source in (str(path), SPEC, MODEL):
        env = Box(xml_file=source)
        assert env.mj_model is not MODEL
        assert env.mj_model.nq == 3
        seen.append(np.concatenate([env.mj_model.body_mass, env.mj_model.geom_size.ravel()]))
        if source is not MODEL:
            assert models.spec(env.settings.xml_file).compile().nq == 3
    np.testing.assert_array_equal(seen[0], seen[2])
    np.testing.assert_array_equal(seen[1], seen[2])


@pytest.fixture(scope="module")
def reach():
    """The environment, and its compiled reset and step."""
    env = Reach(xml_file=SPEC)
    return env, jax.jit(env.reset), jax.jit(env.step)


def test_what_is_no_model_is_refused():
    with pytest.raises(ValueError, match="xml_file of Box must be text or MjSpec or MjModel"):
        Box(xml_file=3)
    read = mujoco.MjSpec.from_string  # pyright: ignore[reportAttributeAccessIssue]
    for named, what in (("", "the model"), (' model="arm"', "the model 'arm'")):
        for other in (read(f"<mujoco{named}/>"), read(f"<mujoco{named}/>").compile()):
            with pytest.raises(ValueError, match=f"{what}: it has no actuators; add"):
                Box(xml_file=other)


@pytest.mark.slow
def test_parts_are_those_of_mujoco_by_their_names():
    """Every part that MuJoCo's Python has, after a step, in its numbers."""
    read = {
        "body": ("box", ("xpos", "xquat", "xipos", "cvel")),
        "geom": ("ball", ("xpos",)),
        "site": ("tip", ("xpos",)),
        "joint": ("turn", ("qpos", "qvel", "xaxis", "xanchor")),
        "actuator": ("push", ("ctrl", "force", "length", "velocity")),
        "sensor": ("speed", ("data",)),
    }

    class Shown(Box):
        """Observes all of them."""

        def observe(self, data):
            """Returns them one after the other."""
            parts = [getattr(data, kind)(name) for kind, (name, _) in read.items()]
            pairs = zip(parts, (fields for _, fields in read.values()), strict=True)
            return jnp.concatenate(
                [jnp.ravel(getattr(part, field)) for part, fields in pairs for field in fields]
            )

    env = Shown(xml_file=SPEC)
    observed = jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(1)), jnp.ones(1)).obs
    peer = InMujoco(env)
    peer.reset(jax.random.key(1))
    np.testing.assert_allclose(peer.step(np.ones(1))[0], observed, rtol=1e-4, atol=1e-4)
    theirs = [
        np.ravel(getattr(getattr(peer.data, kind)(name), field))
        for kind, (name, fields) in read.items()
        for field in fields
    ]
    np.testing.assert_allclose(np.concatenate(theirs), observed, rtol=1e-4, atol=1e-4)


def test_an_unknown_name_says_which_are_known():
    class Wrong(Box):
        """Reads a site that is not there."""

        def observe(self, data):
            """Misspells it."""
            return data.site("tipp").xpos

    with pytest.raises(ValueError, match=r"unknown site 'tipp'. Did you mean 'tip'.*Known: tip"):
        jax.eval_shape(Wrong(xml_file=SPEC).reset, jax.random.key(0))


@pytest.mark.slow
def test_an_episode_keeps_what_was_drawn(reach):
    _, reset, step = reach
    states = [reset(jax.random.key(i)) for i in range(2)]
    drawn = [jax.device_get(state.pipeline_state.episode) for state in states]
    assert drawn[0]["goal"] != drawn[1]["goal"]
    state = states[0]
    for _ in range(3):
        state = step(state, jnp.ones(1))
        goal, command = state.obs[-2:]
        assert (goal, command) == (drawn[0]["goal"], drawn[0]["command"])
        away = state.pipeline_state.qpos[0] - goal
        np.testing.assert_allclose(state.reward, -abs(away), atol=0.05)


@pytest.mark.slow
def test_fields_of_the_model_are_those_of_mujoco_with_the_same_fields(reach):
    """With the model's own friction, mass and gear the box would be elsewhere."""
    env, *compiled = reach

    class Plain(Reach):
        """Replaces no field."""

        def randomize(self, rng):
            """Draws what is no field."""
            drawn = super().randomize(rng)
            return {name: x for name, x in drawn.items() if name not in models.RANDOM}

    plain = Plain(xml_file=SPEC)
    peer, key = InMujoco(env), jax.random.key(4)
    observed = {}
    for one, reset, step in ((env, *compiled), (plain, jax.jit(plain.reset), jax.jit(plain.step))):
        state = reset(key)
        for _ in range(10):
            state = step(state, jnp.ones(1))
        observed[one] = state.obs
    peer.reset(key)
    for _ in range(10):
        last = peer.step(np.ones(1))
    np.testing.assert_allclose(last[0], observed[env], rtol=2e-3, atol=2e-3)
    assert np.abs(observed[plain] - observed[env]).max() > 0.05


@pytest.mark.slow
def test_machine_code_plays_what_was_drawn(reach):
    """As ``step`` does: with other goals, frictions and masses the episodes would differ."""
    env, reset, step = reach
    policy = mlp_policy(env.observation_size, normal(env.action_space), ())
    learner = reinforce(env, policy=policy, num_episodes=4, horizon=8, engine="native")
    key, start = jax.random.key(2), learner.init(jax.random.key(0))
    played = jax.jit(learner.play)(start, key)
    for n, own in enumerate(episode_keys(key, 4)):
        state = reset(jax.random.split(own)[0])
        for seen, action, reward in zip(
            *(x[:, n] for x in (played.observation, played.action, played.reward)), strict=True
        ):
            np.testing.assert_allclose(seen, state.obs, rtol=2e-3, atol=2e-3)
            state = step(state, action)
            np.testing.assert_allclose(reward, state.reward, rtol=2e-3, atol=2e-3)
    assert len(set(np.asarray(played.observation[0, :, -2]).tolist())) == 4


FREE = """<mujoco><worldbody><body name="cube" pos="0 0 2" {}><freejoint/>{}
  <geom size=".1" mass="1"/></body>
  <body name="arm" pos="1 0 1"><joint name="h" axis="0 1 0"/>
    <geom size=".05" pos=".1 0 0" mass="1"/></body>
  <body name="top" pos="2 0 1"><joint axis="0 1 0"/><geom size=".05" mass="1"/></body>
  </worldbody><actuator><motor joint="h"/></actuator></mujoco>"""


class Shifted(Box):
    """The center of mass of a body is drawn, and what it weighs."""

    body, mass = 1, 1.0

    def randomize(self, rng):
        """Moves it by 3 cm, in each draw."""
        return {
            "body_ipos": self.model.body_ipos.at[self.body, 0].add(0.03),
            "body_mass": self.model.body_mass.at[self.body].set(self.mass),
        }

    def initial(self, rng):
        """Spins."""
        return jnp.asarray(self.mj_model.qpos0), jnp.arange(1.0, 1.0 + self.mj_model.nv)

    def observe(self, data):
        """Shows where all is, and the centers of mass."""
        return jnp.concatenate([data.qpos, data.qvel, data.subtree_com.ravel()])

    def outcome(self, before, data, action):
        """Earns nothing."""
        return 0.0, False, {}


def test_a_random_center_of_mass_needs_a_body_that_is_not_simple():
    """C MuJoCo asks for the same, of a hinge too. Of others the task may stay as it is."""
    read = mujoco.MjModel.from_xml_string  # pyright: ignore[reportAttributeAccessIssue]
    refused = r"center of mass of a body .* \(cube\); write <body simple=\"false\">"
    with pytest.raises(UnsupportedError, match=refused):
        jax.eval_shape(Shifted(xml_file=read(FREE.format("", ""))).reset, jax.random.key(0))
    Top = type("Top", (Shifted,), {"body": 3})  # noqa: N806
    with pytest.raises(UnsupportedError, match=r"\(top\)"):
        jax.eval_shape(Top(xml_file=read(FREE.format("", ""))).reset, jax.random.key(0))
    model = read(FREE.format("", ""))
    model.body_ipos[3, 0] += 0.03
    with pytest.raises(Exception, match="simple='false'"):
        mujoco.mj_setConst(model, mujoco.MjData(model))  # pyright: ignore
    Arm = type("Arm", (Shifted,), {"body": 2})  # noqa: N806
    jax.eval_shape(Arm(xml_file=read(FREE.format("", ""))).reset, jax.random.key(0))


@pytest.mark.slow
def test_a_random_center_of_mass_is_that_of_the_compiled_model():
    """Here, and in C MuJoCo, which keeps which frames were the same when it compiled."""
    read = mujoco.MjModel.from_xml_string  # pyright: ignore[reportAttributeAccessIssue]
    there = '<inertial pos=".03 0 0" mass="1.5" diaginertia=".004 .004 .004"/>'
    model = read(FREE.format("", there))
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qvel[:] = np.arange(1.0, 1.0 + model.nv)
    with jax.enable_x64(True):
        Heavy = type("Heavy", (Shifted,), {"mass": 1.5})  # noqa: N806
        env = Heavy(xml_file=read(FREE.format('simple="false"', "")))
        peer, state, step = InMujoco(env), env.reset(jax.random.key(0)), jax.jit(env.step)
        peer.reset(jax.random.key(0))
        for _ in range(5):
            mujoco.mj_step(model, data, 2)  # pyright: ignore[reportAttributeAccessIssue]
            state = step(state, jnp.zeros(1))
            seen = peer.step(np.zeros(1))[0]
        theirs = np.concatenate([data.qpos, data.qvel, data.subtree_com.ravel()])
    np.testing.assert_allclose(state.obs, theirs, atol=1e-9)
    np.testing.assert_allclose(seen, theirs, atol=1e-9)


@pytest.mark.parametrize(
    ("drawn", "said"),
    [
        (3, "randomize must return a dict of quantities by their names, got the shape"),
        ({"goal": "far"}, "'goal' of Drawn.randomize must be an array, got 'far'"),
        ({"body_mass": jnp.ones(2)}, r"'body_mass' of Drawn.randomize must be \[3\]"),
        ({"jnt_limited": jnp.ones(3)}, "cannot replace jnt_limited.*it can replace body_mass"),
    ],
)
def test_what_is_no_quantity_is_refused(drawn, said):
    task = type("Drawn", (Box,), {"randomize": lambda self, rng: drawn})
    with pytest.raises(ValueError, match=said):
        jax.eval_shape(task(xml_file=SPEC).reset, jax.random.key(0))


# -------------------------------------------------------------------------------------------------
# Simulations that diverge and stay finite: where C MuJoCo resets, the episode is broken.

UNSTABLE = pytest.mark.filterwarnings("ignore:.*The simulation is unstable")
UNSTABLE_MODEL = """<mujoco><option timestep="0.01"/><worldbody>
    <body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.05"/></body></worldbody>
  <actuator><position joint="x" kp="{kp}" ctrlrange="-1 1"/></actuator></mujoco>"""
#: What leaves 1e10 first: the servo's stiffness, where it starts (m, m/s), and the physics step in
#: which C resets. It looks at positions and velocities when a step begins, ours when one ends.
CASES = {
    "qacc": (1e5, 0.01, 0.0, 7),
    "qvel": (2.0, -5e8, 9.95e9, 5),
    "qpos": (0.0, 9.81e9, 5e9, 5),
}


@pytest.fixture
def in_a_folder(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into a file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def still(env):
    """A policy whose mode is 0, and its parameters."""
    policy = mlp_policy(1, normal(env.action_space))
    return policy, jax.tree.map(jnp.zeros_like, policy.init(jax.random.key(0)))


class Slider(MujocoEnv):
    """Earns its speed, and shows nothing of what diverges."""

    def __init__(self, case="qacc", frame_skip=1):
        kp, *self.start, _ = CASES[case]
        super().__init__(
            xml_file=mujoco.MjModel.from_xml_string(UNSTABLE_MODEL.format(kp=kp)),  # pyright: ignore
            frame_skip=frame_skip,
            max_episode_steps=20,
            reward_threshold=None,
        )

    def initial(self, rng):
        return tuple(jnp.array([x]) for x in self.start)

    def observe(self, data):
        return data.time[None]

    def outcome(self, before, data, action):
        return jnp.abs(data.qvel[0]), False, {}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@UNSTABLE
def test_a_step_in_which_c_resets_earns_no_number(case, in_a_folder):
    """Nor does one that goes on after it."""
    last = CASES[case][-1]
    peer = InMujoco(Slider(case))
    peer.reset(jax.random.key(0))
    speeds = [peer.step(np.zeros(1))[1] for _ in range(last)]
    assert np.isfinite(speeds).tolist() == [True] * (last - 1) + [False]
    env, found = Slider(case, frame_skip=3), []
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for _ in range(-(-(last - (case != "qacc")) // 3)):
        state = step(state, jnp.zeros(1))
        found.append(state.reward)
    np.testing.assert_allclose(found, [*speeds[2::3][: len(found) - 1], np.nan], rtol=1e-4)


@pytest.mark.parametrize("engine", [pytest.param("vmap", marks=pytest.mark.slow), "native"])
@UNSTABLE
def test_every_engine_ends_the_episode(engine):
    env = Slider()
    policy, params = still(env)
    play = functools.partial(rollout, env, policy.apply, params, policy.distribution)
    options = {"num_episodes": 1, "horizon": 20, "engine": engine, "deterministic": True}
    episode = jax.jit(functools.partial(play, **options))(jax.random.key(0))
    assert episode.nonfinite.tolist() == [True]
    assert int(episode.mask.sum()) == CASES["qacc"][-1]
    assert 1e7 < episode.reward.max() < 1e8


@pytest.mark.slow
@UNSTABLE
def test_many_at_once_are_told():
    vec = make_vec(Slider(), 2)
    state, step = vec.reset(jax.random.key(0)), jax.jit(vec.step)
    for _ in range(CASES["qacc"][-1]):
        assert not np.any(state.nonfinite)
        state = step(state, jnp.array([[0.0], [0.01]]))  # the second stays where it is
    assert state.nonfinite.tolist() == state.terminated.tolist() == [True, False]
    assert state.reward[0] == 0


@UNSTABLE
def test_episodes_to_look_at_end_there():
    """In each simulation that ``watch`` knows."""
    env = Slider()
    policy, params = still(env)
    actor = Actor(params=params, normalizer=normalize.init(1))
    player = Player("Diverging-v0", 0, policy, actor)
    for simulator in (playing.simulator, playing.mujoco_simulator):
        episode = simulator(env, player, 20)(0, False)
        assert np.isnan(episode.rewards).tolist() == [False] * (len(episode.rewards) - 1) + [True]
        assert 4 < len(episode.rewards) == len(episode.qpos) < 10

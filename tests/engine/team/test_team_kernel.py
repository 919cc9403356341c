"""Kernels for teams of lanes, compiled with one lane for this CPU, beside its machine code."""

import itertools
import re
from functools import partial

import gpu_on_cpu
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from players import actor_and_act, only_active, played
from robot import Robot

from mjx_reinforce import envs, make_vec
from mjx_reinforce.engine.gpu import cubin, seam, team_kernel
from mjx_reinforce.engine.play import available, choice, native, program
from mjx_reinforce.engine.play import teams as team
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.envs import models
from mjx_reinforce.envs.base import MujocoEnv

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

LEG = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="leg" pos="0 0 .45">
      <joint type="slide" axis="0 0 1"/>
      <joint name="turn" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".05"/>
      <site name="foot" pos="0 0 -.4" euler="10 20 0" size=".06"/>
    </body>
  </worldbody>
  <actuator><motor joint="turn" gear="3"/></actuator>
  <sensor>
    <gyro site="foot"/><accelerometer site="foot"/><force site="foot"/><touch site="foot"/>
    <framequat objtype="site" objname="foot"/><velocimeter site="foot"/>
  </sensor>
</mujoco>"""


HAND = """
    <body name="hand" mocap="true" pos=".16 0 .2" euler="10 20 0">
      <geom size=".1"/><body pos="0 0 .02"><site name="goal" pos=".01 .02 .05" size=".2"/></body>
    </body>
  </worldbody>
  <tendon>
    <spatial stiffness="20" springlength=".1"><site site="goal"/><site site="foot"/></spatial>
  </tendon>
  <sensor>
    <touch site="goal"/><framepos objtype="site" objname="foot" reftype="site" refname="goal"/>
  </sensor>"""


class Leg(MujocoEnv):
    """It observes what its sensors show, in parts of what they show at most."""

    def initial(self, rng):
        return jnp.array([-0.01, 0.1]), 0.3 * jax.random.normal(rng, (2,))

    def observe(self, data):
        foot = data.site("foot")
        seen = [data.sensordata / (1 + jnp.abs(data.sensordata)), foot.xpos, foot.xmat.ravel()]
        return jnp.concatenate(seen)

    def outcome(self, before, data, action):
        return jnp.sin(data.sensordata[0]), False, {}


class StillLeg(Leg):
    """It begins as its model does, and observes its positions."""

    def initial(self, rng):
        return self.mj_model.qpos0, jnp.zeros(self.mj_model.nv)

    def observe(self, data):
        return data.qpos

    def outcome(self, before, data, action):
        return data.qpos[0], False, {}


class RandomLeg(Leg):
    """Its episodes have models of their own, which sensors show, too."""

    def randomize(self, rng):
        fields = {}
        for key, name in zip(jax.random.split(rng, len(models.RANDOM)), models.RANDOM, strict=True):
            field = jnp.asarray(getattr(self.mj_model, name))
            fields[name] = field * jax.random.uniform(key, field.shape, minval=0.5, maxval=2)
        fields["dof_damping"] = jnp.array([0.3, 0.01]) * jax.random.uniform(rng, (2,))
        return fields | {"body_ipos": jnp.asarray(self.mj_model.body_ipos)}

    def observe(self, data):
        return jnp.concatenate([super().observe(data), data.episode["body_mass"]])


class HeldLeg(MujocoEnv):
    """It hangs by a tendon from a mocap body that it hits, and observes where that is."""

    def initial(self, rng):
        qvel = 0.3 * jax.random.normal(rng, (2,))
        return {"qpos": jnp.array([-0.01, 0.1]), "qvel": qvel}

    def observe(self, data):
        goal = data.site("goal")
        seen = [data.qpos, jnp.tanh(data.qvel), jnp.tanh(data.sensordata), goal.xpos]
        return jnp.concatenate([*seen, goal.xmat.ravel(), data.body("hand").xpos])

    def outcome(self, before, data, action):
        return data.mocap_pos[0, 2] + before.mocap_quat[0, 1], False, {}


class MovedLeg(HeldLeg):
    """The mocap body is elsewhere in each episode."""

    def initial(self, rng):
        key, rng = jax.random.split(rng)
        noise = jax.random.normal(key, (7,))
        poses = {
            "mocap_pos": jnp.array([[0.16, 0, 0.2]]) + 0.03 * noise[:3],
            "mocap_quat": jnp.array([[2.0, 0, 0, 0]]) + 0.5 * noise[3:],
        }
        return super().initial(rng) | poses


class RememberingLeg(Leg):
    """It acts late, is pushed every second step, and sees the last action and noise."""

    def memory(self, rng, data):
        return {"action": jnp.zeros(1), "noise": jax.random.normal(rng, (2,)), "step": 0}

    def remember(self, rng, data, action):
        noise = jax.random.normal(rng, (2,))
        return {"action": action, "noise": noise, "step": data.memory["step"] + 1}

    def actuate(self, before, action):
        return before.memory["action"]

    def push(self, before):
        return jnp.where(before.memory["step"] % 2 == 1, 0.1, 0.0) * before.memory["noise"]

    def observe(self, data):
        memory = data.memory
        return jnp.concatenate([super().observe(data), memory["action"], memory["noise"]])


@pytest.fixture
def teams(monkeypatch):
    """Returns what lets teams play from now on; that returns the kernels that are made."""

    def emulate():
        gpu_on_cpu.emulate(monkeypatch)
        monkeypatch.setattr(team, "_LEAST_DOFS", 1)
        monkeypatch.setattr(team, "_shared_memory", lambda: 232_448)
        load = cubin.load_kernel
        monkeypatch.setattr(cubin, "load_kernel", lambda *x: made.append(load(*x)) or made[-1])
        return made

    made = []
    return emulate


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Hopper-v5", "Ant-v5"])
def test_teams_play_the_same_episodes(teams, name):
    """Of two seeds, some of which take the mode; two chunks of noise, ends, a limit."""
    env, horizon = envs.make(name), 4 if name == "Ant-v5" else 120
    player = actor_and_act(env, (5,))
    options = {"num_seeds": 2, "horizon": horizon, "deterministic": np.arange(5) % 2 == 1}
    want = played(native.native_rollout, env, player, **options)
    made = teams()
    got = played(native.native_rollout, env, player, **options)
    assert [kernel.launch.lanes for kernel in made] == [16, 16]  # one plays, one begins
    first = min(horizon, 12)  # steps until rounding has grown
    for name in ("observation", "action", "reward"):
        pair = (getattr(x, name)[:, :first] for x in (got, want))
        np.testing.assert_allclose(*pair, rtol=2e-3, atol=2e-3, err_msg=name)
    assert len(got.terms) > 2
    for name, term in got.terms.items():
        pair = (x[:, :first] for x in (term, want.terms[name]))
        np.testing.assert_allclose(*pair, rtol=2e-3, atol=2e-3, err_msg=name)
    assert np.abs(got.mask.sum(1) - want.mask.sum(1)).max() <= 3
    np.testing.assert_array_equal(got.simulated, got.mask.sum((1, 2)))


def leg(task, steps):
    """Returns a task on a leg."""
    spec = mujoco.MjSpec.from_string(LEG)
    return task(xml_file=spec, frame_skip=2, max_episode_steps=steps, reward_threshold=None)


def as_in_c_mujoco(teams, env):
    """Returns the episodes of a task that C MuJoCo plays; teams play the same."""
    actor, act, distribution = player = actor_and_act(env, (5,))
    policy = choice.ActingPolicy(act, actor, distribution)
    want = played(choice.choose("mujoco", env, policy, 30).rollout, env, player, num_seeds=2)
    made = teams()
    got = played(native.native_rollout, env, player, num_seeds=2)
    assert [kernel.launch.lanes for kernel in made] == [16, 16]
    for name in ("observation", "action", "reward"):
        pair = (getattr(x, name)[:, :20] for x in (got, want))
        np.testing.assert_allclose(*pair, rtol=2e-3, atol=2e-3, err_msg=name)
    return want


@pytest.mark.slow
def test_teams_show_sensors(teams):
    want = as_in_c_mujoco(teams, leg(Leg, 60))
    assert (want.observation[..., 9] > 0).any()  # touch


@pytest.mark.slow
def test_teams_play_models_that_differ_from_episode_to_episode(teams):
    env = leg(RandomLeg, 40)
    actor, act, distribution = actor_and_act(env, (5,))
    policy = choice.ActingPolicy(act, actor, distribution)
    in_c = choice.choose("mujoco", env, policy, 40)
    want = played(in_c.rollout, env, (actor, act, distribution), num_seeds=2)
    made = teams()
    engine = choice.choose("auto", env, policy, 40)
    assert (engine.name, engine.why.partition(", ")[2]) == ("native", "16 lanes an episode")
    got = played(engine.rollout, env, (actor, act, distribution), num_seeds=2)
    assert {kernel.launch.lanes for kernel in made} == {16}
    masses = want.observation[:, 0, :, -1].ravel()
    assert len(np.unique(masses)) == masses.size == 10  # the episodes of a kernel
    for name in ("observation", "reward"):
        pair = (getattr(x, name)[:, :20] for x in (got, want))
        np.testing.assert_allclose(*pair, rtol=2e-3, atol=2e-3, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("task", [HeldLeg, MovedLeg])
def test_teams_play_mocap_bodies(teams, task):
    spec = mujoco.MjSpec.from_string(LEG.replace("</worldbody>", HAND))
    env = task(xml_file=spec, frame_skip=2, max_episode_steps=30, reward_threshold=None)
    want = as_in_c_mujoco(teams, env)
    assert (want.observation[..., 10] > 0).any()  # the mocap body is touched
    heights = want.reward[:, 0].ravel()
    assert len(np.unique(heights)) == (heights.size if task is MovedLeg else 1)


@pytest.mark.slow
def test_teams_play_episodes_that_remember(teams):
    want = as_in_c_mujoco(teams, leg(RememberingLeg, 40))
    np.testing.assert_allclose(
        want.observation[:, 1:20, :, -3], want.action[:, :19, :, 0], atol=1e-6
    )
    noise = want.observation[:, :20, :, -1]
    assert len(np.unique(noise)) == noise.size  # of each seed, step and episode


@pytest.mark.slow
def test_teams_play_a_task_of_all_parts(teams):
    want = as_in_c_mujoco(teams, Robot(steps=20))
    commands = want.observation[:, 0, :, -1]
    assert len(np.unique(commands[commands != 0])) > 3


def kernels_are_written(monkeypatch):
    """Lets kernels be written, and not compiled; returns the list that their texts come into."""
    texts = []

    def load(key, write, capability, folder):
        source = write()
        texts.append(source.text)
        return cubin.Kernel(key, source.text, source.launch, compiled=True)

    gpu_on_cpu.emulate(monkeypatch)
    monkeypatch.setattr(team, "_shared_memory", lambda: 232_448)
    monkeypatch.setattr(cubin, "load_kernel", load)
    return texts


def kernels(monkeypatch, env):
    """Returns the texts of the kernels of teams that play an environment."""
    texts = kernels_are_written(monkeypatch)
    monkeypatch.setattr(team, "_LEAST_DOFS", 1)
    actor, act, distribution = actor_and_act(env, (5,))

    def play(actor, key):
        player = env, act, actor, distribution
        return native.native_rollout(*player, key, num_episodes=5, horizon=20)

    jax.eval_shape(play, actor, jax.random.key(0))
    return texts


@pytest.mark.slow
def test_what_an_episode_draws_of_its_model_is_drawn_where_it_begins(monkeypatch):
    text = kernels(monkeypatch, leg(RandomLeg, 40))[0]
    begin, step = text.split("t.meet(running)")
    assert begin.count("\ndraw(M, s, ") == 1
    assert "draw(M, s, " not in step


def test_lanes_play_few_episodes_and_threads_many(monkeypatch):
    """All seeds' episodes count, as one launch plays them; no kernel but theirs is compiled."""
    lanes, sized, call = [], seam._sized, seam._call
    kernels_are_written(monkeypatch)
    monkeypatch.setattr(team, "_FRICTIONAL_CONTACTS", 1)
    monkeypatch.setattr(seam, "_sized", sized)
    monkeypatch.setattr(seam, "_call", call)
    monkeypatch.setattr(seam, "_handler", lambda kernel: lanes.append(kernel.launch.lanes) or "it")
    env = leg(Leg, 40)
    actor, act, distribution = actor_and_act(env, ())

    def play(num_episodes, key):
        options = {"num_episodes": num_episodes, "horizon": 20}
        return native.native_rollout(env, act, actor, distribution, key, **options)

    keys = jax.random.split(jax.random.key(0))
    for num_episodes in (2_112, 2_113):
        function = jax.vmap(partial(play, num_episodes))
        text = gpu_on_cpu.lowered(monkeypatch, function, keys, fills=True)
        assert text.count("custom_call @it(") == 1
    assert lanes == [16, 1]


def cylinders(task):
    """Returns a task on a leg of cylinders, for which C MuJoCo would be the fastest but for teams.

    MJX finds no contacts of these geoms.
    """
    more = """
        <body pos=".3 0 .2">
          <joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
          <geom type="cylinder" size=".1 .1"/>
        </body>
      </worldbody>"""
    xml = LEG.replace('type="capsule"', 'type="cylinder"').replace("</worldbody>", more)
    spec = mujoco.MjSpec.from_string(xml)
    env = task(xml_file=spec, frame_skip=2, max_episode_steps=30, reward_threshold=None)
    assert env.best_in_c_mujoco
    return env


class CylinderLeg(Leg):
    """A leg beside something that falls."""

    def initial(self, rng):
        qpos, qvel = super().initial(rng)
        return jnp.append(qpos, jnp.zeros(2)), jnp.append(qvel, jnp.array([0.0, -0.1]))


def test_starts_that_show_positions_alone_are_those_of_teams(monkeypatch):
    env = cylinders(StillLeg)
    assert ["t.meet(" in text for text in kernels(monkeypatch, env)] == [True, True]


@pytest.mark.slow
def test_teams_show_sensors_of_models_that_mjx_refuses(teams):
    env = cylinders(CylinderLeg)
    want = as_in_c_mujoco(teams, env)
    assert (want.observation[..., 9] > 0).any()  # touch


def test_lanes_share_what_few_numbers_cost():
    """Three numbers of thirty operations are computed by three lanes, whatever they are for."""

    def parts(x):
        for _ in range(30):
            x = jnp.tanh(x)
        return jnp.stack([x[0], jnp.sin(x[1]), x[2] * x[0]])

    texts = []
    for function in (parts, lambda x: parts(x)[1:2]):
        traced = scalarized.trace(function, jnp.zeros(3))
        written = scalarized.build(*traced, program.BRANCH_COST, program.SCANS)
        physics = team_kernel.Physics("", far=0, skip=1, lanes=16, shared=0)
        texts.append(team_kernel.mapping_text(written, physics).text)
    assert [text.count("tanhf(") for text in texts] == [30, 30]


def own_network(layers, x):
    """A network as a user writes it: no operation of ours, and so no layer of the device code."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    return x @ layers[-1][0] + layers[-1][1]


@pytest.mark.parametrize("num_inputs", [3, 15])
def test_units_of_an_own_network_are_computed_once(num_inputs):
    """By the lanes together, however many units of the next layer read them."""
    sizes = (num_inputs, 16, 20, 2)
    layers = [(jnp.zeros(pair), jnp.zeros(pair[1])) for pair in itertools.pairwise(sizes)]
    traced = scalarized.trace(own_network, layers, jnp.zeros(num_inputs))
    written = scalarized.build(*traced, program.BRANCH_COST, program.SCANS)
    physics = team_kernel.Physics("", far=0, skip=1, lanes=16, shared=0)
    text = team_kernel.mapping_text(written, physics).text
    loops = re.findall(r"EACH\(i, (\d+)\) \{([^}]*)\}", text)
    calls = [int(rounds) * body.count("tanhf(") for rounds, body in loops if "tanhf(" in body]
    assert calls == [16, 20]
    assert text.count("tanhf(") == 2  # none is outside of these loops


def test_a_table_with_infinity_is_not_static():
    """NVRTC initializes static tables by literals alone, and C++ has none for infinity."""
    limits = np.array([0.7, np.inf, 100, 100, 100, 100], np.float32)
    function = scalarized.trace(lambda x: x + limits, jnp.zeros(6))
    written = scalarized.build(*function, program.BRANCH_COST, program.SCANS)
    physics = team_kernel.Physics("", far=0, skip=1, lanes=16, shared=0)
    text = team_kernel.mapping_text(written, physics).text
    assert "bits<float>" in text
    assert not re.search(r"static const float .*bits<float>", text)


@pytest.mark.slow
def test_teams_play_only_active_episodes(teams):
    env = envs.make("Hopper-v5")
    chosen = np.arange(15).reshape(3, 5) % 2 == 1
    made, player = teams(), actor_and_act(env, ())
    some = only_active(native.native_rollout, env, player, chosen, horizon=20).mask.any(1)
    assert (some.tolist(), {kernel.launch.lanes for kernel in made}) == (chosen.tolist(), {16})


@pytest.mark.slow
def test_teams_step_environments_side_by_side(teams):
    """Those whose episode is over begin another, in the same kernel."""
    action, found = np.ones((3, 3), np.float32), []
    for begins in (list, teams):  # on the CPU, then by teams
        made = begins()
        vec = make_vec("Hopper-v5", 3, engine="native", max_episode_steps=2)
        found.append(vec.reset(jax.random.key(0)))
        for _ in range(4):
            found[-1] = vec.step(found[-1], action)
    assert {kernel.launch.lanes for kernel in made} == {16}
    np.testing.assert_allclose(*[state.obs for state in found], rtol=2e-3, atol=2e-3)


class _Box(MujocoEnv):
    """A box that slides over the floor."""

    def __init__(self, flags):
        geom = '<geom type="box" size=".1 .08 .06"/>'
        xml = f"""
        <mujoco>
          <option cone="elliptic" timestep=".004">{flags}</option>
          <worldbody>
            <geom type="plane" size="5 5 .1"/>
            <body pos="0 0 .06">
              <joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
              <joint type="hinge" axis="0 1 0" stiffness="1"/>{geom}
            </body>
          </worldbody>
          <actuator><motor joint="x" gear="90"/></actuator>
        </mujoco>"""
        spec = mujoco.MjSpec.from_string(xml)
        super().__init__(xml_file=spec, frame_skip=2, max_episode_steps=30, reward_threshold=None)

    def initial(self, rng):
        return jnp.zeros(3), 0.3 * jax.random.normal(rng, (3,))

    def outcome(self, before, data, action):
        return data.qvel[0], False, {}


@pytest.mark.slow
@pytest.mark.parametrize("flags", ["", '<flag spring="disable"/>'])
def test_teams_play_what_c_mujoco_plays_on_a_cpu(teams, flags):
    """Elliptic cones, which MJX has, and a flag for which it refuses the model."""
    env = _Box(flags)
    actor, act, distribution = actor_and_act(env, (5,))
    policy = choice.ActingPolicy(act, actor, distribution)
    trajectories = []
    for begins, asked, name in ((list, "mujoco", "mujoco"), (teams, "auto", "native")):
        made = begins()
        engine = choice.choose(asked, env, policy, 30)
        assert engine.name == name
        trajectories.append(played(engine.rollout, env, (actor, act, distribution)))
    assert {kernel.launch.lanes for kernel in made} == {16}
    assert np.ptp(trajectories[0].observation[..., 0]) > 0.05
    for field in ("observation", "action", "reward"):
        pair = (getattr(x, field) for x in trajectories)
        np.testing.assert_allclose(*pair, rtol=2e-3, atol=2e-3, err_msg=field)


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_teams_play_small_models_that_no_thread_plays(cone):
    xml = LEG.replace("<mujoco>", f'<mujoco><option cone="{cone}"/>')
    model = mujoco.MjModel.from_xml_string(xml)
    env = Leg(xml_file=model, frame_skip=2, max_episode_steps=9, reward_threshold=None)
    reason = team.why_not(env)
    assert reason is None if cone == "elliptic" else "a thread plays" in str(reason)

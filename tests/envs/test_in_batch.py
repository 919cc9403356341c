"""Tasks whose physics C MuJoCo computes, many at once, beside one MjData stepped by itself."""

import resource
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco as mujoco_bindings
import numpy as np
import pytest

from mjx_reinforce import envs, make_vec, reinforce, train_step
from mjx_reinforce.engine.play import choice
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco import in_batch
from mjx_reinforce.settings.config import Config
from mjx_reinforce.setup.ready import build_ready

#: MuJoCo's own names; it is a C extension without stubs.
mujoco: Any = mujoco_bindings
#: A box on two wheels in front of a bump; {} are its options, its wheels' mesh and more.
CART = """
<mujoco>
  <option timestep="{timestep}" {option}/>
  {size}
  <asset>
    <mesh name="wheel" vertex="0 .03 0  .03 0 0  0 -.03 0  -.03 0 0  0 .02 .02  0 -.02 .02"/>
    <hfield name="bump" nrow="4" ncol="4" size="1 1 .05 .1"
      elevation="0 0 0 0  0 1 1 0  0 1 1 0  0 0 0 0"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1" condim="{condim}"/>
    {terrain}
    <body name="cart" pos="0 0 .1">
      <freejoint/>
      <geom type="box" size=".1 .06 .02" mass="1"/>
      <body pos=".08 .07 -.02">
        <joint name="left" axis="0 1 0" damping=".01"/>
        {wheel}
      </body>
      <body pos=".08 -.07 -.02">
        <joint name="right" axis="0 1 0" damping=".01"/>
        {wheel}
      </body>
      <site name="seat" pos="0 0 .03"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="left" ctrlrange="-1 1" ctrllimited="true" gear=".2"/>
    <position joint="right" kp=".3" dampratio="1" {actuator}/>
  </actuator>
  <sensor><accelerometer site="seat"/><gyro site="seat"/></sensor>
</mujoco>
"""
#: What MJX refuses or computes slowly, as parts of the model.
MODELS = {
    "elliptic": {"option": 'cone="elliptic" impratio="10"', "condim": "6"},
    "noslip": {"option": 'noslip_iterations="3" cone="elliptic"'},
    "PGS": {"option": 'solver="PGS"'},
    "CG": {"option": 'solver="CG" iterations="4"'},
    "implicit": {"option": 'integrator="implicit"'},
    "RK4": {"option": 'integrator="RK4"'},
    "delay": {"actuator": 'delay="0.012" nsample="3"'},
}
#: Of the plain one: a wheel that is a mesh, before terrain.
PLAIN = {
    "timestep": "0.004",
    "option": "",
    "size": "",
    "condim": "3",
    "actuator": "",
    "terrain": '<geom type="hfield" hfield="bump" pos="1.1 0 0"/>',
    "wheel": '<geom type="mesh" mesh="wheel" mass=".1"/>',
}
#: What MJX computes as C does.
SIMPLE = {"terrain": "", "wheel": '<geom type="sphere" size=".03" mass=".1"/>'}


def model_of(**parts):
    """Returns the plain model, or with other parts, as an ``MjModel``."""
    return mujoco.MjModel.from_xml_string(CART.format(**(PLAIN | parts)))


class Cart(MujocoEnv):
    """Rolls forward; the observation has sensors, a rotation and a field that MJX lacks."""

    carried = ("sensordata",)

    def __init__(self, **parts):
        super().__init__(
            xml_file=model_of(**parts),
            frame_skip=3,
            max_episode_steps=60,
            reward_threshold=None,
        )

    def initial(self, rng):
        qpos = jnp.asarray(self.mj_model.qpos0, jnp.result_type(float))
        qvel = 0.1 * jax.random.normal(rng, (self.mj_model.nv,))
        return qpos.at[2].add(0.05), qvel

    def outcome(self, before, data, action):
        forward = (data.body("cart").xpos[0] - before.qpos[0]) / self.dt
        change = jnp.sum((data.sensordata - before.sensordata) ** 2)
        return forward - 1e-3 * change, data.qpos[2] < -1.0, {"forward": forward}

    def observe(self, data):
        rotation = data.body("cart").xmat.ravel()
        return jnp.concatenate([data.qpos, data.qvel, data.sensordata, rotation])


class RandomCart(Cart):
    """Its masses and their place differ from episode to episode."""

    def randomize(self, rng):
        mass = jnp.asarray(self.mj_model.body_mass)
        return {"body_mass": mass * jax.random.uniform(rng, mass.shape, minval=0.5, maxval=2.0)}


@pytest.fixture
def float64():
    """Has JAX compute in float64, as C MuJoCo does."""
    with jax.enable_x64(True):
        yield


def actions_of(env, num_steps, num_episodes):
    """Returns random actions [steps, episodes, A] within their bounds."""
    size = (num_steps, num_episodes, env.action_size)
    return np.random.default_rng(0).uniform(-1, 1, size)


def stepped(task, keys, actions):
    """Returns the observations and rewards of episodes, each [steps, episodes, ...]."""
    state = jax.jit(jax.vmap(task.reset))(keys)
    step = jax.jit(jax.vmap(task.step))
    observations, rewards = [np.asarray(state.obs)], []
    for action in actions:
        state = step(state, jnp.asarray(action))
        observations.append(np.asarray(state.obs))
        rewards.append(np.asarray(state.reward))
    return np.stack(observations), np.stack(rewards)


@pytest.mark.parametrize("name", ["plain", *MODELS])
def test_episodes_have_c_mujocos_own_bits(float64, name):
    env = Cart(**MODELS.get(name, {}))
    keys, actions = jax.random.split(jax.random.key(1), 5), actions_of(env, 40, 5)
    observations, rewards = stepped(env.in_c_mujoco(), keys, actions)
    for episode in (0, 4):
        alone = SteppedByC(env.mj_model, observations[0, episode])
        expected = [alone.observe(), *(alone.step(action) for action in actions[:, episode])]
        np.testing.assert_array_equal(observations[:, episode], np.stack(expected))
    assert np.isfinite(rewards[0]).all()


class SteppedByC:
    """One episode of a ``Cart`` by C MuJoCo alone."""

    def __init__(self, model, start):
        """Begins where an observation begins: at its positions and velocities."""
        self.model, self.data = model, mujoco.MjData(model)
        self.data.qpos[:] = start[: model.nq]
        self.data.qvel[:] = start[model.nq : model.nq + model.nv]
        mujoco.mj_forward(model, self.data)

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 3)
        return self.observe()

    def observe(self):
        data = self.data
        return np.concatenate([data.qpos, data.qvel, data.sensordata, data.body("cart").xmat])


def test_a_float32_program_carries_float64():
    """Its states are those of a float64 program after many steps; only what it reads is rounded."""
    env = Cart(**MODELS["elliptic"])
    keys, actions = jax.random.split(jax.random.key(1), 2), actions_of(env, 200, 2)
    actions = actions.astype(np.float32)
    task = env.in_c_mujoco()
    observations, _ = stepped(task, keys, actions)
    assert observations.dtype == np.float32
    state = jax.jit(jax.vmap(task.reset))(keys)
    data = mujoco.MjData(env.mj_model)
    words = np.asarray(state.pipeline_state.carried[in_batch.STATE][1]).view(np.float64)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_setState(env.mj_model, data, words, spec)
    for action in actions[:, 1]:
        data.ctrl[:] = action
        mujoco.mj_step(env.mj_model, data, env.frame_skip)
    np.testing.assert_array_equal(observations[-1, 1, : data.qpos.size], np.float32(data.qpos))


def test_no_bit_depends_on_threads_or_other_episodes():
    env, num_steps = Cart(**MODELS["elliptic"]), 20
    keys, actions = jax.random.split(jax.random.key(2), 40), actions_of(env, num_steps, 40)
    many = env.in_c_mujoco()
    observations, _ = stepped(many, keys, actions)
    alone, _ = stepped(many, keys[7:8], actions[:, 7:8])
    np.testing.assert_array_equal(observations[:, 7:8], alone)
    simulations = many._simulations
    simulations.num_threads = 1
    simulations._batches.clear()
    np.testing.assert_array_equal(stepped(many, keys, actions)[0], observations)


def test_random_masses_are_those_of_a_model_compiled_with_them(float64):
    """So are the constants that MuJoCo computes of them, which say how soft contacts are."""
    env = RandomCart()
    keys, actions = jax.random.split(jax.random.key(3), 3), actions_of(env, 60, 3)
    observations, _ = stepped(env.in_c_mujoco(), keys, actions)
    episodes, _ = jax.vmap(env.draw)(keys)
    model = model_of()
    model.body_mass[:] = episodes["body_mass"][2]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    alone = SteppedByC(model, observations[0, 2])
    expected = [alone.observe(), *(alone.step(action) for action in actions[:, 2])]
    np.testing.assert_array_equal(observations[:, 2], np.stack(expected))


def test_no_episode_needs_to_run(float64):
    """A step in which none does is one of no simulation, also where models are drawn."""
    task = RandomCart().in_c_mujoco()
    keys = jax.random.split(jax.random.key(7), 2)
    state = jax.jit(jax.vmap(task.reset))(keys)
    over = state.replace(done=jnp.ones(2))
    after = jax.jit(jax.vmap(task.step_unfinished))(over, jnp.zeros((2, 2)))
    assert after.obs.shape == state.obs.shape


#: Beside the cart, which cannot sleep since it has actuators, a box does.
SLEEP = {
    **SIMPLE,
    "size": '<option><flag sleep="enable"/></option>',
    "terrain": '<body pos="1 0 .06"><freejoint/><geom type="box" size=".05 .05 .05"/></body>',
}


def test_bodies_sleep_as_in_c_and_never_for_another_episode(float64):
    env = Cart(**SLEEP)
    task = env.in_c_mujoco()
    keys, actions = jax.random.split(jax.random.key(1), 2), np.zeros((200, 2, 2))
    observations, _ = stepped(task, keys, actions)
    alone = SteppedByC(env.mj_model, observations[0, 1])
    expected = [alone.observe(), *(alone.step(action) for action in actions[:, 1])]
    np.testing.assert_array_equal(observations[:, 1], np.stack(expected))
    assert alone.data.ntree_awake < env.mj_model.ntree
    # Which bodies sleep is in no state: a batch cannot play two sets of episodes in turn.
    step = jax.vmap(task.step)
    first, second = (jax.vmap(task.reset)(jax.random.split(keys[i], 2)) for i in range(2))
    step(second, jnp.zeros((2, 2)))
    with pytest.raises(
        (RuntimeError, ValueError), match="which bodies sleep is no part of MuJoCo's state"
    ):
        jax.block_until_ready(step(first, jnp.zeros((2, 2))))


class CalmCart(Cart):
    """All of its episodes start alike, and the box is pushed after a while."""

    def initial(self, rng):
        return jnp.asarray(self.mj_model.qpos0), jnp.zeros(self.mj_model.nv).at[0].set(0.1)

    def memory(self, rng, data):
        return {"step": 0}

    def remember(self, rng, data, action):
        return {"step": data.memory["step"] + 1}

    def push(self, before):
        return jnp.zeros(self.mj_model.nv).at[-6].set(before.memory["step"] == 150)


def test_a_body_that_sleeps_wakes_where_it_is_pushed(float64):
    keys, actions = jax.random.split(jax.random.key(1), 2), np.zeros((155, 2, 2))
    envs = [CalmCart(**SLEEP), CalmCart(**SLEEP | {"size": ""})]
    asleep, awake = (stepped(env.in_c_mujoco(), keys, actions)[0] for env in envs)
    np.testing.assert_allclose(asleep, awake, rtol=0, atol=1e-3)
    assert np.abs(awake[150] - awake[155]).max() > 1e-3


def test_a_sweep_trains_what_mjx_refuses():
    """Its programs are built with traced settings, for which no engine plays."""
    config = Config(num_episodes=2, eval_episodes=1, horizon=5, hidden_sizes=(2,))
    plan = build_ready(Cart(**MODELS["noslip"]), config, traced=("learning_rate",))
    assert plan.engine == "mujoco"
    assert plan.programs().state_bytes


class FeltCart(Cart):
    """It also observes the forces of contacts on its bodies."""

    contact_forces = True

    def observe(self, data):
        return jnp.concatenate([super().observe(data), data.cfrc_ext.ravel()])


class RandomFeltCart(FeltCart, RandomCart):
    """Its masses differ from episode to episode, too."""


@pytest.mark.parametrize(
    ("integrator", "task"), [("Euler", FeltCart), ("RK4", FeltCart), ("Euler", RandomFeltCart)]
)
def test_contact_forces_are_those_of_the_last_evaluation(float64, integrator, task):
    # A light wheel with an undamped integrator needs short steps.
    parts = {"option": f'integrator="{integrator}"', "timestep": "0.001"}
    env = task(**parts)
    keys, actions = jax.random.split(jax.random.key(6), 2), actions_of(env, 60, 2)
    observations, rewards = stepped(env.in_c_mujoco(), keys, actions)
    assert np.isfinite(rewards).all()
    episodes, _ = jax.vmap(env.draw)(keys)
    model = model_of(**parts)
    model.body_mass[:] = episodes.get("body_mass", [model.body_mass] * 2)[1]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    alone = SteppedByC(model, observations[0, 1])
    forces = [np.zeros((model.nbody, 6))]
    for action in actions[:, 1]:
        alone.step(action)
        mujoco.mj_rnePostConstraint(model, alone.data)
        forces.append(np.array(alone.data.cfrc_ext))
    forces = np.reshape(forces, (len(forces), -1))
    assert np.abs(forces).max() > 0.1
    np.testing.assert_array_equal(observations[:, 1, -forces.shape[1] :], forces)


@pytest.mark.parametrize("kind", ["an action that is no number", "a velocity beyond C's bound"])
def test_what_c_mends_in_silence_breaks_the_episode_and_no_other(
    kind, capfd, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    env = Cart(**MODELS["elliptic"])
    task = env.in_c_mujoco()
    state = jax.vmap(task.reset)(jax.random.split(jax.random.key(4), 3))
    action = np.zeros((3, env.action_size))
    if kind == "an action that is no number":
        action[1] = np.nan
    else:
        words = np.array(state.pipeline_state.carried[in_batch.STATE])
        words[1].view(np.float64)[1 + env.mj_model.nq] = 1e11  # the first velocity, after time
        carried = state.pipeline_state.carried | {in_batch.STATE: jnp.asarray(words)}
        physics = state.pipeline_state.replace(carried=carried)
        state = state.replace(pipeline_state=physics)
    after = jax.vmap(task.step)(state, jnp.asarray(action))
    assert np.isfinite(after.reward).tolist() == [True, False, True]
    # Neither lines of warnings in the display of a run nor a file in the user's folder.
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_full_arena_breaks_the_episode():
    """C leaves out what it has no room for; the episode does not go on without it."""
    env = Cart(size='<size memory="24K"/>', **MODELS["elliptic"])
    task = env.in_c_mujoco()
    state = jax.vmap(task.reset)(jax.random.split(jax.random.key(5), 2))
    rewards = []
    for _ in range(20):
        state = jax.vmap(task.step)(state, jnp.zeros((2, env.action_size)))
        rewards.append(np.asarray(state.reward))
    assert np.isnan(rewards).any()


def address_space():
    """Returns how many bytes this process has reserved."""
    num_pages = int(Path("/proc/self/statm").read_text().split()[0])
    return num_pages * resource.getpagesize()


def test_no_arena_is_reserved_before_an_episode():
    """Of a model for whole scenes it may have gigabytes, of which an episode touches little."""
    env = Cart(size='<size memory="4G"/>', **MODELS["elliptic"])
    reserved = address_space()
    env.in_c_mujoco()
    assert address_space() - reserved < 2 * 2**30


def test_auto_takes_c_mujoco_where_nothing_else_is_faster():
    slow = choice.choose("auto", Cart(**MODELS["elliptic"], **SIMPLE))
    refused = choice.choose("auto", Cart(**MODELS["noslip"]))
    fast = choice.choose("auto", envs.make("InvertedPendulum-v5"))
    assert (slow.name, refused.name) == ("mujoco", "mujoco")
    assert "elliptic cones" in slow.why
    assert "MJX" in refused.why
    assert fast.name != "mujoco"


def test_other_engines_refuse_with_every_reason():
    with pytest.raises(ValueError, match="noslip_iterations"):
        make_vec(Cart(**MODELS["noslip"]), 2, engine="native")
    with pytest.raises(ValueError, match="noslip_iterations"):
        make_vec(Cart(**MODELS["noslip"]), 2, engine="vmap")
    with pytest.raises(ValueError, match="simulates no model of MuJoCo's"):
        make_vec("CartPole-v1", 2, engine="mujoco")


@pytest.mark.slow
def test_three_engines_make_the_same_first_update():
    env, metrics = envs.make("InvertedPendulum-v5"), {}
    for engine in ("vmap", "native", "mujoco"):
        learner = reinforce(env, num_episodes=8, horizon=20, engine=engine)
        state = learner.init(jax.random.key(0))
        for _ in range(2):
            state, metrics[engine] = train_step(learner, state)
    for engine in ("native", "mujoco"):
        for name in ("episode_return", "gradient_norm", "kl", "entropy"):
            got, expected = metrics[engine][name], metrics["vmap"][name]
            np.testing.assert_allclose(got, expected, rtol=1e-3, err_msg=f"{engine} {name}")


@pytest.mark.slow
def test_seeds_are_vmapped_and_a_vector_plays_the_same():
    env = Cart(**MODELS["elliptic"])
    learner = reinforce(env, num_episodes=4, horizon=10)
    states = jax.vmap(learner.init)(jax.random.split(jax.random.key(0), 3))
    together, _ = jax.jit(jax.vmap(learner.step))(states)
    alone, _ = train_step(learner, jax.tree.map(lambda x: x[1], states))
    for name, weight in jax.tree_util.tree_leaves_with_path(alone.actor.params):
        assert np.all(np.isfinite(weight)), name
    np.testing.assert_allclose(
        jax.tree.leaves(together.actor.params)[0][1],
        jax.tree.leaves(alone.actor.params)[0],
        rtol=1e-5,
    )
    vec = make_vec(env, 4)
    assert vec.engine.name == "mujoco"
    keys = jax.random.split(jax.random.key(6), 4)
    actions = actions_of(env, 10, 4)
    state = vec.reset(keys)
    for action in actions:
        state = vec.step(state, action.astype(np.float32))
    assert np.isfinite(state.obs).all()
    assert (state.episode_length == 10).all()

"""Tasks of MuJoCo Playground: their own code, on the physics of the engines here."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from places import PYTHONPATH

from mjx_reinforce import envs, make_vec
from mjx_reinforce.engine import contract
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco
from mjx_reinforce.export.control import affine_control
from mjx_reinforce.settings.defaults import SUITE

package = pytest.importorskip("mujoco_playground")
from ml_collections import config_dict  # noqa: E402
from mujoco_playground._src import mjx_env  # noqa: E402

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="target" mocap="true"><geom size=".1" contype="0" conaffinity="0"/></body>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" damping=".3"/>
      <geom size=".1" mass="1"/>
      <body name="pole" pos="0 0 .1">
        <joint name="hinge" axis="0 1 0" damping=".1" range="-90 90"/>
        <geom type="capsule" fromto="0 0 0 0 0 .5" size=".03" mass=".3"/>
        <site name="tip" pos="0 0 .5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="4"/></actuator>
  <sensor><framelinvel name="speed" objtype="site" objname="tip"/></sensor>
</mujoco>
"""
EPISODES = 3
STEPS = 6
FUNCTIONS = ((mjx_env, "step"), (mjx_env, "make_data"), (package, "step"), (mjx, "forward"))


def config(**changes):
    entries = {"ctrl_dt": 0.02, "sim_dt": 0.01, "episode_length": STEPS, "action_repeat": 1}
    return config_dict.create(**entries | {"impl": "jax"} | changes)


class Cart(mjx_env.MjxEnv):
    """It settles, draws a target, remembers, pushes, adds to its controls, and draws in steps."""

    def __init__(self, **changes):
        super().__init__(config(**changes))
        self._model = mujoco.MjModel.from_xml_string(MODEL)
        self._mjx_model = mjx.put_model(self._model, impl="jax")

    def reset(self, rng):
        rng, qpos_rng, target_rng = jax.random.split(rng, 3)
        qpos = jax.random.uniform(qpos_rng, (2,), minval=-0.5, maxval=0.5)
        target = jax.random.uniform(target_rng, (1, 3))
        data = mjx_env.make_data(
            self.mj_model, qpos=qpos, qvel=-qpos, mocap_pos=target, impl="jax", njmax=5
        )
        data = mjx.forward(self.mjx_model, data)
        data = mjx_env.step(self.mjx_model, data, 0.2 * data.site_xpos[0, :1], 7)
        data = data.replace(time=0.0)
        info = {"rng": rng, "count": 0, "past": [jnp.zeros(1), jnp.zeros(1, bool)]}
        metrics = {"reward/near": jnp.zeros(()), "reward/slow": jnp.zeros(()), "other": 0.0}
        reward, done = jnp.zeros(2)
        return mjx_env.State(data, self._see(data, info), reward, done, metrics, info)

    def step(self, state, action):
        info = dict(state.info)
        info["rng"], noise_rng = jax.random.split(state.info["rng"])
        push = jnp.where(info["count"] % 2 == 0, 0.1, 0.0)
        control = state.data.ctrl * 0.5 + action + 0.01 * jax.random.normal(noise_rng, (1,))
        data = state.data.replace(qvel=state.data.qvel.at[0].add(push))
        tip = state.data.site_xpos[0, 2]
        data = mjx_env.step(self.mjx_model, data, control, self.n_substeps)
        metrics = state.metrics
        metrics["reward/near"] = self.near(data)
        metrics["reward/slow"] = -jnp.abs(mjx_env.get_sensor_data(self.mj_model, data, "speed")[0])
        metrics["other"] = tip - data.site_xpos[0, 2]
        reward = metrics["reward/near"] + metrics["reward/slow"]
        reward += info["past"][0][0] + state.obs["state"][0]
        info["past"] = [action, action > 0]
        info["count"] += 1
        done = (jnp.abs(data.qpos[1]) > 1.5).astype(float)
        return state.replace(
            data=data, obs=self._see(data, info), reward=reward, done=done, info=info
        )

    def near(self, data):
        return -jnp.linalg.norm(data.site_xpos[0] - data.mocap_pos[0])

    def _see(self, data, info):
        seen = jnp.concatenate([data.qpos, data.qvel, info["past"][0], data.sensordata])
        return {"state": seen, "privileged_state": jnp.append(seen, data.time)}

    xml_path = ""
    action_size = 1

    @property
    def mj_model(self):
        return self._model

    @property
    def mjx_model(self):
        return self._mjx_model


class Near(Cart):
    """A reward of the user's own."""

    def near(self, data):
        return 2 * data.xpos[2, 0]


def played(reset, step):
    """Returns the observations, rewards, ends and metrics of episodes, [T + 1, N, ...] each."""
    keys = jax.random.split(jax.random.key(0), EPISODES)
    state = jax.jit(jax.vmap(reset))(keys)
    states = [state]
    step = jax.jit(jax.vmap(step))
    for number in range(STEPS - 1):
        state = step(state, jnp.cos(number + jnp.arange(EPISODES))[:, None])
        states.append(state)
    seen = [x.obs for x in states]
    if isinstance(seen[0], dict):
        seen = [x["state"] for x in seen]
    rest = [[x.reward, x.done, *(x.metrics[name] for name in sorted(x.metrics))] for x in states]
    return np.stack(seen), np.array(rest)


def played_by(env, engine):
    """Returns the observations, rewards and ends that an engine plays, [T + 1, N, ...] each."""
    vec = make_vec(env, EPISODES, engine=engine)
    state = vec.reset(jax.random.key(0))
    states = [state]
    step = jax.jit(vec.step)
    for number in range(STEPS - 1):
        state = step(state, jnp.cos(number + jnp.arange(EPISODES))[:, None])
        states.append(state)
    rest = [[x.reward, x.terminated, *x.metrics.values()] for x in states]
    return np.stack([x.obs for x in states]), np.array(rest)


@pytest.mark.slow
def test_a_task_plays_as_by_itself():
    task = Cart()
    env = envs.from_playground(task)
    assert (env.settle_steps, env.frame_skip, env.has_pushes) == (7, 2, True)
    assert (env.max_episode_steps, env.dt, env.observation_size) == (STEPS, 0.02, 8)
    contract.check_environment(env)
    in_c = env.in_c_mujoco()
    expected = played(task.reset, task.step)
    for x, y in zip(expected, played(in_c.reset, in_c.step), strict=True):
        np.testing.assert_allclose(y, x, atol=2e-5)


@pytest.mark.slow
def test_a_task_is_made_where_a_program_is_traced():
    def play(make, key):
        env = make()
        return env.step(env.reset(key), jnp.zeros(env.action_size)).obs

    makers = (
        lambda: envs.from_playground(Cart()),
        lambda: envs.make("playground:PendulumSwingup"),
    )
    for make in makers:
        env = make()
        inside = jax.jit(functools.partial(play, make))(jax.random.key(0))
        outside = jax.jit(functools.partial(play, lambda env=env: env))(jax.random.key(0))
        np.testing.assert_allclose(inside, outside, rtol=1e-5)


@pytest.mark.slow
def test_engines_play_the_same():
    """With a reward of the user's own class."""
    env = envs.from_playground(Near())
    expected = played_by(env, "mujoco")
    assert np.ptp(expected[1][:, 0]) > 0.1
    for x, y in zip(expected, played_by(env, "native"), strict=True):
        np.testing.assert_allclose(y, x, atol=2e-5)


def test_one_episode_in_c_settles_too():
    env = envs.from_playground(Cart())
    one = InMujoco(env)
    key = jax.random.key(4)
    state = env.in_c_mujoco().reset(key)
    np.testing.assert_allclose(one.reset(key), state.obs, atol=1e-6)
    assert one.data.time == 0


class Unforwarded(Cart):
    """Its reset reads a simulation without a forward pass, as Playground's arms do."""

    def reset(self, rng):
        data = mjx_env.make_data(self.mj_model, qpos=jax.random.uniform(rng, (2,)), impl="jax")
        obs = jnp.append(data.site_xpos[0], data.qpos)
        zero = jnp.zeros(())
        return mjx_env.State(data, obs, zero, zero, {}, {})

    def step(self, state, action):
        data = mjx_env.step(self.mjx_model, state.data, action, self.n_substeps)
        obs = jnp.append(data.site_xpos[0], data.qpos)
        return state.replace(data=data, obs=obs, reward=data.qpos[0])


def test_a_reset_without_a_forward_pass_sees_zeros():
    task = Unforwarded()
    key = jax.random.key(1)
    for env in (task, envs.from_playground(task).in_c_mujoco()):
        np.testing.assert_array_equal(env.reset(key).obs[:3], 0)
        np.testing.assert_allclose(env.reset(key).obs[3:], jax.random.uniform(key, (2,)))


def test_the_exchange_is_undone():
    functions = [getattr(place, name) for place, name in FUNCTIONS]
    env = envs.from_playground(Cart())
    jax.eval_shape(env.reset, jax.random.key(0))

    class Failing(Cart):
        def step(self, state, action):
            raise KeyError("mine")

    with pytest.raises(ValueError, match="Failing cannot be played: KeyError: 'mine'"):
        envs.from_playground(Failing())
    assert [getattr(place, name) for place, name in FUNCTIONS] == functions


@pytest.mark.slow
def test_importing_this_package_imports_no_playground():
    code = "import sys, mjx_reinforce.envs.playground; print('mujoco_playground' in sys.modules)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": PYTHONPATH}, capture_output=True, text=True
    )
    assert done.stdout.split() == ["False"]


def test_exports_have_controls_that_depend_on_the_action_alone():
    """And refuse others, which a robot could not compute without the task."""
    numbers = affine_control(envs.make("playground:PendulumSwingup"))
    assert (numbers["home"], numbers["scale"]) == (0, 1)
    with pytest.raises(ValueError, match="the controls of Cart depend on more than the action"):
        affine_control(envs.from_playground(Cart()))


class Twice(Cart):
    def step(self, state, action):
        return super().step(super().step(state, action), action)


class Pulled(Cart):
    def step(self, state, action):
        data = state.data.replace(xfrc_applied=jnp.zeros((4, 6)))
        return super().step(state.replace(data=data), action)


class Moved(Cart):
    def step(self, state, action):
        state = super().step(state, action)
        return state.replace(data=state.data.replace(qpos=jnp.zeros(2)))


class Unmoved(Cart):
    def step(self, state, action):
        return state


class Renewed(Cart):
    def step(self, state, action):
        return self.reset(state.info["rng"])


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Twice, "Twice.step must call mjx_env.step once, by this name"),
        (Unmoved, "Unmoved.step must call mjx_env.step once, by this name"),
        (Pulled, "Pulled.step sets xfrc_applied before its physics; it can set the controls"),
        (Moved, "Moved.step sets qpos after its physics"),
        (Renewed, "Renewed cannot be played: .*its step makes a simulation of its own"),
    ],
)
def test_what_no_engine_can_is_refused(task, message):
    with pytest.raises(ValueError, match=message):
        envs.from_playground(task())


def test_what_is_missing_is_said():
    with pytest.raises(ValueError, match=r"unknown task of Playground 'WalkerRum'.*'WalkerRun'"):
        envs.from_playground("WalkerRum")
    with pytest.raises(ValueError, match=r"unknown task of Playground ''\. Known: Acrobot"):
        envs.make("playground:")
    with pytest.raises(ValueError, match=r"unknown entry of the configuration of .*'sim_dt'"):
        envs.from_playground("PendulumSwingup", sim_dts=0.1)
    with pytest.raises(ValueError, match="are for a name; this task is made already"):
        envs.from_playground(Cart(), sim_dt=0.1)
    with pytest.raises(ValueError, match="action_repeat of Cart must be 1, got 2"):
        envs.from_playground(Cart(action_repeat=2))
    if not mjx_env.MENAGERIE_PATH.exists():
        with pytest.raises(ValueError, match=r"Go1Getup needs MuJoCo Menagerie in .*: link your"):
            envs.make("playground:Go1Getup")


def test_an_id_takes_settings():
    env = envs.make_set("playground:PendulumSwingup", ["sim_dt=0.005", "episode_length=7"])
    assert (env.frame_skip, env.max_episode_steps) == (4, 7)
    assert env.mj_model.opt.timestep == 0.005


def test_without_playground_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(ValueError, match=r"pip install 'mjx-reinforce\[playground\]'"):
        envs.make("playground:WalkerRun")


@pytest.mark.slow
def test_the_suites_figures_are_those_of_its_tasks():
    """The settings of its tasks follow from these, which are known before one is imported."""
    from mujoco_playground import dm_control_suite

    assert sorted(SUITE) == sorted(dm_control_suite.ALL_ENVS)
    for name, (num_entries, seconds) in SUITE.items():
        task = dm_control_suite.load(name)
        assert (num_entries, seconds) == (task.action_size, task.dt), name
        assert task._config.episode_length == 1000, name

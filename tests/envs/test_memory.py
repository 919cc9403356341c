"""Episodes that remember: noise, delays, commands and pushes are the same in every engine."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import MjSpec  # type: ignore

from mjx_reinforce import make_vec
from mjx_reinforce.engine import rollout
from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.envs.c_mujoco.in_mujoco import InMujoco

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body pos="0 0 0.3">
      <freejoint/>
      <geom size="0.1"/>
      <body pos="0.2 0 0">
        <joint name="arm" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="arm" gear="0.5" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
DELAY = 2
PERIOD = 3
STEPS = 12


class Pushed(MujocoEnv):
    """Late actions, noisy observations with the last action, a command and pushes that change."""

    def __init__(self):
        super().__init__(
            xml_file=MjSpec.from_string(MODEL),
            frame_skip=4,
            max_episode_steps=STEPS,
            reward_threshold=None,
        )

    def initial(self, rng):
        return jnp.asarray(self.mj_model.qpos0), 0.1 * jax.random.normal(rng, (7,))

    def memory(self, rng, data):
        return {
            "actions": jnp.zeros((DELAY, 1)),
            "command": jax.random.uniform(rng),
            "noise": jnp.zeros(1),
            "push": jnp.zeros(2),
            "step": 0,
        }

    def actuate(self, before, action):
        return self.control(before.memory["actions"][0])

    def push(self, before):
        return jnp.zeros(7).at[:2].set(before.memory["push"])

    def remember(self, rng, data, action):
        noise_key, command_key, push_key = jax.random.split(rng, 3)
        old = data.memory
        is_due = (old["step"] + 1) % PERIOD == 0
        push = jax.random.uniform(push_key, (2,), minval=-0.5, maxval=0.5)
        return {
            "actions": jnp.concatenate([old["actions"][1:], action[None]]),
            "command": jnp.where(is_due, jax.random.uniform(command_key), old["command"]),
            "noise": 0.1 * jax.random.normal(noise_key, (1,)),
            "push": jnp.where(is_due, push, 0.0),
            "step": old["step"] + 1,
        }

    def observe(self, data):
        arm = data.joint("arm")
        command = data.memory["command"][None]
        last_action = data.memory["actions"][-1]
        return jnp.concatenate(
            [arm.qpos + data.memory["noise"], arm.qvel, command, last_action, data.qvel[:2]]
        )

    def outcome(self, before, data, action):
        change = action[0] - before.memory["actions"][-1, 0]
        reward = data.memory["command"] - before.memory["command"] - change**2
        return reward, False, {"reward_change": reward}


class Fixed:
    """No noise: the policy's output is the action."""

    def noise(self, key, shape):
        return jnp.zeros((*shape, 1))

    def sample(self, outputs, noise):
        return outputs

    mode = staticmethod(lambda outputs: outputs)


def act(params, observation):
    """Returns an action that depends on all that is observed."""
    return jnp.tanh(observation @ params)[None]


PARAMS = np.array([1.0, -0.3, 2.0, -0.7, 0.5, -0.5])


def played(engine, env, num_episodes=3):
    """Returns the observations [T, O, N] and rewards [T, N] that an engine plays."""
    params = jnp.asarray(PARAMS, jnp.result_type(float))
    options = {"num_episodes": num_episodes, "horizon": STEPS, "engine": engine}
    trajectory = jax.jit(lambda params, key: rollout(env, act, params, Fixed(), key, **options))(
        params, jax.random.key(3)
    )
    return np.asarray(trajectory.observation), np.asarray(trajectory.reward)


def traced_step(env, engine):
    """Traces the first env step of an episode, by MJX or C MuJoCo."""
    task = env.in_c_mujoco() if engine == "mujoco" else env
    jax.eval_shape(lambda key: task.step(task.reset(key), jnp.zeros(1)), jax.random.key(0))


@pytest.fixture(scope="module")
def env():
    return Pushed()


@pytest.fixture(scope="module")
def by_vmap(env):
    return played("vmap", env)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mujoco"])
def test_all_engines_play_the_same_episodes(env, by_vmap, engine):
    for other, expected in zip(played(engine, env), by_vmap, strict=True):
        np.testing.assert_allclose(other, expected, rtol=0, atol=2e-5)


@pytest.mark.slow
def test_one_episode_in_c_mujoco_is_that_of_the_task(env):
    """``watch`` plays with it; the first observations of 100 starts have different commands."""
    key = jax.random.key(5)
    simulation = InMujoco(env)
    state = jax.jit(env.reset)(key)
    step = jax.jit(env.step)
    np.testing.assert_allclose(simulation.reset(key), state.obs, atol=1e-6)
    for number in range(STEPS):
        action = np.sin(np.full(1, number, np.float32))
        state = step(state, action)
        observation, reward, _ = simulation.step(action)
        np.testing.assert_allclose(observation, state.obs, atol=2e-5)
        np.testing.assert_allclose(reward, state.reward, atol=1e-6)


@pytest.mark.slow
def test_an_action_comes_late_and_the_last_one_is_observed(env):
    step = jax.jit(env.step)
    states = [jax.jit(env.reset)(jax.random.key(0))]
    actions = np.linspace(-0.9, 0.9, STEPS, dtype=np.float32)[:, None]
    for action in actions:
        states.append(step(states[-1], action))
    np.testing.assert_allclose([s.obs[3] for s in states[1:]], actions[:, 0])
    late = np.concatenate([np.zeros((DELAY, 1)), actions])[:STEPS]
    # Without pushes and noise the arm moves as under the late actions in a task without delay.
    quiet = type("Quiet", (Pushed,), {"push": lambda self, before: jnp.zeros(7)})()
    prompt = type("Prompt", (type(quiet),), {"actuate": MujocoEnv.actuate})()
    first, second = quiet.reset(jax.random.key(0)), prompt.reset(jax.random.key(0))
    quiet_step, prompt_step = jax.jit(quiet.step), jax.jit(prompt.step)
    for action, late_action in zip(actions, late, strict=True):
        first = quiet_step(first, action)
        second = prompt_step(second, late_action.astype(np.float32))
        np.testing.assert_allclose(first.pipeline_state.qpos, second.pipeline_state.qpos, atol=1e-6)


@pytest.mark.slow
def test_noise_differs_from_step_to_step_and_has_its_deviation(env):
    step = jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 500))
    errors = []
    for _ in range(4):
        state = step(state, jnp.zeros((500, 1)))
        errors.append(np.asarray(state.obs[:, 0] - state.pipeline_state.qpos[:, 7]))
    errors = np.array(errors)
    assert errors.std() == pytest.approx(0.1, abs=0.005)
    assert np.abs(np.corrcoef(errors) - np.eye(4)).max() < 0.15
    commands = np.asarray(state.pipeline_state.memory["command"])
    assert len(np.unique(commands)) > 490  # of some 8 million
    assert commands.mean() == pytest.approx(0.5, abs=0.04)


@pytest.mark.slow
def test_a_push_changes_the_velocity_with_which_a_step_begins(env):
    """After ``PERIOD`` steps the body is pushed, in the next step."""
    state = env.reset(jax.random.key(2))
    step = jax.jit(env.step)
    for number in range(1, 2 * PERIOD + 1):
        push = np.asarray(state.pipeline_state.memory["push"])
        assert np.any(push != 0) == (number > 1 and (number - 1) % PERIOD == 0)
        before = np.asarray(state.pipeline_state.qvel[:2])
        state = step(state, jnp.zeros(1))
        # What is left of a push after 8 ms in the air or on the floor is most of it.
        change = np.asarray(state.pipeline_state.qvel[:2]) - before
        np.testing.assert_allclose(change, push, atol=0.12)


@pytest.mark.slow
def test_environments_in_lockstep_begin_episodes_with_a_memory_of_their_own(env):
    vec = make_vec(env, num_envs=4)
    state = vec.reset(jax.random.key(0))
    commands = np.asarray(state.obs[:, 2])
    assert len(np.unique(commands)) == 4
    for _ in range(STEPS + 1):
        state = vec.step(state, jnp.zeros((4, 1)))
    assert not np.isin(np.asarray(state.obs[:, 2]), commands).any()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["vmap", "mujoco"])
def test_keys_of_every_generator_begin_a_memory(env, engine):
    task = env.in_c_mujoco() if engine == "mujoco" else env
    keys = [jax.random.key(seed, impl="rbg") for seed in (0, 1)]
    commands = [jax.jit(task.reset)(key).pipeline_state.memory["command"] for key in keys]
    assert commands[0] != commands[1]


def test_a_task_without_memory_has_the_state_it_had():
    class Plain(Pushed):
        memory = MujocoEnv.memory
        remember = MujocoEnv.remember
        actuate = MujocoEnv.actuate
        push = MujocoEnv.push

        def observe(self, data):
            return data.qpos

        def outcome(self, before, data, action):
            return 0.0, False, {}

    state: Any = Plain().reset(jax.random.key(0)).pipeline_state
    assert (state.memory, state.key) == ({}, ())
    assert len(jax.tree.leaves(state)) == 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "result", "message"),
    [
        ("memory", [1], "Wrong.memory must return a dict of arrays by their names, got a list"),
        ("memory", {"x": "y"}, "'x' of Wrong.memory must be an array of numbers, got a str"),
        (
            "memory",
            {"x": np.array("y")},
            "'x' of Wrong.memory must be an array of numbers, got <U1[]",
        ),
        ("memory", {"x": {}}, "'x' of Wrong.memory must be an array of numbers, got a dict"),
        (
            "memory",
            {"x": jax.random.key(0)},
            "'x' of Wrong.memory must be an array of numbers, got key",
        ),
        ("remember", {"x": np.zeros(3)}, "'x' of Wrong.remember must be [2], got the shape [3]"),
        ("remember", {}, "Wrong.remember must return what Wrong.memory does (x), got nothing"),
        (
            "push",
            np.zeros(2),
            "Wrong.push must return [7], a change of each velocity, got the shape [2]",
        ),
        ("actuate", np.zeros(2), "Wrong.control must return [1], a control for each actuator"),
    ],
)
@pytest.mark.parametrize("engine", ["vmap", "mujoco"])
def test_what_is_no_memory_is_refused(engine, method, result, message):
    methods: dict[str, Any] = {
        "memory": lambda self, rng, data: {"x": np.zeros(2)},
        "remember": MujocoEnv.remember,
        "push": MujocoEnv.push,
        "actuate": MujocoEnv.actuate,
        "observe": MujocoEnv.observe,
        "outcome": lambda self, before, data, action: (0.0, False, {}),
    }
    methods[method] = lambda self, *arguments: result
    wrong = type("Wrong", (Pushed,), methods)()
    with pytest.raises(ValueError, match=re.escape(message)):
        traced_step(wrong, engine)


class Counting(Pushed):
    """It counts its steps, in all of what ``memory`` may return."""

    actuate = MujocoEnv.actuate
    push = MujocoEnv.push

    def memory(self, rng, data):
        return {"array": np.zeros(2), "float": 0.0, "int": 0, "bool": False}

    def remember(self, rng, data, action):
        memory = data.memory
        memory["array"] = memory["array"].at[0].add(1.0)
        memory["float"] = memory["float"][None][0] + 1
        memory["int"] = memory["int"] + memory["int"].astype(bool) + ~memory["bool"]
        return memory | {"bool": ~memory["bool"]}

    def observe(self, data):
        data.memory["float"] = 10 * data.memory["float"]
        return jnp.append(data.memory["array"], data.memory["float"])

    def outcome(self, before, data, action):
        return data.memory["array"][0] - before.memory["array"][0], False, {}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["vmap", "mujoco", "InMujoco"])
def test_a_task_may_change_the_dict_that_it_reads(engine):
    """What it changes there is neither what ``outcome`` sees of before, nor what comes next."""
    env = Counting()
    if engine == "InMujoco":
        simulation = InMujoco(env)
        simulation.reset(jax.random.key(0))
        for number in range(1, 4):
            observation, reward, _ = simulation.step(np.zeros(1, np.float32))
            assert (*observation, reward) == (number, 0, 10 * number, 1)
        return
    task = env.in_c_mujoco() if engine == "mujoco" else env
    state = jax.jit(task.reset)(jax.random.key(0))
    step: Any = jax.jit(task.step)
    for number in range(1, 4):
        state = step(state, jnp.zeros(1))
        assert (*state.obs, state.reward) == (number, 0, 10 * number, 1)
    assert step._cache_size() == 1


@pytest.mark.parametrize("engine", ["vmap", "mujoco"])
def test_a_count_that_becomes_a_fraction_is_refused(engine):
    """Each step would cut the fraction off: the time would stay 0."""
    methods = {
        "memory": lambda self, rng, data: {"time": 0},
        "observe": MujocoEnv.observe,
        "outcome": lambda self, before, data, action: (0.0, False, {}),
        "remember": lambda self, rng, data, action: (
            data.memory | {"time": data.memory["time"] + 0.5}
        ),
    }
    env = type("Late", (Counting,), methods)()
    message = "'time' of Late.remember must be int32, as Late.memory returns it, got float32"
    with pytest.raises(ValueError, match=re.escape(message)):
        traced_step(env, engine)


def test_to_remember_without_a_memory_is_refused():
    methods = {
        "memory": MujocoEnv.memory,
        "remember": lambda self, rng, data, action: {"x": action},
        "observe": MujocoEnv.observe,
        "outcome": lambda self, before, data, action: (0.0, False, {}),
    }
    env = type("Lost", (Counting,), methods)()
    message = "Lost.remember must return what Lost.memory does (nothing), got x"
    with pytest.raises(ValueError, match=re.escape(message)):
        traced_step(env, "vmap")


def test_attributes_of_a_task_may_have_the_names_of_methods_that_it_lacks():
    """Tasks had such attributes before these methods were there."""
    methods = {
        "memory": MujocoEnv.memory,
        "remember": MujocoEnv.remember,
        "observe": MujocoEnv.observe,
        "outcome": lambda self, before, data, action: (self.push, False, {}),
    }
    env: Any = type("Older", (Counting,), methods)()
    env.memory, env.remember, env.push = 1, 2, 3
    task = env.in_c_mujoco()
    state = jax.jit(lambda key: task.step(task.reset(key), jnp.zeros(1)))(jax.random.key(0))
    assert state.reward == 3
    InMujoco(env).reset(jax.random.key(0))


class Framed(Counting):
    """A policy sees three counts, of which the first is 7."""

    frames = 3

    def observe(self, data):
        return data.memory["array"][:1] + 7


#: What it sees at the start and after each step.
SEEN = [[7, 7, 7], [7, 7, 8], [7, 8, 9], [8, 9, 10], [9, 10, 11]]


@pytest.mark.parametrize(
    "engine", [pytest.param("vmap", marks=pytest.mark.slow), "mujoco", "InMujoco"]
)
def test_a_policy_sees_the_last_observations(engine):
    env = Framed()
    assert (env.observation_size, env.frames) == (3, 3)
    if engine == "InMujoco":
        simulation = InMujoco(env)
        observations = [simulation.reset(jax.random.key(0))]
        observations += [simulation.step(np.zeros(1, np.float32))[0] for _ in SEEN[1:]]
        np.testing.assert_array_equal(observations, SEEN)
        np.testing.assert_array_equal(simulation.reset(jax.random.key(1)), SEEN[0])
        return
    task = env.in_c_mujoco() if engine == "mujoco" else env
    step = jax.jit(task.step)
    states = [jax.jit(task.reset)(jax.random.key(0))]
    for _ in SEEN[1:]:
        states.append(step(states[-1], jnp.zeros(1)))
    np.testing.assert_array_equal([state.obs for state in states], SEEN)


def test_the_next_episode_of_an_environment_begins_with_frames_of_its_own():
    vec = make_vec(Framed(), num_envs=2, engine="mujoco", max_episode_steps=len(SEEN) - 1)
    state = vec.reset(jax.random.key(0))
    for seen in [*SEEN[1:], *SEEN]:
        state = vec.step(state, jnp.zeros((2, 1)))
        np.testing.assert_array_equal(state.obs, [seen, seen])


@pytest.mark.parametrize("frames", [0, 1.5])
def test_frames_that_are_no_count_are_refused(frames):
    env = type("Wrong", (Framed,), {"frames": frames})()
    with pytest.raises(ValueError, match="frames must be"):
        jax.eval_shape(env.reset, jax.random.key(0))

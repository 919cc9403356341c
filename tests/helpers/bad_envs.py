"""Environments with one mistake each, as users make them; test_bad_input.py tries them."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
from toys import Survive

from mjx_reinforce import Box, envs
from mjx_reinforce.envs.base import MujocoEnv

A_CONSTANT = 3


class Nothing:
    """Has no method of an environment."""


class NeedsArgument(Survive):
    def __init__(self, size):
        self.size = size


class Raises(Survive):
    def __init__(self):
        raise RuntimeError("no such\nrobot")


class Refuses(Survive):
    def __init__(self):
        np.zeros(2) + np.zeros(3)


class ActionSizeRaises(Survive):
    @property
    def action_size(self):
        return {}["size"]


class ActionSizeIsText(Survive):
    action_size = "one"


class ActionSizeIsTrue(Survive):
    action_size = True


class NoActions(Survive):
    action_size = 0


class ForeignSpace(Survive):
    action_space = types.SimpleNamespace(low=-1, high=1)


class SpaceOfTwo(Survive):
    action_space = Box(np.array([-1.0, -1.0]), np.array([1.0, 1.0]))


class SpaceUpsideDown(Survive):
    action_space = Box(np.array([1.0]), np.array([-1.0]))


class SpaceOfText(Survive):
    action_space = Box(np.array(["low"]), np.array(["more"]))


class SpaceRagged(Survive):
    action_space = Box([[1], [1, 2]], [3])


class SpaceRaises(Survive):
    @property
    def action_space(self):
        raise RuntimeError("no space")


class LimitIsTrue(Survive):
    max_episode_steps = True


class LimitRaises(Survive):
    @property
    def max_episode_steps(self):
        raise RuntimeError("no limit")


class LimitMissing(Survive):
    max_episode_steps = None


class ThresholdRaises(Survive):
    @property
    def reward_threshold(self):
        return {}["return"]


class Exits(Survive):
    def __init__(self):
        raise SystemExit(3)


class LongMessage(Survive):
    def __init__(self):
        raise ValueError("x" * 10_000)


def not_called():
    return Survive


class LimitIsText(Survive):
    max_episode_steps = "many"


class LimitIsZero(Survive):
    max_episode_steps = 0


class ThresholdIsNan(Survive):
    reward_threshold = float("nan")


class ResetRaises(Survive):
    def reset(self, rng):
        return self.start


class ResetReturnsNone(Survive):
    def reset(self, rng):
        return None


class ResetWithoutReward(Survive):
    def reset(self, rng):
        return super().reset(rng).replace(reward=None)


class ObservationDict(Survive):
    def observe(self, key):
        return {"position": jnp.zeros(2)}


class ObservationMatrix(Survive):
    def observe(self, key):
        return jnp.zeros((2, 3))


class ObservationNumber(Survive):
    def observe(self, key):
        return jnp.zeros(())


class ObservationEmpty(Survive):
    def observe(self, key):
        return jnp.zeros(0)


class ObservationComplex(Survive):
    def observe(self, key):
        return jnp.zeros(2, jnp.complex64)


class RewardVector(Survive):
    def reset(self, rng):
        return super().reset(rng).replace(reward=jnp.zeros(1))


class DoneVector(Survive):
    def reset(self, rng):
        return super().reset(rng).replace(done=jnp.zeros(3))


class StepExits(Survive):
    def step(self, state, action):
        raise SystemExit(3)


class StepTypo(Survive):
    def step(self, state, action):
        return state.replace(reward=reward)  # noqa: F821


class StepBranches(Survive):
    def step(self, state, action):
        return state if action[0] > 0 else state.replace(done=jnp.ones(()))


class StepCallsNumpy(Survive):
    def step(self, state, action):
        return state.replace(reward=np.sum(np.asarray(action)))


class StepReturnsTuple(Survive):
    def step(self, state, action):
        return state.obs, 0.0, False, {}


class StepRewardVector(Survive):
    def step(self, state, action):
        return state.replace(reward=action**2)


class StepObservationGrows(Survive):
    def step(self, state, action):
        return state.replace(obs=jnp.concatenate([state.obs, action]))


class StepRewardFloat(Survive):
    def reset(self, rng):
        return super().reset(rng).replace(reward=jnp.zeros((), jnp.int32))


class StepAddsInfo(Survive):
    def step(self, state, action):
        return state.replace(info={"distance": jnp.zeros(())})


class Pole(MujocoEnv):
    """Does everything right; the others change one thing."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(MujocoEnv.Settings):
        """Arguments of Pole."""

        xml_file: str = "inverted_pendulum.xml"
        frame_skip: int = 1
        max_episode_steps: int = 5
        reward_threshold: float | None = None
        solver: str = "mjx"

    def initial(self, rng):
        return jax.random.uniform(rng, (2,)), jnp.zeros(2)

    def outcome(self, before, data, action):
        return data.qpos[0], False, {}


class OutcomeOfTwo(Pole):
    def outcome(self, before, data, action):
        return data.qpos[0], False


class OutcomeIsNumber(Pole):
    def outcome(self, before, data, action):
        return data.qpos[0]


class OutcomeRewardVector(Pole):
    def outcome(self, before, data, action):
        return data.qpos, False, {}


class OutcomeRewardOne(Pole):
    def outcome(self, before, data, action):
        return -(action**2), False, {}


class OutcomeRewardNone(Pole):
    def outcome(self, before, data, action):
        return None, False, {}


class OutcomeEndVector(Pole):
    def outcome(self, before, data, action):
        return data.qpos[0], jnp.abs(data.qpos) > 1, {}


class OutcomeTermVector(Pole):
    def outcome(self, before, data, action):
        return data.qpos[0], False, {"cost": action}


class OutcomeTermsList(Pole):
    def outcome(self, before, data, action):
        return data.qpos[0], False, [data.qpos[0]]


class OutcomeNoField(Pole):
    def outcome(self, before, data, action):
        return data.qposition[0], False, {}


class InitialOfOne(Pole):
    def initial(self, rng):
        return jnp.zeros(2)


class InitialOfIntegers(Pole):
    """Is no mistake: they become numbers."""

    def initial(self, rng):
        return jnp.zeros(2, int), jnp.zeros(2, int)


class InitialTooLong(Pole):
    def initial(self, rng):
        return jnp.zeros(3), jnp.zeros(2)


class ObserveMatrix(Pole):
    def observe(self, data):
        return jnp.stack([data.qpos, data.qvel])


class SettingsWithoutDefaults(MujocoEnv):
    def initial(self, rng):
        return jnp.zeros(2), jnp.zeros(2)

    def outcome(self, before, data, action):
        return data.qpos[0], False, {}


class WrongSetting(Pole):
    def __init__(self):
        super().__init__(frame_skip="two")


class UnknownSetting(Pole):
    def __init__(self):
        super().__init__(skip=2)


class NoSuchModel(Pole):
    def __init__(self):
        super().__init__(xml_file="./nowhere.xml")


def not_registered():
    return envs.make("Nowhere-v0")

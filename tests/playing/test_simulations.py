"""Which simulation plays a policy, by what is asked and where the policy comes from."""

import types
from pathlib import Path

import pytest
from toys import Survive

from mjx_reinforce.envs.base import MujocoEnv
from mjx_reinforce.playing import mujoco_playing
from mjx_reinforce.playing.cast import PolicySource

RUN = types.SimpleNamespace(directory=Path("run"), env_set=())
CHANGED = types.SimpleNamespace(directory=Path("run"), env_set=("frame_skip=2", "solver=mjx"))
PLAYER = types.SimpleNamespace(observation_size=1)


@pytest.fixture
def chosen(monkeypatch):
    """Names of what plays, with what they were given."""
    monkeypatch.setattr(mujoco_playing, "mujoco_simulator", lambda *given: ("C", *given[2:]))
    monkeypatch.setattr(mujoco_playing, "simulator", lambda *given: ("MJX", *given[2:]))
    monkeypatch.setattr(mujoco_playing, "gymnasium_simulator", lambda *given: ("1.4", "theirs"))

    def of(backend, *, run=None, mujoco=False):
        env = MujocoEnv.__new__(Plain) if mujoco else Survive()
        source = PolicySource("Task-v0", 60, run)
        return mujoco_playing.simulators(backend, env, PLAYER, source)  # pyright: ignore

    return of


class Plain(MujocoEnv):
    """A task on a model, which is not built."""

    def initial(self, rng):
        """Starts nowhere."""

    def outcome(self, before, data, action):
        """Earns nothing."""


@pytest.mark.parametrize(
    ("asked", "plays"),
    [
        ({}, {"mjx": ("MJX", 60)}),
        ({"mujoco": True}, {"mujoco": ("C", 60)}),  # quicker, and it is the package's policy
        ({"mujoco": True, "run": RUN}, {"mjx": ("MJX", 60)}),
    ],
)
def test_where_nothing_is_asked(chosen, asked, plays):
    assert chosen(None, **asked) == plays


def test_what_is_asked(chosen):
    assert chosen("mujoco", run=RUN) == {"mujoco": ("C", 60)}
    assert chosen("mjx", mujoco=True) == {"mjx": ("MJX", 60)}
    both = chosen("gymnasium", run=RUN)
    assert [*both.items()] == [("mjx", ("MJX", 60)), ("gymnasium 1.4", "theirs")]
    assert chosen("mjx", run=CHANGED) == {"mjx": ("MJX", 60)}


def test_gymnasium_plays_no_task_with_other_settings(chosen):
    said = "plays Task-v0 as it is, and run was trained with --env-set frame_skip=2 solver=mjx"
    with pytest.raises(ValueError, match=said):
        chosen("gymnasium", run=CHANGED)


def test_observations_of_another_size_are_refused():
    check, env = mujoco_playing.check_observations, Survive()
    other = types.SimpleNamespace(observation_size=3)
    check(env, PLAYER, PolicySource("Task-v0", 60, RUN))  # pyright: ignore
    check(env, other, PolicySource("Task-v0", 60, None))  # pyright: ignore
    with pytest.raises(
        ValueError, match="policy in run takes observations of 3 entries, Task-v0 has 1"
    ):
        check(env, other, PolicySource("Task-v0", 60, RUN))  # pyright: ignore

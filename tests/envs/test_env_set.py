"""Settings of an environment as texts, from the command line to the files of a run."""

import dataclasses
import json

import pytest
from command_lines import run_command

from mjx_reinforce import envs, watch
from mjx_reinforce.engine.play import objects
from mjx_reinforce.envs.settings import EpisodeSettings, read_settings
from mjx_reinforce.settings.config import Config
from mjx_reinforce.store import kept
from mjx_reinforce.training import resume


class Task:
    """Has settings of each kind."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Settings(EpisodeSettings):
        """Settings of each kind."""

        weight: float = 0.5
        terminates: bool = True
        bounds: tuple[float, float] = (0.0, 1.0)
        name: str = "a"


def test_texts_are_read_by_their_type():
    words = ["weight=1", "terminates=false", "bounds=0.2,inf", "name=x=y", "max-episode-steps=1e3"]
    assert read_settings(Task, [*words, "reward_threshold=none"]) == {
        "weight": 1.0,
        "terminates": False,
        "bounds": (0.2, float("inf")),
        "name": "x=y",
        "max_episode_steps": 1000,
        "reward_threshold": None,
    }


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("weigth=1", "unknown setting of Task 'weigth'. Did you mean 'weight'.*Known: bounds"),
        ("weight=heavy", "weight of Task must be a number, got 'heavy'"),
        ("terminates=2", "must be True or False"),
        ("bounds=a,b", "must be .a number, a number."),
        ("max_episode_steps=1.5", "whole number"),
        ("weight", "takes NAME=VALUE"),
        ("weight=", "takes NAME=VALUE"),
        ("weight=1 weight=2", "weight twice: 1 and 2"),
    ],
)
def test_what_is_no_setting_is_refused(words, said):
    with pytest.raises(ValueError, match=said):
        read_settings(Task, words.split())


def test_what_has_no_settings_is_refused():
    with pytest.raises(ValueError, match="no class with a dataclass Settings"):
        read_settings(len, ["weight=1"])


def test_a_value_out_of_its_range_is_refused_as_by_make():
    with pytest.raises(ValueError, match="frame_skip must be at least 1, got 0"):
        envs.make_set("InvertedPendulum-v5", ["frame_skip=0"])
    with pytest.raises(ValueError, match=r"healthy_z_range of Hopper must be .* got \(0.2, "):
        envs.make_set("Hopper-v5", ["healthy_z_range=0.2,1,3"])


def test_the_table_s_own_settings_hold_beside_those():
    env = envs.make_set("CartPole-v0", ["sutton_barto_reward=true"])
    assert env.settings.sutton_barto_reward
    assert env.max_episode_steps == 200


def test_programs_of_a_model_of_the_user_s_are_not_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(objects, "folder", lambda: tmp_path)
    assert kept.key_of(Config(env_set=("xml_file=./mine.xml",))) is None
    keys = [kept.key_of(Config(env_set=words)) for words in ((), ("frame_skip=2",))]
    assert None not in keys
    assert len(set(keys)) == 2


def test_older_settings_have_none(tmp_path):
    recorded = resume.recordable(Config())
    del recorded["env_set"]
    assert resume.as_config(recorded, tmp_path) == Config()


QUICK = (
    *("--env", "CartPole-v1", "--engine", "vmap", "--hidden-sizes", "4", "--num-seeds", "2"),
    *("--num-episodes", "2", "--eval-episodes", "2", "--max-updates", "2", "--env-steps", "None"),
)


@pytest.mark.slow
def test_a_run_keeps_the_settings_of_its_environment(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ("max_episode_steps=7", "sutton_barto_reward=true")
    assert run_command(*QUICK, "--env-set", *words, "--output", "run") == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["env_set"] == list(words)
    assert config["horizon"] == 7
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    # The other reward is 1 a step.
    assert all(-1 <= x <= 0 for x in summary["final_returns"])
    made = []

    def stop(*given):
        made.append(given)
        raise ValueError("enough")

    monkeypatch.setattr(watch.envs, "make_set", stop)
    assert run_command("run", command=watch) == 2
    assert made == [("CartPole-v1", words)]
    capsys.readouterr()
    assert run_command("--resume", "run", "--env-set", "max_episode_steps=8") == 2
    assert "--env-set is" in capsys.readouterr().err


def test_a_wrong_setting_ends_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(*QUICK, "--env-set", "sutton_bartoreward=true", "--output", "run") == 2
    assert "Did you mean 'sutton_barto_reward'?" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()

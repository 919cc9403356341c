"""The command line as a stranger finds it: its menu, its help, its hints. Nothing is compiled."""

import importlib.metadata
import re
import subprocess
import sys

import pytest

from mjx_reinforce import __main__ as script
from mjx_reinforce import envs, registry
from mjx_reinforce.checks import whole_number
from mjx_reinforce.envs.__main__ import main as envs_main
from mjx_reinforce.runs import commands, lines
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.runs.defaults import of_task
from mjx_reinforce.runs.settings import MAIN


@pytest.fixture
def call(monkeypatch, tmp_path, capsys):
    """Runs ``mjx-reinforce`` to where a command would begin; returns status, output and error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["/bin/mjx-reinforce", *arguments])
        with pytest.raises(SystemExit) as stop:
            script.main()
        printed = capsys.readouterr()
        return stop.value.code, printed.out, printed.err

    return call


# The menu.


def test_alone_it_is_a_menu_of_all_commands(call):
    for arguments in ([], ["--help"], ["help"]):
        status, out, _ = call(*arguments)
        assert status == 0
        for name in commands.COMMANDS:
            assert f"mjx-reinforce {name} " in out


def test_it_says_its_version(call):
    version = importlib.metadata.version("mjx-reinforce")
    assert call("--version") == (0, f"mjx-reinforce {version}\n", "")


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_every_command_explains_itself(call, name):
    status, out, _ = call(name, "--help")
    assert status == 0
    assert out.startswith(f"usage: mjx-reinforce {name} ")


@pytest.mark.parametrize(
    "arguments", [["--num-seeds", "0"], ["gymnasium-tutorial", "--seed", "-1"]]
)
def test_flags_or_a_preset_alone_train(call, arguments):
    status, _, err = call(*arguments)
    assert status == 2
    assert "--num-seeds must be at least 1" in err or "--seed must be in" in err


def test_commands_are_called_as_this_one_was(monkeypatch):
    for called, said in {
        "/usr/bin/mjx-reinforce": "mjx-reinforce watch",
        "C:/Scripts/mjx-reinforce.exe": "mjx-reinforce watch",
        "/lib/mjx_reinforce/__main__.py": "mjx-reinforce watch",
        "/lib/mjx_reinforce/train.py": "python -m mjx_reinforce.watch",
        "train_all.py": "python -m mjx_reinforce.watch",
    }.items():
        monkeypatch.setattr(sys, "argv", [called])
        assert commands.command("watch") == said


# Help.


@pytest.mark.parametrize("name", ["train", "sweep"])
def test_help_has_ten_settings_and_help_all_the_rest(call, name):
    brief, whole = call(name, "--help")[1], call(name, "--help", "all")[1]
    shown, every = (re.findall(r"(?m)^[|│] (--[a-z-]+)", page) for page in (brief, whole))
    assert len(shown) == 10
    if name == "train":
        assert shown == [f"--{name.replace('_', '-')}" for name in MAIN]
    assert set(shown) < set(every)
    assert f"--help all shows all {len(every)} settings" in brief


@pytest.mark.parametrize("columns", [60, 200])
def test_help_wraps_at_words(call, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    shown = call("train", "--help", "all")[1]
    assert max(map(len, shown.splitlines())) <= columns
    words = set(shown.split())
    for word in ("learning_curve.png,", "InvertedPendulum-v5,", "independent", "interrupted,"):
        assert word in words, word


def test_text_wraps_at_words():
    text = f"{'word ' * 30}\n  name    {'what ' * 30}\nmjx_reinforce.{'x' * 70} --flag"
    for columns in (20, 60, 200):
        shown = lines.wrapped(text, columns)
        assert shown.split() == text.split()
        assert all(len(line) <= columns or "x" * 70 in line for line in shown.splitlines())
    first, second = lines.wrapped(f"  name    {'what ' * 8}", 40).splitlines()
    assert (first[:10], second[:10]) == ("  name    ", " " * 10)


# Numbers.


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("1e6", 10**6),
        ("2_000_000", 2 * 10**6),
        ("1e12", 10**12),
        ("7", 7),
        ("-3", -3),
        ("1.5e1", 15),
    ],
)
def test_whole_numbers_are_read_as_people_write_them(text, number):
    assert whole_number(text) == number


@pytest.mark.parametrize("text", ["1.5", "", "many", "nan", "inf", "1e-3", "1e999999999", "1,000"])
def test_what_is_no_whole_number_is_refused(text):
    with pytest.raises(ValueError, match="takes a whole number, such as 4 or 2e6"):
        whole_number(text)


def test_a_budget_with_an_exponent_is_that_budget_and_picks_its_settings():
    for text in ("2e8", "--env_steps=2e8", "200_000_000"):
        arguments = [text] if text.startswith("--") else ["--env-steps", text]
        config = parse(["--env", "Ant-v5", *arguments])
        assert config == of_task("Ant-v5", 200_000_000)
        assert config.num_episodes != of_task("Ant-v5", 500_000).num_episodes
    assert parse(["--hidden-sizes", "3e1", "32"]).hidden_sizes == (30, 32)
    assert parse(["--decay-steps", "1e6"]).decay_steps == 10**6
    assert parse(["--num-episodes", "1e2"]).num_episodes == 100


# What a task is.


def test_a_task_is_described(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["envs", "InvertedPendulum-v5"])
    envs_main()
    said = capsys.readouterr().out
    for text in (
        "observation  4 numbers",
        "1 number in [-3, 3]",
        "at most 1,000 env steps, of 0.04 s each",
        "at a return of 950",
        "mjx_reinforce.train --env InvertedPendulum-v5\n",
        "  --max-kl 0.01\n",
        "compiling takes about",
    ):
        assert text in said, text
    assert "--env-steps" not in said


def test_tasks_are_listed_as_ever():
    command = [sys.executable, "-m", "mjx_reinforce.envs"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.splitlines() == envs.names()


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        *(("hopper", "Hopper-v5"), ("Hopper-v4", "Hopper-v5"), ("cheetah", "HalfCheetah-v5")),
        *(("walker", "Walker2d-v5"), ("Hoper-v5", "Hopper-v5"), ("HUMANOID-V5", "Humanoid-v5")),
        *(("cartpole-v1", "CartPole-v1"), ("xyz", None)),
    ],
)
def test_the_nearest_name_is_found(typed, meant):
    assert registry.nearest(typed, envs.names()) == meant

"""The command line as a stranger finds it: its menu, its help, its hints. Nothing is compiled."""

import importlib.metadata
import os
import re
import subprocess
import sys

import pytest
from places import PYTHONPATH, ROOT

from mjx_reinforce import __main__ as script
from mjx_reinforce import envs
from mjx_reinforce.console import commands
from mjx_reinforce.engine import checks
from mjx_reinforce.engine.checks import whole_number
from mjx_reinforce.envs.__main__ import main as envs_main
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings.config import Config
from mjx_reinforce.settings.defaults import PRESETS, of_task
from mjx_reinforce.watch import choose_run


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


def test_every_command_explains_itself(call):
    for name in commands.COMMANDS:
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


def test_a_sweep_records_what_was_typed(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/mjx-reinforce", "--over", "policy", "a b"])
    assert commands.typed("sweep") == "mjx-reinforce sweep --over policy 'a b'"
    monkeypatch.setattr(sys, "argv", ["my study.py", "7"])
    assert commands.typed("sweep") == "'my study.py' 7"


# Help.


@pytest.mark.parametrize("name", ["train", "sweep"])
def test_help_has_every_setting_and_the_presets(call, name):
    page = call(name, "--help")[1]
    shown = re.findall(r"(?m)^[|│ ] (--[a-z][a-z-]+)", page)
    assert {f"--{name.replace('_', '-')}" for name in vars(Config())} <= set(shown)
    assert all(preset in page for preset in PRESETS)


# Numbers.


def test_whole_numbers_are_read_as_people_write_them():
    numbers = {"1e6": 10**6, "2_000_000": 2 * 10**6, "1e12": 10**12, "-3": -3, "1.5e1": 15}
    assert {text: whole_number(text) for text in numbers} == numbers
    for text in ("1.5", "", "many", "nan", "inf", "1e-3", "1e999999999", "1,000"):
        with pytest.raises(ValueError, match="takes a whole number, such as 4 or 2e6"):
            whole_number(text)


def test_a_budget_with_an_exponent_is_that_budget_and_picks_its_settings():
    for arguments in (["--env-steps", "2e8"], ["--env_steps=200_000_000"]):
        config = parse(["--env", "Ant-v5", *arguments]).base
        assert config == of_task("Ant-v5", 200_000_000)
        assert config.num_episodes != of_task("Ant-v5", 500_000).num_episodes


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
        "--minutes M sets a time",
    ):
        assert text in said, text
    assert "--env-steps" not in said


def test_tasks_are_listed_as_ever():
    command = [sys.executable, "-m", "mjx_reinforce.envs"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.splitlines() == envs.names()


def test_the_nearest_name_is_found():
    meant = {
        "Hopper-v5": "hopper Hopper-v4 Hoper-v5",
        "HalfCheetah-v5": "cheetah",
        "Walker2d-v5": "walker",
        "Humanoid-v5": "HUMANOID-V5",
        "CartPole-v1": "cartpole-v1",
        "CartPole-v0": "cartpol-v0",
        "InvertedPendulum-v5": "InvertedPendulum",
        None: "xyz nope Pong-v5",
    }
    for right, words in meant.items():
        for typed in words.split():
            assert checks.nearest(typed, envs.names()) == right, typed


# The newest run.


def test_without_a_name_the_newest_run_plays(call, monkeypatch, tmp_path):
    status, _, err = call("watch")
    assert status == 2
    assert "mjx-reinforce train trains one" in err
    for name, written in {"first": 100, "last": 300, "second": 200}.items():
        run = tmp_path / "runs" / name
        (run / "policy").mkdir(parents=True)
        (run / "config.json").write_text("{}")
        os.utime(run / "policy", (written, written))
    (tmp_path / "runs" / "unfinished").mkdir()
    (tmp_path / "runs" / "unfinished" / "config.json").write_text("{}")
    assert "runs/last/config.json is damaged" in call("watch")[2]
    assert "runs/first/config.json is damaged" in call("watch", "runs/first")[2]
    assert choose_run(tmp_path / "runs") == tmp_path / "runs/last"
    assert choose_run(tmp_path / "HalfCheetah-v5") == tmp_path / "HalfCheetah-v5"


# Mistakes.

#: What a stranger may type after ``mjx-reinforce``, and what the answer must say.
#: More of what cannot be read is in settings/test_flags.py.
MISTAKES = {
    "Hopper-v5": "'Hopper-v5' is a task: write mjx-reinforce train --env Hopper-v5",
    "sweep Hopper-v5 --over discount 0.9 1": "write mjx-reinforce train --env Hopper-v5",
    "train --env Hoper-v5": "unknown environment 'Hoper-v5'. Did you mean 'Hopper-v5'?",
    "train --env nope": "unknown environment 'nope'. Known: Ant-v5,",
    "train --env my_arm": "Your own is named module:Class.",
    "envs Hoper": "Did you mean 'Hopper-v5'?",
    "trian": "Did you mean 'train'?",
    "train --seeds 3": "'3'; --num-seeds says how many",
    "train --learning-rat=0.1": "--learning-rate FLOAT",
    "train --env-steps 1M": "takes a whole number, such as 4 or 2e6, got '1M'",
    "watch --output film.avi runs/first": "runs/first is not a run directory",
    "sweep": "nothing is swept: give --over a setting and its values, such as --over learning-rate",
    "sweep --over learning-rat 1 2": "Did you mean 'learning-rate'?",
    "report": "there is nothing to report on: name a run or a sweep directory",
    "report nowhere": "there is no directory nowhere; name that of a run or a sweep",
    "export": "Missing from mjx-reinforce export",
}


@pytest.mark.parametrize("typed", MISTAKES)
def test_a_mistake_gets_the_remedy(call, typed):
    status, out, err = call(*typed.split())
    assert (status, out) == (2, "")
    assert MISTAKES[typed] in " ".join(err.split())


@pytest.mark.slow
def test_a_script_sees_modules_of_the_current_folder():
    """Python leaves that folder out for scripts, as -P does for modules."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "mjx_reinforce.envs", "my_arm:Arm"],
        cwd=ROOT / "experiments" / "examples",
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "action       3 numbers" in done.stdout

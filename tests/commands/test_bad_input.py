"""Bad input: an error of one or two lines, status 2, nothing compiled, nothing left on the disk.

First command lines and calls by hand, then settings drawn at random.
"""

import contextlib
import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
import typing
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.table import Table
from saved_runs import make_run
from toys import Survive

from mjx_reinforce import ars, envs, reinforce
from mjx_reinforce import train as train_module
from mjx_reinforce.console import jax_setup
from mjx_reinforce.registry import DISTRIBUTIONS, ESTIMATORS
from mjx_reinforce.runs import display
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings.config import Config, check, marked
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.settings.presets import PRESETS
from mjx_reinforce.settings.relevance import as_words, changed, check_read, is_read
from mjx_reinforce.store.build import build


@pytest.fixture
def refused(run, monkeypatch, tmp_path, capsys):
    """Runs a command line that must be refused, and returns what it said."""
    monkeypatch.setattr(train_module, "train", lambda *_: pytest.fail("it was not refused"))

    def refuse(*arguments):
        before = sorted(tmp_path.rglob("*"))
        assert run(*arguments) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") <= 2
        assert len(printed.err) < 1000
        assert sorted(tmp_path.rglob("*")) == before
        return printed.err

    return refuse


#: Begins a command without root's right to enter every folder.
AS_A_USER = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] * (os.geteuid() == 0)


@pytest.mark.skipif(
    bool(AS_A_USER) and shutil.which("setpriv") is None, reason="root may enter every folder"
)
@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train --output closed/run", "cannot write to the run directory closed/run (Permission"),
        ("train --output circle", "directory circle (Too many levels of symbolic links)"),
        ("train --output circle/run", "directory circle/run (Too many levels of symbolic links)"),
        ("sweep --over discount 1 0.9 --output closed/run", "closed/run (Permission denied)"),
        ("train --resume closed/run", "closed/run/config.json (Permission denied)"),
        ("sweep --resume closed/run", "closed/run/sweep.json (Permission denied)"),
        ("watch closed/run", "Permission denied"),
        ("report closed/run", "Permission denied"),
        ("export closed/run --to numpy", "Permission denied"),
        ("export run --to numpy --output closed/run.npz", "closed"),
        ("watch run --output closed/run.gif", "closed"),
        ("report run --output closed/run.html", "closed"),
        ("report run --output circle/run.html", "circle"),
    ],
)
def test_folders_that_may_not_be_entered_are_named(tmp_path, command, message):
    make_run(tmp_path / "run")
    (tmp_path / "closed").mkdir(0)
    (tmp_path / "circle").symlink_to("circle")
    module, *arguments = command.split()
    python = [*AS_A_USER, sys.executable, "-m", f"mjx_reinforce.{module}"]
    done = subprocess.run([*python, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2, done
    (said,) = done.stderr.splitlines()
    assert message in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--algorithm ars --learning-rate 0.1", "only --algorithm reinforce reads that"),
        ("--algorithm ars --discount 0.5 --no-standardize", "leave them out"),
        ("--algorithm ars --num-episodes 5", "--num-episodes 5 would do nothing"),
        ("--algorithm ars --estimator value-baseline --value-fits 3", "would do nothing"),
        ("--algorithm ars --max-grad-norm None", "--max-grad-norm None would do nothing"),
        ("--num-directions 4", "--num-directions 4 would do nothing: only --algorithm ars"),
        ("--seeds 4:4", "--seeds must be FIRST:END, such as 64:128, got '4:4'"),
        ("--seeds 64", "--seeds must be FIRST:END"),
        ("--seeds 0:4 --num-seeds 4", "--seeds 0:4 says how many seeds there are"),
        ("--shared-starts --step-size 0.5", "--step-size 0.5 --shared-starts would do nothing"),
        ("--minibatch-size 64", "only --update minibatches reads that; leave it out"),
        ("--minibatch-updates 5", "choose --update minibatches"),
        ("--natural-damping 1e-2", "only --update natural-gradient reads that"),
        ("--update natural-gradient --max-kl 0.01 --momentum 0.7", "would do nothing"),
        ("--update natural-gradient --max-kl 0.01 --optimizer sgd", "another --update"),
        (
            "--env CartPole-v1 --update natural-gradient --max-kl 0.01 --learning-rate 0.1",
            "only another --update than natural-gradient, or --final-learning-rate reads that",
        ),
        (
            "--env Reacher-v5 --update natural-gradient --hidden-sizes --natural-iterations 5",
            "only hidden layers or another --policy than normal reads that",
        ),
        ("--value-fits 5", "only --estimator value-baseline"),
        (
            "--estimator reward-to-go --ended-episodes skip",
            "only --estimator leave-one-out reads that",
        ),
        ("--algorithm ars --reward-shift 1", "--reward-shift 1.0 would do nothing"),
        ("--value-batch-size 64", "choose --estimator value-baseline"),
        (
            "--estimator value-baseline --value-fit full-batch --value-batch-size 64",
            "only --value-fit minibatches reads that",
        ),
        ("--value-hidden-sizes", "--value-hidden-sizes would do nothing"),
        ("--value-learning-rate 1e-2", "choose --estimator value-baseline"),
        ("--final-learning-rate 2e-4 --decay-steps None", "only --decay-steps N"),
        ("--no-standardize --standardize-floor 1", "only --standardize reads that"),
        ("--update minibatches --loss-per step", "only --update full-batch"),
        ("--env CartPole-v1 --policy categorical --initial-std 0.3", "standard deviation"),
        ("--env CartPole-v1 --policy categorical --no-rescale", "continuous actions"),
        ("--algorithm ars --initial-std 0.3", "standard deviation"),
        # What auto stands for depends on the actions of the environment.
        ("--env CartPole-v1 --initial-std 0.3", "--initial-std 0.3 would do nothing"),
        ("--env CartPole-v1 --no-rescale", "--no-rescale would do nothing"),
        ("--env CartPole-v1 --algorithm ars --no-rescale", "--no-rescale would do nothing"),
        ("--overwrite", "choose --output DIR"),
        ("gymnasium-tutorial --minibatch-size 64", "choose --update minibatches"),
        ("continuous-cartpole-ars --learning-rate 0.1", "choose --algorithm reinforce"),
        ("baseline-truncated-normal --final-learning-rate 1e-5", "--decay-steps N"),
    ],
)
def test_settings_that_would_do_nothing_are_refused(refused, arguments, message):
    assert message in refused(*arguments.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--learning-rate 1e30", "--learning-rate must be in [1e-12, 1000]"),
        ("--learning-rate 1e-60", "got 1e-60"),
        ("--learning-rate inf", "positive and finite, got inf"),
        ("--final-learning-rate 1e9", "a step moves a weight by about that"),
        ("--estimator value-baseline --value-learning-rate 1e9", "--value-learning-rate must be"),
        ("--algorithm ars --step-size 1e9", "--step-size must be"),
        ("--algorithm ars --noise-std 1e20", "in float32"),
        ("--initial-std 1e20", "in float32"),
        ("--initial-std -1", "positive and finite"),
        ("--standardize-floor 1e30", "in float32"),
        ("--entropy-cost -1", "not negative"),
        ("--max-grad-norm nan", "positive and finite, got nan"),
        ("--max-kl 0", "--max-kl must be positive and finite, got 0.0"),
        ("--final-std 0.1 --decay-steps None", "only --decay-steps N reads that"),
        ("--final-std 0.1 --policy normal-softplus", "the same in all states"),
        ("--final-std 0", "--final-std must be positive and finite, got 0.0"),
        ("--algorithm ars --max-kl 0.02", "--max-kl 0.02 would do nothing"),
        ("--discount -0.1", "in [0, 1], got -0.1"),
        (
            "--env CartPole-v1 --update natural-gradient",
            "has the length of its steps from --max-kl, which is None: give a number",
        ),
        (
            "--update natural-gradient --policy tanh-normal",
            "needs a distribution whose KL divergence is known: choose normal,",
        ),
        ("--reward-shift nan", "--reward-shift must be finite, in float32, got nan"),
        ("--seed -1", "--seed must be in [0, 2^32), got -1"),
        ("--eval-seed 4294967296", "--eval-seed must be in [0, 2^32)"),
        ("--eval-every 0", "--eval-every must be at least 1"),
        ("--eval-every 4294967296", "--eval-every must be less than 2^31"),
        ("--horizon 99999999999999999999", "--horizon must be less than 2^31"),
        ("--normalize-steps -1", "at least 0"),
        ("--normalize-steps 99999999999", "less than 2^31"),
        ("--hidden-sizes 32 -1", "positive in every layer"),
        ("--hidden-sizes 99999999999", "less than 2^31 in every layer"),
        ("--decay-steps 0", "--decay-steps must be at least 1"),
        (
            "--update minibatches --minibatch-updates 50000 --decay-updates 50000 "
            "--decay-steps None",
            "decay over 2,500,000,000 optimiser steps",
        ),
        ("--num-seeds abc", "--num-seeds takes a whole number, such as 4 or 2e6, got 'abc'"),
        ("--num-seeds 1.5e0", "--num-seeds takes a whole number, such as 4 or 2e6, got '1.5e0'"),
        ("--num-seeds", "--num-seeds needs a value after it"),
        ("--num-seeds 3 4", "no flag takes '4'"),
        ("--num-seeds 3 gymnasium-tutorial", "a preset comes before all flags"),
        ("--num-sedes 3", "unknown flag '--num-sedes'. Did you mean '--num-seeds'?"),
        ("--num-sedes=3", "unknown flag '--num-sedes'. Did you mean '--num-seeds'?"),
        ("--no-such-thing", "unknown flag '--no-such-thing'."),
        ("-x", "unknown flag '-x'."),
        (
            "--algorithm ppo",
            "--algorithm must be ars or reinforce, or module:name for your own, got 'ppo'",
        ),
        ("--hidden-sizes a", "--hidden-sizes"),
        ("--hidden-sizes 4.5", "--hidden-sizes"),
        ("--learning-rate fast", "--learning-rate"),
        ("--optimizer rmsprop", "--optimizer takes adam or adamw or sgd, got 'rmsprop'"),
        ("--one-start yes", "--one-start is a switch: it takes no value, got 'yes'"),
        ("gymnasium-tutorail", "Did you mean 'gymnasium-tutorial'"),
        ("--env :X", "':X' is not of the form module:Class"),
        ("--env os:", "not of the form module:Class"),
        ("--env a:b:c", "not of the form module:Class"),
        ("--env .relative:X", "not of the form module:Class"),
        ("--env folder/own_model.py:Crane", "is a file: write module:Class, such as own_model"),
        ("--env own_model.py", "'own_model.py' is a file"),
        (
            "--env-steps nan",
            "--env-steps takes a whole number, such as 4 or 2e6, or None, got 'nan'",
        ),
        ("--env-steps 280,000", "such as 4 or 2e6, or None, got '280,000'"),
        (
            "--max-grad-norm none",
            "--max-grad-norm takes a number, such as 0.5, or None, got 'none'",
        ),
        ("--hidden-sizes 32,32", "takes whole numbers with spaces between them, such as 32 32"),
        ("-- --num-seeds 3", "leave -- out"),
        ("--hidden-sizes " + "2 " * 101, "at most 100 layers"),
        ("--update minibatches --minibatch-size 2000000000", "lower --minibatch-size"),
        (
            "--estimator value-baseline --value-fits 2000000000",
            "--value-fits must be at most 1,000,000, for an update makes so many steps",
        ),
        (
            "--update minibatches --minibatch-updates 1000001",
            "--minibatch-updates must be at most 1,000,000",
        ),
        ("--env os:path", "'os:path' is no class or function, but of type module"),
        ("--env bad_envs:A_CONSTANT", "is no class or function, but of type int"),
        ("--env nowhere:X", "No module named 'nowhere'"),
        ("--env os:Nowhere", "has no attribute 'Nowhere'"),
        ("--env json:JSONDecoder", "JSONDecoder is no environment: it has no reset, step"),
        ("--env os:getcwd", "str is no environment"),
        ("--env bad_envs:not_registered", "unknown environment 'Nowhere-v0'"),
        ("--env mjx_reinforce.envs.base:MujocoEnv", "abstract"),
        ("--env CartPole-v1 --policy normal", "continuous action space"),
        ("--env Survive-v0 --policy categorical", "discrete action space"),
        ("--env Survive-v0 --no-shared-trunk", "without a shared trunk"),
        ("--env Survive-v0 --engine kernel", "takes auto or fused or native or vmap, got 'kernel'"),
        ("--env Survive-v0 --output new/deep/run --no-shared-trunk", "without a shared trunk"),
    ],
)
def test_bad_command_lines_are_refused(refused, arguments, message):
    assert message in refused(*arguments.split())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise RuntimeError('the robot\\n\\nis off')", "RuntimeError: the robot is off"),
        ("class Broken(:", "SyntaxError"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("import nowhere_at_all", "No module named 'nowhere_at_all'"),
        ("1 / 0", "ZeroDivisionError: division by zero (own_broken.py, line 1)"),
    ],
)
def test_a_module_that_cannot_be_imported_is_named(refused, monkeypatch, tmp_path, text, message):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_broken", raising=False)
    (tmp_path / "own_broken.py").write_text(text)
    said = refused("--env", "own_broken:Mine")
    assert message in said
    assert "'own_broken:Mine'" in said


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Nothing", "Nothing is no environment: it has no reset, step, action_size"),
        ("NeedsArgument", "missing 1 required positional argument: 'size'"),
        ("Raises", "RuntimeError: no such robot (bad_envs.py, line"),
        ("Refuses", "could not be broadcast together"),
        ("ActionSizeRaises", "ActionSizeRaises.action_size fails: KeyError: 'size' (bad_envs.py"),
        ("ActionSizeIsText", "action_size must be a whole number, 1 or more, got 'one'"),
        ("NoActions", "action_size must be a whole number, 1 or more, got 0"),
        ("ForeignSpace", "ForeignSpace.action_space is a types.SimpleNamespace"),
        ("SpaceOfTwo", "of 1 entries each as action_size says"),
        ("SpaceUpsideDown", "must have low < high"),
        ("LimitIsText", "max_episode_steps must be a whole number, 1 or more, got 'many'"),
        ("ActionSizeIsTrue", "action_size must be a whole number, 1 or more, got True"),
        ("SpaceOfText", "must have low < high"),
        ("SpaceRagged", "must have low < high"),
        ("SpaceRaises", "SpaceRaises.action_space fails: RuntimeError: no space (bad_envs.py"),
        ("LimitIsZero", "got 0"),
        ("LimitIsTrue", "max_episode_steps must be a whole number, 1 or more, got True"),
        ("LimitRaises", "LimitRaises.max_episode_steps fails: RuntimeError: no limit"),
        ("LimitMissing", "declares no max_episode_steps: give a horizon"),
        ("ThresholdRaises", "ThresholdRaises.reward_threshold fails: KeyError: 'return'"),
        ("Exits", "cannot build the environment 'bad_envs:Exits': SystemExit: 3"),
        ("StepExits", "StepExits.step fails: SystemExit: 3"),
        ("LongMessage", "ValueError: xxxx"),
        ("not_called", "Survive is a class, no environment yet: call it"),
        ("ObservationComplex", "must hold real numbers, it holds complex64"),
        ("ThresholdIsNan", "reward_threshold must be a number or None, got nan"),
        ("ResetRaises", "ResetRaises.reset fails: AttributeError:"),
        ("ResetReturnsNone", "whose obs is a vector [O], and there is no obs"),
        ("ResetWithoutReward", "whose reward is a scalar [], and there is no reward"),
        ("ObservationDict", "whose obs is a vector [O], and it is a dict"),
        ("ObservationMatrix", "must be a vector [O], its shape is [2, 3]"),
        ("ObservationNumber", "must be a vector [O], its shape is []"),
        ("ObservationEmpty", "must be a vector [O], its shape is [0]"),
        ("RewardVector", "the reward of RewardVector.reset must be a scalar [], its shape is [1]"),
        ("DoneVector", "the done of DoneVector.reset must be a scalar [], its shape is [3]"),
        ("StepTypo", "StepTypo.step fails: NameError: name 'reward' is not defined (bad_envs.py"),
        ("StepBranches", "StepBranches.step fails: TracerBoolConversionError"),
        ("StepBranches", "it is compiled by JAX: write jnp.where for `if`"),
        ("StepCallsNumpy", "StepCallsNumpy.step fails: TracerArrayConversionError"),
        ("StepReturnsTuple", "with the entries that reset's has"),
        ("StepRewardVector", "reward is float32[] after reset, and float32[1] after step"),
        ("StepObservationGrows", "obs is float32[1] after reset, and float32[2] after step"),
        ("StepRewardFloat", "reward is int32[] after reset, and float32[] after step"),
        ("StepAddsInfo", "info['distance'] only after step"),
        ("OutcomeOfTwo", "OutcomeOfTwo.outcome must return three values"),
        ("OutcomeIsNumber", "got the shape []"),
        ("OutcomeRewardVector", "the reward of OutcomeRewardVector.outcome must be a scalar []"),
        ("OutcomeRewardOne", "got the shape [1]"),
        ("OutcomeRewardNone", "must be a scalar [], got None"),
        ("OutcomeEndVector", "the termination of OutcomeEndVector.outcome must be a scalar []"),
        ("OutcomeTermVector", "the term 'cost' of OutcomeTermVector.outcome must be a scalar []"),
        ("OutcomeTermsList", "must be a dict of the reward's terms, got a list of 1"),
        ("OutcomeNoField", "mjx.Data has no field 'qposition'"),
        ("InitialOfOne", "InitialOfOne.initial must return qpos and qvel, got the shape [2]"),
        ("InitialTooLong", "must return qpos [2], as the model has it, got the shape [3]"),
        ("ObserveMatrix", "must be a vector [O], its shape is [2, 2]"),
        ("SettingsWithoutDefaults", "needs max_episode_steps, reward_threshold, xml_file"),
        ("WrongSetting", "frame_skip of WrongSetting must be a whole number, got 'two'"),
        ("UnknownSetting", "unknown argument of UnknownSetting 'skip'"),
        ("NoSuchModel", "there is no model './nowhere.xml'"),
    ],
)
def test_an_environment_with_a_mistake_is_refused(refused, name, message):
    assert message in refused("--env", f"bad_envs:{name}", "--num-seeds", "1")


def test_the_environments_that_those_change_are_right():
    for id in ("toys:Survive", "bad_envs:Pole", "bad_envs:InitialOfIntegers"):
        build(envs.make(id), Config(env=id, engine="vmap"))


@pytest.mark.parametrize("learner", [reinforce, ars])
def test_learners_refuse_them_too(learner):
    import bad_envs

    with pytest.raises(ValueError, match=r"StepTypo\.step fails: NameError"):
        learner(bad_envs.StepTypo())


MODEL = "<mujoco><worldbody>{}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "XML"),
        ("not a model", "XML"),
        (MODEL.format("<geom size='1'/"), "XML"),
        (MODEL.format("<goem size='1'/>"), "unrecognized element Element .goem., line 1"),
        (MODEL.format("<geom size='a'/>"), "line 1"),
        (MODEL.format("<geom type='mesh' mesh='far'/>"), "far"),
        (MODEL.format("<body><joint/></body>"), "mass"),
        (MODEL.format(""), "no actuators"),
    ],
)
def test_an_error_in_a_model_names_the_file(monkeypatch, tmp_path, text, message):
    monkeypatch.chdir(tmp_path)
    Path("mine.xml").write_text(text)
    with pytest.raises(ValueError, match=rf"'\./mine\.xml'.*{message}") as caught:
        envs.make("InvertedPendulum-v5", xml_file="./mine.xml")
    assert str(caught.value).count("\n") <= 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.xml"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frame_skip": 1.5}, "frame_skip of InvertedPendulum must be a whole number, got 1.5"),
        ({"max_episode_steps": None}, "must be a whole number, got None"),
        ({"reward_threshold": "high"}, "must be a number or None, got 'high'"),
        ({"reset_noise_scale": float("nan")}, "must be a number, got nan"),
        ({"reset_noise_scale": True}, "must be a number, got True"),
        ({"xml_file": Path("a/b.xml")}, "xml_file of InvertedPendulum must be text"),
        ({"solver": None}, "solver of InvertedPendulum must be text, got None"),
    ],
)
def test_arguments_of_the_wrong_type_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        envs.make("InvertedPendulum-v5", **wrong)


@pytest.mark.parametrize(
    ("id", "entry", "message"),
    [
        ("CartPole-v1", Survive, "already registered"),
        ("mine:Own", Survive, "letters, digits"),
        ("../away", Survive, "letters, digits"),
        ("Mine-v0", "bad_envs:Pole", "must be a class or function"),
    ],
)
def test_what_cannot_be_registered_is_refused(id, entry, message):
    with pytest.raises(ValueError, match=message):
        envs.register(id, entry)
    assert envs._TABLE.get(id, (None,))[0] is not entry


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_seeds": "4"},
        {"num_seeds": 2.5},
        {"num_seeds": True},
        {"algorithm": "ppo"},
        {"hidden_sizes": 32},
        {"hidden_sizes": (32, None)},
        {"standardize": 1},
        {"env": None},
        {"learning_rate": "fast"},
        {"learning_rate": None},
        {"output": "out"},
    ],
)
def test_settings_of_the_wrong_type_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=f"--{name.replace('_', '-')} must be "):
        check(Config(**wrong))


# What is read.


class Watched:
    """Settings that remember which of them were looked at."""

    def __init__(self, config):
        self._config, self.read = config, set()

    def __getattr__(self, name):
        self.read.add(name)
        return getattr(self._config, name)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"algorithm": "ars", "hidden_sizes": ()},
        {"update": "minibatches"},
        {"update": "each-step"},
        {"standardize": False, "estimator": "value-baseline"},
    ],
)
def test_the_marks_say_what_is_read(changes):
    """Of the settings with readers, building looks at those whose readers' conditions hold."""
    config = Config(env="Survive-v0", engine="vmap", **changes)
    watched = Watched(config)
    build(Survive(), watched)
    listed = {name for reader in Reader for name in marked(reader)}
    idle = {name for reader in Reader if not reader.holds(config) for name in marked(reader)}
    # These three are always handed on; the policy or the update does not look at them.
    handed = {"initial_std", "rescale", "loss_per"}
    assert (listed - idle) - handed == (listed & watched.read) - handed
    # What programs on disk do not depend on is not built into them: budgets are only checked.
    assert watched.read.isdisjoint({*marked(Mark.NOT_COMPILED)} - {"env_steps", "max_updates"})


@pytest.mark.parametrize("name", [None, *PRESETS])
def test_no_default_is_refused(name):
    """Also where a flag says what holds anyway, or another mode makes presets' settings idle."""
    start = [] if name is None else [name]
    default = parse(start)
    assert parse([*start, "--minibatch-size", str(default.minibatch_size)]) == default
    for algorithm in ("reinforce", "ars"):
        assert parse([*start, "--algorithm", algorithm]).algorithm == algorithm


# What users write is printed as it is.


@pytest.mark.parametrize("text", ["t/[bold]x", "t/[/b]", "t/:smile:", "t/[link=x]y"])
def test_text_is_not_read_as_markup(text, capsys):
    """Neither in lines nor in tables; ``print_summary`` uses the display's console."""
    shown = display.Display()
    shown.say(text)
    shown.say(text, style="yellow")
    table = Table(title=text)
    table.add_row(text)
    shown.console.print(table)
    assert capsys.readouterr().out.count(text) == 4


def test_a_run_in_a_folder_with_brackets_names_it(run, tmp_path, capsys):
    arguments = "--env Survive-v0 --num-seeds 1 --max-updates 1 --hidden-sizes --output t/[/b]é"
    assert run(*arguments.split()) == 0
    assert "t/[/b]é" in capsys.readouterr().out
    assert (tmp_path / "t" / "[/b]é" / "summary.json").exists()


@pytest.mark.parametrize("accent", ["é", "日本", "\U0001f916"])
def test_an_ascii_terminal_shows_escapes(tmp_path, accent):
    code = (
        "from pathlib import Path\n"
        "from mjx_reinforce.console.streams import accept_everything\n"
        "from mjx_reinforce.runs.display import Display\n"
        "accept_everything()\n"
        f"Display().say({accent!r})\n"
    )
    environ = {"PYTHONIOENCODING": "ascii", "LANG": "C", "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environ)
    assert done.returncode == 0, done.stderr
    assert done.stdout.decode("ascii").strip() == ascii(accent).strip("'")
    command = [sys.executable, "-m", "mjx_reinforce.train", "--env", accent]
    done = subprocess.run(command, capture_output=True, env=environ, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.decode("ascii").startswith("error: unknown environment")


@pytest.mark.parametrize("command", ["train", "sweep"])
def test_help_may_be_cut_off(command):
    """As by ``--help | head``."""
    command = [sys.executable, "-m", f"mjx_reinforce.{command}", "--help"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0


@pytest.mark.parametrize("module", ["train", "report"])
@pytest.mark.parametrize("where", [">&-", "> /dev/full", "2>&- >&-"])
def test_help_may_go_nowhere(module, where):
    line = f"{sys.executable} -m mjx_reinforce.{module} --help {where}"
    done = subprocess.run(line, shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_words_that_nobody_reads_end_no_sweep_of_a_script(monkeypatch):
    """Whose streams are its own: rich would end it."""
    read, write = os.pipe()
    os.close(read)
    nobody = open(write, "w")  # noqa: SIM115 (closing it fails)
    monkeypatch.setattr(sys, "stdout", nobody)
    shown = display.Display()
    shown.say("first")
    shown.say("second")
    with contextlib.suppress(BrokenPipeError):
        nobody.close()


def test_a_run_that_nobody_reads_goes_on(run, monkeypatch, tmp_path):
    """As by ``| head -1``: what it says is lost, what it makes is not."""
    arguments = "--env Survive-v0 --num-seeds 1 --max-updates 2 --hidden-sizes --output out"
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as nobody, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", nobody)
        patch.setattr(sys, "stderr", nobody)
        assert run(*arguments.split()) == 0
    assert json.loads((tmp_path / "out/summary.json").read_text())["status"] == "finished"


@pytest.mark.parametrize("columns", ["1", "20", "0", "x", "200"])
def test_help_is_of_some_hundred_lines_on_every_terminal(monkeypatch, capsys, columns):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit, match="0"):
        parse(["--help", "all"])
    assert capsys.readouterr().out.count("\n") < 500
    assert os.environ["COLUMNS"] == columns


# At random.

_FEW = settings(derandomize=True, deadline=None, database=None, max_examples=150)
_MANY = settings(_FEW, max_examples=1000, suppress_health_check=[HealthCheck.too_slow])
_TEXT = st.text(max_size=8)
_WRONG_NUMBERS = st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1.0, 1e-50])


def named(*kinds):
    """Returns the settings with one of these annotations."""
    return [field.name for field in dataclasses.fields(Config) if field.type in kinds]


#: Whole numbers that are not at least 1 and less than 2^31.
_OTHER_COUNTS = {"seed", "eval_seed", "num_seeds", "normalize_steps", "top_directions"}
_COUNTS = sorted({*named(int, int | None)} - _OTHER_COUNTS)
_NUMBERS, _SWITCHES = named(float, float | None), named(bool)
_SIZES = named(tuple[int, ...])
_NAMES = ["policy", "estimator"]
_NAMES += [f.name for f in dataclasses.fields(Config) if typing.get_origin(f.type) is Literal]
#: Values that must be refused, whatever the other settings are.
WRONG = {
    **dict.fromkeys(
        _COUNTS,
        st.integers(max_value=0) | st.integers(min_value=2**31) | st.floats() | _TEXT,
    ),
    **dict.fromkeys(_NUMBERS, _WRONG_NUMBERS | st.floats(max_value=-1e-9) | _TEXT | st.booleans()),
    **dict.fromkeys(_NAMES, _TEXT | st.none() | st.integers()),
    **dict.fromkeys(_SWITCHES, st.integers() | _TEXT | st.none()),
    **dict.fromkeys(
        _SIZES,
        st.lists(st.integers(max_value=0) | st.floats(), min_size=1, max_size=3).map(tuple)
        | st.integers()
        | _TEXT,
    ),
    **dict.fromkeys(("seed", "eval_seed"), st.integers(max_value=-1) | st.integers(2**32) | _TEXT),
    **dict.fromkeys(
        ("env_steps", "max_updates"),
        st.integers(max_value=0) | st.integers(min_value=2**53 + 1) | st.floats() | _TEXT,
    ),
    "num_seeds": st.integers(max_value=0) | st.floats() | _TEXT,
    "normalize_steps": st.integers(max_value=-1) | st.integers(min_value=2**31) | _TEXT,
    **dict.fromkeys(
        ("discount", "final_discount"),
        st.floats(max_value=-1e-9) | st.floats(min_value=1.001) | st.just(math.nan) | _TEXT,
    ),
    # Seconds are the host's, in float64; the env steps of a time are at most 2^53.
    "minutes": st.floats(max_value=0) | st.sampled_from([math.nan, math.inf]) | _TEXT,
    "reward_shift": st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1e13]) | _TEXT,
    "momentum": st.floats(max_value=-1e-9) | st.floats(min_value=1 - 2**-25) | st.just(math.nan),
    "env": _TEXT.filter(lambda text: ":" not in text) | st.none(),
    "output": _TEXT | st.integers(),
}
#: Values that make sense by themselves.
RIGHT = {
    **dict.fromkeys(_COUNTS, st.integers(1, 9)),
    **dict.fromkeys(_NUMBERS, st.floats(1e-6, 1.0)),
    **dict.fromkeys(_SWITCHES, st.booleans()),
    **dict.fromkeys(_SIZES, st.lists(st.integers(1, 9), max_size=2).map(tuple)),
    "num_seeds": st.integers(1, 9),
    "normalize_steps": st.none() | st.integers(0, 9),
    "decay_steps": st.none() | st.integers(1, 9),
    "decay_updates": st.none() | st.integers(1, 9),
    "top_directions": st.none() | st.integers(1, 9),
    "algorithm": st.sampled_from(["reinforce", "ars"]),
    "policy": st.sampled_from(["auto", *DISTRIBUTIONS]),
    "estimator": st.sampled_from([*ESTIMATORS]),
    "value_fit": st.sampled_from(["minibatches", "full-batch"]),
    "ended_episodes": st.sampled_from(["zero", "skip"]),
    "reward_shift": st.floats(-5.0, 5.0),
    "update": st.sampled_from(["full-batch", "natural-gradient", "minibatches", "each-step"]),
    "ars_update": st.sampled_from(["paper", "document"]),
    "loss_per": st.sampled_from(["episode", "step"]),
    "initializer": st.sampled_from(["orthogonal", "torch"]),
    "optimizer": st.sampled_from(["adam", "adamw", "sgd"]),
}
_SOME_RIGHT = st.fixed_dictionaries({}, optional=RIGHT)
#: Of these, values that most of the others go with.
_SOCIABLE = RIGHT | {
    "num_episodes": st.integers(2, 9),
    "num_directions": st.integers(9, 18),
    "policy": st.sampled_from(["normal-softplus", "normal-sigmoid"]),
    "decay_updates": st.none(),
    "minutes": st.none(),
    "ars_update": st.just("paper"),
}
_SOME_SOCIABLE = st.fixed_dictionaries({}, optional=_SOCIABLE)


def refusal(function):
    """Returns what a function said when it refused, or None; any other exception goes on."""
    try:
        function()
    except ValueError as error:
        message = str(error)
        return message if 0 < len(message.splitlines()) <= 2 else pytest.fail(message)
    except SystemExit as stop:  # --help
        return pytest.fail(f"exit {stop.code}") if stop.code else None
    return None


@_MANY
@given(
    st.sampled_from(sorted(WRONG)).flatmap(lambda n: st.tuples(st.just(n), WRONG[n])), _SOME_RIGHT
)
def test_settings_out_of_range_are_refused(wrong, others):
    name, value = wrong
    assert refusal(lambda: check(Config(**(others | {name: value}))))


def readable(given):
    """Returns settings of which each is read, and the names of those that were given."""
    while idle := [n for n in given if not is_read(n, Config(**{"engine": "vmap"} | given))]:
        given = {name: value for name, value in given.items() if name not in idle}
    return Config(**{"engine": "vmap"} | given), list(given)


def test_settings_that_make_sense_alone_build_or_are_refused():
    """Most of them build."""
    built = []

    @_FEW
    @given(_SOME_SOCIABLE)
    def each(given):
        config, _ = readable(given)
        check_read(config, changed(config, Config()))

        def make():
            check(config)
            build(Survive(), config)

        built.append(refusal(make) is None)

    each()
    assert len(built) >= 150
    assert np.mean(built) >= 0.8


_FLAGS = sorted(f"--{name.replace('_', '-')}" for name in {**WRONG, **RIGHT})
_WORDS = st.sampled_from(_FLAGS) | _TEXT | st.integers().map(str) | st.floats().map(str)
_WORDS |= st.sampled_from(["None", "True", "--", "-", "=", "--=", "nan", "1e400", "[bold]", "{}"])


def test_command_lines_are_read_or_refused():
    """Most are read, each flag as it was meant; with one word of another line in it, or refused."""
    read = []

    @_FEW
    @given(_SOME_SOCIABLE, _WORDS, st.integers(0, 99), st.booleans())
    def each(given, wrong, place, instead):
        config, names = readable(given)
        words = [word for name in names for word in as_words(name, getattr(config, name))]

        def parsed():
            found = parse(words)
            assert {n: getattr(found, n) for n in names} == {n: getattr(config, n) for n in names}
            check(found)

        read.append(refusal(parsed) is None)
        place %= len(words) + 1
        corrupted = [*words[:place], wrong, *words[place + instead :]]
        refusal(lambda: check(parse(corrupted)))

    each()
    assert len(read) >= 150
    assert np.mean(read) >= 0.8


def test_a_machine_without_the_chosen_device_is_named(monkeypatch):
    def none():
        raise RuntimeError("Unable to initialize backend 'tpu'")

    monkeypatch.setattr(jax, "devices", none)
    with pytest.raises(ValueError, match="JAX cannot compute here: Unable to initialize"):
        jax_setup.configure_jax()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="it needs a JAX without CUDA")
def test_a_platform_without_its_plugin_is_named():
    code = "from mjx_reinforce.console.jax_setup import configure_jax as f\ntry: f()\n"
    code += "except ValueError as error: print(error)"
    where = os.environ | {"JAX_PLATFORMS": "cuda"}
    said = subprocess.run([sys.executable, "-c", code], env=where, capture_output=True, text=True)
    assert "JAX_PLATFORMS is 'cuda', for which no plugin is installed" in said.stdout


@pytest.mark.parametrize("name", jax_setup._REFUSED)
def test_what_the_commands_cannot_work_with_is_named(name):
    before = jax.config.values[name.lower()]
    jax.config.update(name.lower(), "disallow" if name == "JAX_TRANSFER_GUARD" else True)
    try:
        with pytest.raises(ValueError, match=f"{name} is set, but .*; unset it"):
            jax_setup.configure_jax()
    finally:
        jax.config.update(name.lower(), before)

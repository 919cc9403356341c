"""Bad input: an error of one or two lines, status 2, nothing compiled, nothing left on the disk.

Tables of what is refused and in which words, then settings drawn at random.
"""

import contextlib
import dataclasses
import errno
import math
import os
import re
import shutil
import subprocess
import sys
import typing
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import PYTHONPATH
from rich.table import Table
from saved_runs import make_run
from toys import Survive

from mjx_reinforce import ars, envs, reinforce
from mjx_reinforce.console import jax_setup
from mjx_reinforce.registry import ESTIMATORS
from mjx_reinforce.runs import display
from mjx_reinforce.runs.command_line import parse
from mjx_reinforce.settings.config import (
    Config,
    as_words,
    changed,
    check,
    check_read,
    is_read,
    marked,
)
from mjx_reinforce.settings.declare import Mark
from mjx_reinforce.settings.defaults import PRESETS
from mjx_reinforce.settings.flags import run_command
from mjx_reinforce.settings.groups import Reader
from mjx_reinforce.setup.build import build

# Settings that make no sense.

NATURAL = {"update": "natural-gradient", "max_kl": 0.01}
#: What is said of settings; each range and each rule once.
NONSENSE = {
    "--num-seeds must be at least 1, got 0": {"num_seeds": 0},
    "--normalize-steps must be at least 0, got -1": {"normalize_steps": -1},
    "--max-updates must be at most 2^53": {"max_updates": 2**53 + 1},
    "--horizon must be less than 2^31, got 2147483648": {"horizon": 2**31},
    "--discount must be in [0, 1], got 1.5": {"discount": 1.5},
    "--momentum must be in [0, 1 - 2^-24]": {"momentum": 1.0},
    "in [1, 2^31) in every layer, got (32, 0)": {"hidden_sizes": (32, 0)},
    "--max-grad-norm must be positive and finite, got nan": {"max_grad_norm": math.nan},
    "--entropy-cost must be finite and not negative, got -1": {"entropy_cost": -1.0},
    "--num-seeds must be a whole number, got True": {"num_seeds": True},
    "--hidden-sizes must be a tuple, each entry a whole number": {"hidden_sizes": (32, None)},
    "--learning-rate must be a number, got None": {"learning_rate": None},
    "--output must be Path or None, got 'out'": {"output": "out"},
    "--optimizer must be one of 'adam', 'sgd', got 'rms'": {"optimizer": "rms"},
    "unknown algorithm 'ppo'. Known: ars,": {"algorithm": "ppo"},
    "unknown policy 'gaussian'": {"policy": "gaussian"},
    "Did you mean 'leave-one-out'": {"estimator": "leave-one"},
    "Did you mean 'InvertedPendulum-v5'": {"env": "InvertedPendulm-v5"},
    "':X' is not of the form module:Class": {"env": ":X"},
    "'a/own.py:Crane' is a file: write module:Class, such as own_model": {"env": "a/own.py:Crane"},
    "nothing would end this run": {"env_steps": None},
    "at least two episodes": {"num_episodes": 1},
    "no log-probability": {"policy": "deterministic"},
    "has the length of its steps from --max-kl, which is None": {"update": "natural-gradient"},
}


@pytest.mark.parametrize("words", NONSENSE)
def test_settings_that_make_no_sense_are_refused(words):
    with pytest.raises(ValueError, match=re.escape(words)):
        check(Config(**NONSENSE[words]))


#: Settings that would do nothing, by what would read them.
IDLE = {
    Reader.GRADIENT: {"discount": 0.5, "algorithm": "ars"},
    Reader.REINFORCE: {"max_kl": 0.5, "algorithm": "categorical-cartpole"},
    Reader.VALUE_BASELINE: {"value_batch_size": 64},
    Reader.CUT: {"whole_after": 0.5},
    Reader.OPTIMIZER: NATURAL | {"optimizer": "sgd"},
    Reader.FIRST_RATE: NATURAL | {"learning_rate": 0.1},
    Reader.DECAY: {"final_learning_rate": 1e-3, "decay_steps": None},
    Reader.NORMALIZATION: {"normalize_steps": 0, "normalize_min_std": 0.1},
    Reader.ADAM: {"optimizer": "sgd", "momentum": 0.5},
    Reader.FREE_STD: {"final_std": 0.1, "policy": "normal-softplus"},
    Reader.STD: {"initial_std": 0.3, "algorithm": "ars"},
}


@pytest.mark.parametrize("reader", Reader)
def test_settings_that_would_do_nothing_are_refused(reader):
    words = re.escape(f"would do nothing: only {reader.words} reads that; leave it out, or choose")
    with pytest.raises(ValueError, match=words):
        check_read(Config(**IDLE[reader]), IDLE[reader])


@pytest.fixture
def refused(run, monkeypatch, tmp_path, capsys):
    """Runs a command line that must be refused, and returns what it said."""
    refused = "mjx_reinforce.runs.conduct.compile_slots"
    monkeypatch.setattr(refused, lambda *_: pytest.fail("it was not refused"))

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


#: What the command line is told: of its words, and of what depends on the environment.
REFUSED = {
    "--num-seeds 0": "--num-seeds must be at least 1, got 0",
    "--algorithm ars --max-kl 0.5 --entropy-cost 0.1": "--entropy-cost 0.1 --max-kl 0.5 would do "
    "nothing: only --algorithm reinforce reads that; leave them out, or choose",
    "gymnasium-tutorial --max-kl 0.1": "only --algorithm reinforce reads that",
    "gymnasium-tutorail": "Did you mean 'gymnasium-tutorial'",
    "--seeds 4:4": "--seeds must be FIRST:END, such as 64:128, got '4:4'",
    "--seeds 0:4 --num-seeds 4": "--seeds 0:4 says how many seeds there are",
    "--minutes 1 --env-steps 100": "both say when the run ends",
    "--like nowhere": "--like nowhere: there is no run",
    "--init-from nowhere": "nowhere is not a run directory",
    "--output taken": "is not empty",
    "--output taken/file": "cannot write",
    "--output /proc/no": "cannot write",
    # What auto stands for depends on the actions of the environment.
    "--env CartPole-v1 --initial-std 0.3": "--initial-std 0.3 would do nothing",
    "--env CartPole-v1 --policy normal": "continuous action space",
    "--env Survive-v0 --policy categorical": "discrete action space",
    "--env os:path": "'os:path' is not a class or function, but of type module",
    "--env nowhere:X": "No module named 'nowhere'",
    "--env os:Nowhere": "has no attribute 'Nowhere'",
    "--env json:JSONDecoder": "JSONDecoder is not an environment: it has no reset, step",
    "--env mjx_reinforce.envs.base:MujocoEnv": "abstract",
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_bad_command_lines_are_refused(refused, tmp_path, arguments):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").write_text("mine")
    assert REFUSED[arguments] in refused(*arguments.split())
    assert (tmp_path / "taken" / "file").read_text() == "mine"


# Environments of the user's own.

OWN = """
import numpy as np, jax.numpy as jnp
from bad_envs import Pole
from toys import Survive
from mjx_reinforce import envs
from mjx_reinforce.envs.base import MujocoEnv

"""
SURVIVE, POLE = "class Mine(Survive):\n    ", "class Mine(Pole):\n    "
INIT, STEP = SURVIVE + "def __init__(self{}): {}", SURVIVE + "def step(self, state, action): {}"
RESET = SURVIVE + "def reset(self, rng): return {}"
OUTCOME = POLE + "def outcome(self, before, data, action): return {}"
#: What a module has that is wrong, and what must be said; test_contract.py and test_envs.py have
#: the rest.
WRONG_MODULES = [
    ("raise RuntimeError('the robot\\n\\nis off')", "RuntimeError: the robot is off"),
    ("class Broken(:", "SyntaxError"),
    ("import sys; sys.exit(3)", "SystemExit: 3"),
    ("1 / 0", "ZeroDivisionError: division by zero (own_broken.py, line"),
    ("Mine = 3", "is not a class or function, but of type int"),
    (INIT.format(", size", "pass"), "missing 1 required positional argument: 'size'"),
    (INIT.format("", "raise RuntimeError('no\\nrobot')"), "RuntimeError: no robot (own_broken.py"),
    (INIT.format("", "raise SystemExit(3)"), "'own_broken:Mine': SystemExit: 3"),
    (INIT.format("", "raise ValueError('x' * 10_000)"), "ValueError: xxxx"),
    ("def Mine(): return Survive", "Survive is a class, not an environment yet: call it"),
    ("def Mine(): return envs.make('Nowhere-v0')", "unknown environment 'Nowhere-v0'"),
    (SURVIVE + "action_size = property(lambda self: {}[0])", "Mine.action_size fails: KeyError: 0"),
    (SURVIVE + "reward_threshold = property(lambda self: {}[0])", "Mine.reward_threshold fails:"),
    (SURVIVE + "action_space = property(lambda self: {}[0])", "Mine.action_space fails: KeyError"),
    (SURVIVE + "max_episode_steps = None", "declares no max_episode_steps: give a horizon"),
    (RESET.format("super().reset(rng).replace(reward=None)"), "a scalar [], and there is no rew"),
    (STEP.format("return state.replace(reward=reward)"), "Mine.step fails: NameError: name 'rew"),
    (STEP.format("raise SystemExit(3)"), "Mine.step fails: SystemExit: 3"),
    (
        STEP.format("return state.replace(reward=np.asarray(action)[0])"),
        "jnp for numpy, math and float()",
    ),
    (STEP.format("return state.obs, 0.0, False, {}"), "with the entries that reset's has"),
    (OUTCOME.format("data.qposition[0], False, {}"), "mjx.Data has no field 'qposition'"),
    ("class Mine(MujocoEnv):\n    initial = outcome = None", "needs max_episode_steps, reward_th"),
    (POLE + "def __init__(self): super().__init__(xml_file='./no.xml')", "no model './no.xml'"),
]


@pytest.fixture
def own(monkeypatch, tmp_path):
    """Writes the module own_broken."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_broken", raising=False)
    return lambda text: (tmp_path / "own_broken.py").write_text(OWN + text)


@pytest.mark.slow
@pytest.mark.parametrize(("text", "message"), WRONG_MODULES)
def test_a_module_with_a_mistake_is_refused(refused, own, text, message):
    own(text)
    assert message in refused("--env", "own_broken:Mine", "--num-seeds", "1")


@pytest.mark.slow
def test_learners_refuse_them_and_what_those_change_is_right(own):
    own(STEP.format("return reward"))
    for id in ("own_broken:Survive", "own_broken:Pole"):
        build(envs.make(id), Config(env=id, engine="vmap"))
    for learner in (reinforce, ars):
        with pytest.raises(ValueError, match=r"Mine\.step fails: NameError"):
            learner(envs.make("own_broken:Mine"))


MODEL = "<mujoco><worldbody>{}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not a model", "XML"),
        (MODEL.format("<goem size='1'/>"), "unrecognized element Element .goem., line 1"),
        (MODEL.format("<geom type='mesh' mesh='far'/>"), "far"),
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


def test_arguments_of_the_wrong_type_are_refused():
    for name, wrong, message in (
        ("frame_skip", 1.5, "frame_skip of InvertedPendulum must be a whole number, got 1.5"),
        ("reward_threshold", "high", "must be a number or None, got 'high'"),
        ("reset_noise_scale", math.nan, "must be a number, got nan"),
        ("xml_file", Path("a/b.xml"), "xml_file of InvertedPendulum must be text"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.make("InvertedPendulum-v5", **{name: wrong})


def test_what_cannot_be_registered_is_refused():
    for id, entry, message in (
        ("CartPole-v1", Survive, "already registered"),
        ("../away", Survive, "letters, digits"),
        ("Mine-v0", "toys:Survive", "must be a class or function"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.register(id, entry)
        assert envs._TABLE.get(id, (None,))[0] is not entry


# Folders.

#: Begins a command without root's right to enter every folder.
AS_A_USER = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] * (os.geteuid() == 0)
#: Runs each line of its input as a command of the package; prints the statuses and errors.
COMMANDS = """
import sys
from mjx_reinforce import registry
from mjx_reinforce.console.commands import COMMANDS
for line in sys.stdin:
    sys.argv = line.split("#")[0].split()
    try:
        registry.load_definition(COMMANDS[sys.argv[0]][0])()
    except SystemExit as stop:
        print(stop.code, file=sys.stderr)
"""
UNREACHABLE = {
    "train --output closed/run": "cannot write to the run directory closed/run (Permission",
    "train --output circle": "directory circle (Too many levels of symbolic links)",
    "train --output circle/run": "directory circle/run (Too many levels of symbolic links)",
    "sweep --over discount 1 0.9 --output closed/run": "closed/run (Permission",
    "train --resume closed/run": "closed/run/config.json (Permission denied)",
    "sweep --resume closed/run": "closed/run/config.json (Permission denied)",
    "train --resume closed/run/policy": "closed/run/policy/config.json (Permission denied)",
    "watch closed/run": "Permission denied",
    "report closed/run": "Permission denied",
    "export closed/run": "Permission denied",
    "export run --output closed/run.npz": "closed",
    "watch run --output closed/run.gif": "closed",
    "report run --output closed/run.html": "closed",
    "report run --output circle/run.html": "circle",
}


@pytest.mark.slow
@pytest.mark.skipif(
    bool(AS_A_USER) and shutil.which("setpriv") is None, reason="root may enter every folder"
)
def test_folders_that_may_not_be_entered_are_named(tmp_path):
    make_run(tmp_path / "run")
    (tmp_path / "closed").mkdir(0)
    (tmp_path / "circle").symlink_to("circle")
    done = subprocess.run(
        [*AS_A_USER, sys.executable, "-c", COMMANDS],
        input="\n".join(UNREACHABLE),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
    )
    said = done.stderr.splitlines()
    assert said[1::2] == ["2"] * len(UNREACHABLE), done
    for message, error in zip(UNREACHABLE.values(), said[::2], strict=True):
        assert message in error


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
        {"algorithm": "baseline-truncated-normal"},
        {"standardize_floor": None, "estimator": "value-baseline"},
    ],
)
def test_the_marks_say_what_is_read(changes):
    """Of the settings with readers, building looks at those whose readers' conditions hold."""
    config = Config(env="Survive-v0", engine="vmap", **changes)
    watched = Watched(config)
    build(Survive(), watched)
    listed = {name for reader in Reader for name in marked(reader)}
    idle = {name for reader in Reader if not reader.holds(config) for name in marked(reader)}
    # It is always handed on; the policy may not look at it.
    handed = {"initial_std"}
    assert (listed - idle) - handed == (listed & watched.read) - handed
    # What programs on disk do not depend on is not built into them: budgets are only checked.
    assert watched.read.isdisjoint({*marked(Mark.NOT_COMPILED)} - {"env_steps", "max_updates"})


def test_no_default_is_refused():
    """Also where a flag says what holds anyway, or another mode makes presets' settings idle."""
    for start in ([], ["gymnasium-tutorial"]):
        default = parse(start).base
        same = parse([*start, "--discount", str(default.discount)]).base
        other = "reinforce" if default.algorithm == "ars" else "ars"
        assert (same, parse([*start, "--algorithm", other]).base.algorithm) == (default, other), (
            start
        )


# What users write is printed as it is.


def test_text_is_not_read_as_markup(capsys):
    """Neither in lines nor in tables; ``show_summary`` uses the same console."""
    shown, text = display.Display(), "t/[bold]x[/b]:smile:[link=x]y"
    shown.say(text)
    shown.say(text, style="yellow")
    table = Table(title=text)
    table.add_row(text)
    shown.console.print(table)
    assert capsys.readouterr().out.count(text) == 4


@pytest.mark.slow
def test_an_ascii_terminal_shows_escapes(tmp_path):
    accent = "é日本\U0001f916"
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


@pytest.mark.slow
def test_help_may_be_cut_off_or_go_nowhere():
    """As by ``--help | head``."""
    ways = ["| true", ">&-", "> /dev/full", "2>&- >&-"]
    command = f"{sys.executable} -m mjx_reinforce.train --help"
    line = "; ".join(f"{command} {way}; echo ${{PIPESTATUS[0]}} >&3" for way in ways)
    done = subprocess.run(["bash", "-c", f"({line}) 3>&1"], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("0\n" * len(ways), "")


@dataclasses.dataclass
class NoSettings:
    """A command without flags."""


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "error: [Errno 28] No space left on device: 'out.npz'; make room there\n"),
        (errno.EACCES, "error: [Errno 13] Permission denied: 'out.npz'\n"),
    ],
)
def test_a_command_that_meets_a_full_disk_asks_for_room(monkeypatch, capsys, number, said):
    def write(_):
        raise OSError(number, os.strerror(number), "out.npz")

    monkeypatch.setattr(sys, "argv", ["export"])
    with pytest.raises(SystemExit, match="2"):
        run_command(NoSettings, "export", write)
    assert capsys.readouterr().err == said


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


# At random.

_FIELDS = {field.name: field.type for field in dataclasses.fields(Config)}
_CHOICES = {
    name: kind
    for name, kind in _FIELDS.items()
    if typing.get_origin(kind) is Literal and name != "engine"
}


def named(*kinds):
    """Returns the settings with one of these annotations."""
    return [name for name, kind in _FIELDS.items() if kind in kinds]


#: Whole numbers that are not at least 1 and less than 2^31.
_OTHER_COUNTS = {"seed", "num_seeds", "normalize_steps"}
_COUNTS = sorted({*named(int, int | None)} - _OTHER_COUNTS)
_NUMBERS = named(float, float | None)
_SIZES = [name for name in named(tuple[int, ...]) if name != "budgets"]


def test_every_setting_has_its_bounds_and_type():
    """Not only those above: what is beyond any bound, and what is of no setting's type."""
    wrong = [
        (named(int, int | None), (-1, 1.5, True, "4")),
        (_COUNTS, (0, 2**53 + 1)),
        (_NUMBERS, (math.nan, math.inf, -math.inf, -1e13, "1", True)),
        (("discount", "momentum", "whole_after"), (-1e-9, 1.001)),
        (_SIZES, ((0,), (2**31,), (1.5,), 32, "32")),
        (("budgets",), ((0,), (-1, 9), (0, 2**53 + 1), (0, 1.5), 32)),
        (("policy", "estimator", "engine", "env", *_CHOICES), ("", None, 1)),
    ]
    cases = [(name, value) for names, values in wrong for name in names for value in values]
    taken = [case for case in cases if not refusal(lambda: check(Config(**dict([case]))))]  # noqa: B023
    assert taken == []


#: Values that make sense by themselves, and that most of the others go with.
RIGHT = {
    **{name: st.integers(1, 9) for name in _COUNTS},
    **{name: st.floats(1e-6, 0.999) for name in _NUMBERS},
    **{name: st.lists(st.integers(1, 9), max_size=2).map(tuple) for name in _SIZES},
    **{name: st.sampled_from(typing.get_args(kind)) for name, kind in _CHOICES.items()},
    "num_seeds": st.integers(1, 9),
    "num_episodes": st.integers(2, 9),
    "normalize_steps": st.none() | st.integers(0, 9),
    "decay_steps": st.none() | st.integers(1, 9),
    "minutes": st.none(),
    "algorithm": st.sampled_from(["reinforce", "ars"]),
    "policy": st.sampled_from(["normal-softplus", "normal-sigmoid"]),
    "estimator": st.sampled_from([*ESTIMATORS]),
}


def refusal(function):
    """Returns what a function said when it refused, or None; any other exception goes on."""
    try:
        function()
    except ValueError as error:
        message = str(error)
        return message if 0 < len(message.splitlines()) <= 2 else pytest.fail(message)
    except SystemExit as stop:  # --help, or tyro refused
        return f"exit {stop.code}" if stop.code else None
    return None


@pytest.mark.slow
def test_settings_that_make_sense_alone_build_or_are_refused():
    """Most of them build; how many depends on the modules whose constants Hypothesis draws."""
    built = []

    @settings(derandomize=True, deadline=None, database=None, max_examples=50)
    @given(st.fixed_dictionaries({}, optional=RIGHT))
    def each(given):
        given = {"engine": "vmap"} | given
        while idle := [name for name in given if not is_read(name, Config(**given))]:
            given = {name: value for name, value in given.items() if name not in idle}
        config = Config(**given)
        check_read(config, changed(config, Config()))

        def make():
            check(config)
            build(Survive(), config)

        built.append(refusal(make) is None)

    each()
    assert len(built) >= 50
    assert np.mean(built) > 0.5


def test_command_lines_are_read_as_they_were_meant():
    """Whole ones; and one that has a word too much, as nearly every is refused, fails in words."""
    for _, config in PRESETS.values():
        # An empty one is for the user to name.
        if not config.env:
            config = dataclasses.replace(config, env="Hopper-v5")
        names = [name for name in changed(config, Config()) if is_read(name, config)]
        words = [word for name in names for word in as_words(name, getattr(config, name))]
        read = parse(words).base
        assert {name: getattr(read, name) for name in names} == {
            name: getattr(config, name) for name in names
        }
    for wrong in ("--", "-", "=", "--=", "nan", "1e400", "[bold]", "{}", "None", "\0"):
        assert refusal(lambda wrong=wrong: parse([*words, wrong])) or wrong == "--"


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


def test_what_the_commands_cannot_work_with_is_named():
    for name in jax_setup._REFUSED:
        before = jax.config.values[name.lower()]
        jax.config.update(name.lower(), "disallow" if name == "JAX_TRANSFER_GUARD" else True)
        try:
            with pytest.raises(ValueError, match=f"{name} is set, but .*; unset it"):
                jax_setup.configure_jax()
        finally:
            jax.config.update(name.lower(), before)

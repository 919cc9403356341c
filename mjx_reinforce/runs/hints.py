"""What a command line that cannot be read was probably meant to say."""

import dataclasses
import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, get_args, get_type_hints

import tyro

from mjx_reinforce import envs
from mjx_reinforce.registry import nearest
from mjx_reinforce.runs.commands import COMMANDS, SCRIPT, command
from mjx_reinforce.runs.presets import PRESETS

#: Flags of other libraries, and short forms -> ours.
_OTHERS = {
    "--env": "env-id env-name environment task task-id game model robot e",
    "--num-seeds": "seeds n-seeds nseeds num-seed number-of-seeds runs num-runs repeats trials",
    "--seed": "random-seed rng-seed",
    "--env-steps": "steps n-steps num-steps timesteps total-timesteps num-timesteps total-steps "
    "env-step max-steps budget-steps frames n-timesteps train-steps",
    "--minutes": "time time-limit minute mins max-time hours seconds duration wall-time",
    "--max-updates": "updates num-updates n-updates iterations num-iterations n-iterations iters "
    "epochs n-epochs num-epochs generations",
    "--num-episodes": "episodes n-episodes batch-size batch num-envs n-envs episodes-per-update "
    "rollouts num-rollouts parallel-envs",
    "--learning-rate": "lr alpha step learning-rates policy-lr actor-lr l",
    "--value-learning-rate": "value-lr critic-lr vf-lr baseline-lr",
    "--discount": "gamma discount-factor discounting",
    "--hidden-sizes": "hidden hidden-size hidden-layers layers hidden-units net-arch network "
    "hidden-dims hidden-dim units num-layers architecture",
    "--estimator": "baseline advantage advantages critic",
    "--algorithm": "algo alg method agent",
    "--optimizer": "optim optimiser",
    "--policy": "distribution dist policy-class",
    "--initial-std": "std sigma init-std action-std log-std exploration noise-level",
    "--entropy-cost": "ent-coef entropy entropy-coef entropy-coefficient entropy-bonus",
    "--max-grad-norm": "clip clip-grad grad-clip gradient-clip clip-norm",
    "--max-kl": "kl target-kl kl-target trust-region",
    "--horizon": "episode-length max-episode-steps time-steps episode-steps length",
    "--output": "out o dir logdir log-dir save-dir output-dir save path folder run-dir name "
    "exp-name directory",
    "--overwrite": "force f replace",
    "--resume": "continue restart checkpoint load",
    "--init-from": "pretrained from warm-start finetune",
    "--eval-every": "eval-freq eval-interval eval-frequency log-every log-interval",
    "--eval-episodes": "n-eval-episodes num-eval-episodes",
    "--checkpoint-every": "save-every save-freq checkpoint-freq",
    "--wandb": "track use-wandb",
    "--tensorboard": "tb tensorboard-log",
    "--over": "grid values",
    "--search": "tune tuner",
    "--budget": "num-configurations samples",
    "--to": "format export type",
    "--backend": "simulator sim",
    "--noise": "stochastic sample",
    "--which": "checkpoint-type policy-type",
}
_MEANT: dict[str, list[str]] = {}
for _flag, _words in _OTHERS.items():
    for _word in _words.split():
        _MEANT.setdefault(f"--{_word}", []).append(_flag)

_GPU = "a GPU is used where JAX finds one; JAX_PLATFORMS=cuda before the command insists on it"
#: Flags that are none here, and what to do in their place.
_NONE = {
    "--version": f"{SCRIPT} --version says it",
    "--device": "write JAX_PLATFORMS=cpu or JAX_PLATFORMS=cuda before the command",
    "--gpu": _GPU,
    "--cuda": _GPU,
    "--cpu": "write JAX_PLATFORMS=cpu before the command",
    "--render": f"train first, then {SCRIPT} watch makes a film",
    "--verbose": "there is one amount of output; > /dev/null drops it",
    "--quiet": "there is one amount of output; > /dev/null drops it",
}


#: Flags of one command alone.
_ELSEWHERE = {"--over": "sweep", "--search": "sweep", "--budget": "sweep", "--to": "export"}


#: What a flag may begin with that was typed or copied from a document, whose dashes are longer.
_DASHES = ("-", "\N{EN DASH}", "\N{EM DASH}")


class Known(NamedTuple):
    """A flag of a form.

    switch: whether it takes no value
    positional: whether its value stands without it
    """

    switch: bool
    positional: bool


def known(form: type) -> dict[str, Known]:
    """Returns the flags of a dataclass, and of the dataclasses in it."""
    return dict(_known(form))


def _known(form: type) -> Iterator[tuple[str, Known]]:
    hints = get_type_hints(form, include_extras=True)
    for field in dataclasses.fields(form):
        kind = hints[field.name]
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            yield from _known(kind)
        else:
            positional = tyro.conf.Positional in get_args(kind)
            yield f"--{field.name.replace('_', '-')}", Known(kind is bool, positional)


def about_unknown(unknown: Sequence[str], arguments: Sequence[str], form: type, prog: str) -> str:
    """Returns the message about what stands on a command line and is not in its form.

    Args:
      unknown: what no flag takes, in its order.
      arguments: the whole command line.
      form: the dataclass that is filled in.
      prog: the name of the program.
    """
    flags = known(form)
    for word in unknown:
        if word.startswith(_DASHES):
            return _about_flag(word.partition("=")[0], flags, prog)
    place = arguments.index(unknown[0])
    before = arguments[place - 1].replace("_", "-") if place else ""
    return _about_value(unknown, before, flags, prog)


def _about_flag(flag: str, flags: Mapping[str, Known], prog: str) -> str:
    if flag in flags and not flags[flag].positional:
        return f"{flag} stands after --, which ends the flags: leave -- out"
    plain = "--" + flag.strip("".join(_DASHES)).replace("_", "-").lower()
    if plain in flags and flags[plain].positional:
        return f"unknown flag {flag!r}: leave it out, and write what follows it alone"
    if plain in flags:
        return f"unknown flag {flag!r}: write {plain}"
    value = plain.replace("--no-", "--", 1)
    if value in flags:
        return f"unknown flag {flag!r}: {value} is no switch but takes a value (see --help)"
    if plain in _NONE:
        return f"unknown flag {flag!r}: {_NONE[plain]}"
    if plain in _ELSEWHERE:
        other = _ELSEWHERE[plain]
        return f"unknown flag {flag!r}: it is one of {command(other)}"
    meant = [each for each in _MEANT.get(plain, ()) if each in flags]
    near = meant[0] if meant else nearest_flag(plain, flags)
    hint = f" Did you mean {near!r}?" if near else ""
    return f"unknown flag {flag!r}.{hint} (See {prog.removesuffix(' [PRESET]')} --help.)"


def nearest_flag(flag: str, flags: Iterable[str]) -> str | None:
    """Returns the flag that is spelt most like another, if any is alike."""
    return next(iter(difflib.get_close_matches(flag, flags, n=1)), None)


def _about_value(words: Sequence[str], before: str, flags: Mapping[str, Known], prog: str) -> str:
    """Returns the message about words that follow a flag, or another word, and that none takes."""
    word = words[0]
    if before in flags and flags[before].switch:
        no = before.replace("--", "--no-", 1)
        return f"{before} is a switch: it takes no value, got {word!r}; {no} switches it off"
    name, equals, value = word.partition("=")
    if equals and (flag := "--" + name.replace("_", "-")) in flags:
        return f"{word!r} lacks its dashes: write {flag} {value}"
    if said := about_word(word, "--env" in flags, prog):
        return said
    if word in PRESETS:
        return f"{word!r} is a preset, and a preset comes before all flags (see --help)"
    why = f": {before} takes one value" if before in flags else ""
    return f"no flag takes {' '.join(map(repr, words))}{why} (see --help)"


def about_word(word: str, has_env: bool, prog: str) -> str | None:
    """Returns the message about a word that stands where none may, if its meaning is known.

    Args:
      word: what the user typed.
      has_env: whether the program trains on a task, which has the flag --env.
      prog: the name of the program.
    """
    if word in COMMANDS:
        if prog.partition(" [")[0].endswith(word):
            return f"the command {word!r} is given twice: leave one out"
        return f"{word!r} is a command of its own: {command(word)}"
    if word in ("help", "version"):
        return f"{word!r} is written --help" if word == "help" else _NONE["--version"]
    if not has_env:
        return None
    if word in envs.names() or ":" in word:
        return f"{word!r} is a task: write --env {word}"
    if Path(word).suffix in (".py", ".xml"):
        return f"{word!r} is a file; a task is a class in one: write --env module:Class"
    if (Path(word) / "config.json").is_file():
        return (
            f"{word!r} is a run: --resume {word} goes on with it, --like {word} repeats it, "
            f"--init-from {word} begins with its policies"
        )
    tasks = {each.lower() for each in envs.names()}
    near = nearest(word, [*envs.names(), *PRESETS, *COMMANDS])
    if near and near.lower() in tasks:
        return f"unknown task {word!r}. Did you mean --env {near}?"
    if near in COMMANDS:
        return f"unknown word {word!r}. Did you mean the command {command(near)}?"
    return None

"""What a command line that cannot be read was probably meant to say."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, get_args, get_type_hints

import tyro

from mjx_reinforce import envs
from mjx_reinforce.console.commands import COMMANDS, SCRIPT, command
from mjx_reinforce.registry import nearest
from mjx_reinforce.settings.config import flag, read_tables, spoken
from mjx_reinforce.settings.presets import PRESETS

_OTHERS = read_tables("hints.toml")
#: Flags of other libraries, and short forms -> ours.
_MEANT: dict[str, list[str]] = {}
for _flag, _words in _OTHERS["flags"].items():
    for _word in _words.split():
        _MEANT.setdefault(f"--{_word}", []).append(f"--{_flag}")

_GPU = "a GPU is used where JAX finds one; JAX_PLATFORMS=cuda before the command insists on it"
_CONFIG = f"the settings of a run are in its config.json; {SCRIPT} train --like RUN repeats them"
#: Flags that are none here, and what to do in their place.
_NONE = {
    "--version": f"{SCRIPT} --version says it",
    "--device": "write JAX_PLATFORMS=cpu or JAX_PLATFORMS=cuda before the command",
    "--gpu": _GPU,
    "--cuda": _GPU,
    "--cpu": "write JAX_PLATFORMS=cpu before the command",
    "--render": f"train first, then {SCRIPT} watch makes a film",
    **dict.fromkeys(("--config", "--config-file", "--cfg", "--settings"), _CONFIG),
    "--verbose": "there is one amount of output; > /dev/null drops it",
    "--quiet": "there is one amount of output; > /dev/null drops it",
}


#: Words of other libraries for a command -> ours.
_COMMANDS = {word: ours for ours, words in _OTHERS["commands"].items() for word in words.split()}
#: Flags of one command alone.
_ELSEWHERE = {"--over": "sweep", "--search": "sweep", "--budget": "sweep", "--to": "export"}


#: What switches are given elsewhere.
_TRUTHS = ("true", "false", "yes", "no", "on", "off", "0", "1", "none")
#: What a flag may begin with that was typed or copied from a document, whose dashes are longer.
_DASHES = ("-", "\N{EN DASH}", "\N{EM DASH}")


class Known(NamedTuple):
    """A flag of a form.

    switch: whether it takes no value
    positional: whether its value stands without it
    once: why a sweep cannot go over it; None if it can
    """

    switch: bool
    positional: bool
    once: str | None = None


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
            yield flag(field.name), Known(kind is bool, positional, field.metadata.get("once"))


def required(form: type) -> list[str]:
    """Returns what a command line must have, as --help calls it."""
    flags = known(form)
    needed = (f for f in dataclasses.fields(form) if f.default is dataclasses.MISSING)
    names = (flag(field.name) for field in needed)
    return [name[2:].upper() if flags[name].positional else name for name in names]


def unknown_flags(arguments: Sequence[str], form: type) -> list[str]:
    """Returns the flags on a command line that are not in a form."""
    flags = known(form)
    switches = {flag.replace("--", "--no-", 1) for flag, known in flags.items() if known.switch}
    named = {flag for flag, known in flags.items() if not known.positional}
    words = [word for word in arguments if word.startswith("--") and word != "--"]
    return [x for x in words if spoken(x.partition("=")[0]) not in named | switches]


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
    before = arguments[: arguments.index(unknown[0])]
    last = next((word for word in reversed(before) if word.startswith("--")), "")
    return _about_value(unknown, spoken(last), flags, prog)


def _about_flag(flag: str, flags: Mapping[str, Known], prog: str) -> str:
    if flag in flags and not flags[flag].positional:
        return f"{flag} stands after --, which ends the flags: leave -- out"
    if " " in flag:
        return f"{flag!r} is one word: leave the quotes out"
    plain = f"--{spoken(flag.strip(''.join(_DASHES))).lower()}"
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
    meant = [each for each in other_names(plain) if each in flags]
    near = nearest(plain[2:], [each[2:] for each in flags])
    hint = f" Did you mean {(meant or [f'--{near}'])[0]!r}?" if meant or near else ""
    return f"unknown flag {flag!r}.{hint} (See {prog.removesuffix(' [PRESET]')} --help.)"


def other_names(flag: str) -> Sequence[str]:
    """Returns the flags that other libraries call so."""
    return _MEANT.get(flag, ())


def _about_value(words: Sequence[str], flag: str, flags: Mapping[str, Known], prog: str) -> str:
    """Returns the message about words after a flag, if it is not empty, which none takes."""
    word, trains = words[0], "--num-seeds" in flags
    if flag in flags and flags[flag].switch and word.lower() in _TRUTHS:
        no = flag.replace("--", "--no-", 1)
        return f"{flag} is a switch: it takes no value, got {word!r}; {no} switches it off"
    if said := about_word(word, trains, prog):
        return said
    if word in PRESETS:
        return f"{word!r} is a preset, and a preset comes before all flags (see --help)"
    why = f": {flag} takes one value" if flag in flags and not flags[flag].switch else ""
    if why and trains:
        swept = f"; {command('sweep')} --over {flag[2:]} compares several"
        why += f", also in a sweep: {once}" if (once := flags[flag].once) else swept
    return f"no flag takes {' '.join(map(repr, words))}{why} (see --help)"


def about_word(word: str, trains: bool, prog: str) -> str | None:
    """Returns the message about a word that stands where none may, if its meaning is known.

    Args:
      word: what the user typed.
      trains: whether the program trains on a task.
      prog: the name of the program.
    """
    if word.startswith(_DASHES[1:]):
        return f"{word!r} begins with a long dash: write --{word.strip(''.join(_DASHES))}"
    if word in COMMANDS:
        if prog.partition(" [")[0].endswith(word):
            return f"the command {word!r} is given twice: leave one out"
        return f"{word!r} is a command of its own: {command(word)}"
    if word in ("help", "version"):
        return f"{word!r} is written --help" if word == "help" else _NONE["--version"]
    if not trains:
        return None
    train = f"{command('train')} " if prog == SCRIPT else ""
    name, equals, value = word.partition("=")
    if equals:
        return f"{word!r} lacks its dashes: write {train}{flag(name)} {value}"
    if word in envs.names() or ":" in word:
        return f"{word!r} is a task: write {train}--env {word}"
    if Path(word).suffix == ".xml":
        return f"{word!r} is a model: {command('new')} {word} writes a task on it"
    if Path(word).suffix == ".py":
        return f"{word!r} is a file; a task is a class in one: write {train}--env module:Class"
    if len(Path(word).parts) > 1:
        return (
            f"{word!r} is a directory: --output {word} writes a run there, --resume {word} goes on "
            f"with the run in it, --like {word} repeats it, --init-from {word} begins with its "
            "policies"
        )
    if word in _COMMANDS:
        return f"unknown word {word!r}. Did you mean the command {command(_COMMANDS[word])}?"
    near = nearest(word, [*envs.names(), *PRESETS, *COMMANDS])
    if near in COMMANDS:
        return f"unknown word {word!r}. Did you mean the command {command(near)}?"
    if near in envs.names():
        return f"unknown task {word!r}. Did you mean {train}--env {near}?"
    return None

"""The script ``mjx-reinforce``, and ``python -m mjx_reinforce``: all commands, and their menu."""

import signal
import sys


def main() -> None:
    """Does what a command does, which stands first; Ctrl-C ends its imports without a traceback.

    Flags alone, or a preset, train.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from mjx_reinforce.console.commands import COMMANDS
    from mjx_reinforce.registry import load_definition

    name, sys.argv[1:] = _command(sys.argv[1:])
    do = load_definition(COMMANDS[name][0])
    signal.signal(signal.SIGINT, signal.default_int_handler)  # each command ends in its own way
    try:
        do()
    except KeyboardInterrupt:
        sys.exit(130)


def _command(arguments: list[str]) -> tuple[str, list[str]]:
    """Returns a command and its own arguments; or prints what is asked for, or wrong, and exits."""
    from mjx_reinforce.console.commands import COMMANDS, SCRIPT, menu

    first = arguments[0] if arguments else "--help"
    if first in COMMANDS:
        return first, arguments[1:]
    from mjx_reinforce.console.streams import accept_everything, say, say_error
    from mjx_reinforce.setup.provenance import version

    accept_everything()
    ours = version("mjx-reinforce") or "not installed"
    if first in ("-h", "--help", "help"):
        say(menu(ours), sys.stdout)
        sys.exit(0)
    if first in ("-V", "--version", "version"):
        print(SCRIPT, ours)
        sys.exit(0)
    from mjx_reinforce.settings.defaults import PRESETS
    from mjx_reinforce.settings.flags import about_word

    if first.startswith("-") or first in PRESETS:
        return "train", arguments
    say_error(about_word(first))
    sys.exit(2)


if __name__ == "__main__":
    main()

"""The script ``mjx-reinforce``, and ``python -m mjx_reinforce``: all commands, and their menu."""

import signal
import sys


def main() -> None:
    """Does what a command does, which stands first; Ctrl-C ends its imports without a traceback.

    Flags alone, or a preset, train.
    """
    # The default handler of the system ends the process; Python's raises KeyboardInterrupt, of
    # which a library might make something else in the middle of its import.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from mjx_reinforce.console.commands import COMMANDS
    from mjx_reinforce.registry import load_definition

    name, sys.argv[1:] = _command(sys.argv[1:])
    do = load_definition(COMMANDS[name][0])
    # From here on each command ends in its own way.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        do()
    except KeyboardInterrupt:
        sys.exit(130)


def _command(arguments: list[str]) -> tuple[str, list[str]]:
    """Returns a command and its own arguments; or prints what is asked for, or wrong, and exits."""
    from mjx_reinforce.console.commands import COMMANDS, SCRIPT, menu

    word = arguments[0] if arguments else "--help"
    if word in COMMANDS:
        return word, arguments[1:]
    # All else imports more, which a command that is named need not wait for.
    from mjx_reinforce.console.streams import accept_everything, say, say_error
    from mjx_reinforce.setup.provenance import version

    accept_everything()
    package_version = version("mjx-reinforce") or "not installed"
    if word in ("-h", "--help", "help"):
        say(menu(package_version), sys.stdout)
        sys.exit(0)
    if word in ("-V", "--version", "version"):
        print(SCRIPT, package_version)
        sys.exit(0)
    from mjx_reinforce.settings.defaults import PRESETS
    from mjx_reinforce.settings.flags import about_word

    if word.startswith("-") or word in PRESETS:
        return "train", arguments
    say_error(about_word(word))
    sys.exit(2)


if __name__ == "__main__":
    main()

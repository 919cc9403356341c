"""The script ``mjx-reinforce``, and ``python -m mjx_reinforce``: they train."""

import signal


def main() -> None:
    """Does what ``train.main`` does; Ctrl-C ends the imports before it without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from mjx_reinforce import train

    train.main()


if __name__ == "__main__":
    main()

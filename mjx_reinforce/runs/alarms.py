"""Messages of libraries that alarm people and ask nothing of them."""

import os


def silence_alarms() -> None:
    """Keeps XLA's log from the screen, for a command line; call it before JAX is imported.

    XLA logs, in red, that a long compilation may be a bug of its own. What really fails is raised
    as an exception all the same. Who sets TF_CPP_MIN_LOG_LEVEL sees what they ask for.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

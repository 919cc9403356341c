"""``python -m mjx_reinforce.sweep`` trains configurations, many seeds of each, side by side.

In Python, ``mjx_reinforce.sweep`` is the function of that name, from ``runs.results``. An import of
this module would put the module in its place, so nothing here imports it.
"""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

    from mjx_reinforce.runs.command_line import sweep

    sweep()

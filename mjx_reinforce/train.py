"""``python -m mjx_reinforce.train`` trains many seeds at once and reports over them."""

import signal

if __name__ == "__main__":  # Ctrl-C ends the imports below without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from mjx_reinforce.runs.command_line import train as main

if __name__ == "__main__":
    main()

"""``python -m kontronik_can_gw``, and the program ``kontronik-can-gw``."""

import _signal  # type: ignore[import-not-found]
import sys

# Ctrl-C ends the program silently while modules are loaded. The module signal is slow to load.
if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)

# SIGUSR1 has no effect until cli/run.py sets its handler. It would end the process otherwise.
if "run" in sys.argv[1:]:
    _signal.signal(_signal.SIGUSR1, _signal.SIG_IGN)

from kontronik_can_gw.cli import main

if __name__ == "__main__":
    code = main()
    if code == _signal.SIGINT + 128:
        # If Ctrl-C arrived inside exec(), for example while a dataclass was made, python -m
        # sends itself SIGINT after this line, and its parent would not get the exit code.
        _signal.pthread_sigmask(_signal.SIG_BLOCK, [_signal.SIGINT])
    sys.exit(code)

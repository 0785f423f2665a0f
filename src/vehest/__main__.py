"""Entry point of the command ``vehest`` and of ``python -m vehest``.

It imports the command line after Ctrl-C has a handler, since that import takes longer than many
commands.
"""

import atexit
import os
import signal
import sys
from types import FrameType

INTERRUPTED = 128 + signal.SIGINT  # exit code of a process that Ctrl-C ended


def main() -> None:
    """Run the command line.

    Ctrl-C ends the process at once while modules are imported and at its exit.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_at_once)
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # no handler runs after that
    sys.unraisablehook = _end_if_stopped
    from vehest.cli import main as run_command

    run_command()


def _end_at_once(number: int, frame: FrameType | None) -> None:
    """End without an exception, which a module that is being imported could catch or print."""
    os._exit(INTERRUPTED)


def _end_if_stopped(unraisable: "sys.UnraisableHookArgs") -> None:
    """End if `Stopped` was raised in a finaliser or callback, where Python only prints it."""
    from vehest.run.signals import Stopped

    if isinstance(unraisable.exc_value, Stopped):
        os._exit(unraisable.exc_value.exit_code)
    sys.__unraisablehook__(unraisable)


if __name__ == "__main__":
    main()

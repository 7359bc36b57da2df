"""The command ``reframe-jax`` as a process: standard streams, interruptions, exit code.

JAX is imported after all of this is in place.
"""

import io
import os
import signal
import socket
import sys
import threading

from reframe_jax.cli.printing import print_error

__all__ = ["main"]

_INTERRUPTED = 130  # as shells report it


def main() -> int:
    """Run the command line with the arguments of the process; returns the exit code.

    Raises:
        SystemExit: as :func:`reframe_jax.cli.program.main` does.
    """
    _leave_when_interrupted()
    if sys.stdout is None:
        print_error("reframe-jax: error: standard output is closed.")
        return 1
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may hold any byte
    from reframe_jax.cli.program import main as run

    return run()


def _leave_when_interrupted() -> None:
    """Leave at once and quietly on Ctrl-C, even while a program is being compiled.

    Python's handlers wait until the compiler returns. But the byte that a signal writes to a socket wakes a
    thread up meanwhile. Signals that are ignored, as in the background, stay so.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    woken, waker = socket.socketpair()
    waker.setblocking(False)
    signal.signal(signal.SIGINT, lambda *_: os._exit(_INTERRUPTED))
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_wait, args=(woken, waker), daemon=True).start()


def _wait(woken: socket.socket, waker: socket.socket) -> None:
    """Wait for an interruption; ``waker`` must stay open meanwhile."""
    while signal.SIGINT not in woken.recv(64):
        pass
    os._exit(_INTERRUPTED)

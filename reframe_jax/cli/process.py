"""The command ``reframe-jax`` as a process: standard streams, interruptions, exit code.

JAX is imported after these are set up.
"""

import io
import os
import signal
import socket
import sys
import threading

from reframe_jax.cli.printing import print_error

__all__ = ["main"]

_INTERRUPTED = 130  # exit code that shells report for Ctrl-C


def main() -> int:
    """Run the command line with the arguments of the process; returns the exit code."""
    _leave_when_interrupted()
    if sys.stdout is None:
        print_error("reframe-jax: error: standard output is closed.")
        return 1
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may contain any byte
    from reframe_jax.cli.program import main as run

    return run()


def _leave_when_interrupted() -> None:
    """Exit immediately and without a traceback on Ctrl-C, even during compilation.

    Python runs signal handlers only after the compiler returns. Each signal also writes a byte to a socket,
    which wakes up a thread during compilation. Signals that are ignored, as in background jobs, remain
    ignored.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    woken, waker = socket.socketpair()
    waker.setblocking(False)
    signal.signal(signal.SIGINT, lambda *_: os._exit(_INTERRUPTED))
    signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_wait, args=(woken, waker), daemon=True).start()


def _wait(woken: socket.socket, waker: socket.socket) -> None:
    """Wait for an interruption; ``waker`` must stay open."""
    while signal.SIGINT not in woken.recv(64):
        pass
    os._exit(_INTERRUPTED)

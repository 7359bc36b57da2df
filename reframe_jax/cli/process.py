"""The command ``reframe-jax`` as a process: standard streams, interruptions, exit code.

JAX is imported after these are set up.
"""

import io
import signal
import sys

from reframe_jax.cli.printing import print_error

__all__ = ["main"]


def main() -> int:
    """Run the command line with the arguments of the process; returns the exit code."""
    # Python's own handler waits for the compiler; background jobs ignore the signal, and keep doing so
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.stdout is None:
        print_error("reframe-jax: error: standard output is closed.")
        return 1
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may contain any byte
    from reframe_jax.cli.program import main as run

    return run()

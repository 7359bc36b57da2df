"""The command ``reframe-jax`` as a process: standard streams, interruptions, exit code.

JAX is imported after the streams are set up.
"""

import io
import signal
import sys

from reframe_jax.cli.printing import fail


def main() -> int:
    """Run the command line with the arguments of the process, and return the exit code."""
    # Python's handler of Ctrl-C waits for the compiler; background jobs continue to ignore the signal
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.stdout is None:
        return fail("standard output is closed.")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names can contain any byte
    from reframe_jax.cli.program import main as run

    return run()

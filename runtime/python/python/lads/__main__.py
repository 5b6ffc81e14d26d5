"""`python -m lads`: the command `lads`."""

import signal
import sys

from . import _lads


def main():
    """Runs the command with this process's arguments -> its exit code."""
    # The command runs in native code, where Python's own handler would not get to run.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _lads.command(["lads", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())

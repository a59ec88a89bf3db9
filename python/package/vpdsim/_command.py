"""The command `vpd`."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Runs the command line of this process, and ends it."""
    from . import _native

    # Ctrl-C is the program's own affair, as without Python.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_native.command(os.path.abspath(sys.argv[0]), ["vpd", *sys.argv[1:]]))

"""`python -m vpdsim` is the command `vpd`."""

from ._command import main

main()

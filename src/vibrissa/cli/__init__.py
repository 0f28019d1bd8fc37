"""Command-line interface: each verb parses its options, calls a function and prints the results.

Options and printed values are in mm, µN, µN·m and degrees; files are in SI units.
"""

import os
import sys

# Set before NumPy is loaded: for small matrices, threads of linear algebra mostly wait, and take
# cores from the threads over which rows are distributed.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Run the command line."""
    try:
        from vibrissa.cli.app import main as run
    except KeyboardInterrupt:  # while modules are imported
        sys.exit(130)
    run()


__all__ = ["main"]
__dir__ = __all__.copy

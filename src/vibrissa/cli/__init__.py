"""The command line: parse, call, print.

What is typed and printed is in mm, µN, µN·m, degrees; files hold SI units.
"""

import os

# Before NumPy is loaded: threads of linear algebra, which here is of small matrices, would mostly
# wait, and take cores from the threads that share rows out.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from vibrissa.cli.app import main

__all__ = [
    "main",
]

"""The command line: parse, call, print.

What is typed and printed is in mm, µN, µN·m, degrees; files hold SI units.
"""

from vibrissa.cli.app import main

__all__ = [
    "main",
]

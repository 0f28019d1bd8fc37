"""Command-line interface: each verb parses its options, calls a function and prints the results.

Options and printed values are in mm, µN, µN·m and degrees; files are in SI units.
"""

from vibrissa.cli.app import main

__all__ = [
    "main",
]

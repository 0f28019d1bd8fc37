"""How every test runs: figures without a window, random inputs without a deadline."""

import os

os.environ.setdefault("MPLBACKEND", "Agg")

from hypothesis import settings

# The first example of a law may compile a kernel, which takes seconds. In continuous integration
# the examples are the same in every run, so that a change fails by its own fault only.
settings.register_profile("vibrissa", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("vibrissa")

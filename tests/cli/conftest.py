"""What all tests of the command line share."""

import pytest


@pytest.fixture(autouse=True)
def quick(coarse):
    """What figures look like is tested with the figures."""

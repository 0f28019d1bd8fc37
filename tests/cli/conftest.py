"""What all tests of the command line share."""

import pytest


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Solids that are quicker to draw: what they look like is tested with the figures."""
    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))

"""What all tests of the command line share."""

import pytest

from vibrissa.plots.style import LOOK


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Figures that are quicker to draw: what they look like is tested with the figures."""
    monkeypatch.setattr("vibrissa.scene.solids._SHAPE", (12, 24, 8))
    monkeypatch.setattr("vibrissa.plots.style.LOOK", {**LOOK, "savefig.dpi": 80.0})

"""The contacts that a whisker can hold, sampled for the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vibrissa.mapping import ContactMap
from vibrissa.plots.chart import column, fine_chart
from vibrissa.quantities import to_display
from vibrissa.viewer.drawing import CLOUD, Array, Body, Bytes, Cloud
from vibrissa.whisker import Whisker

_SKIN = (36, 72, 12)
_POINT = 0.008
"""Width of a point of the cloud, over L."""


@dataclass(frozen=True, eq=False)
class Chart:
    """A whisker's map with the samples that are drawn.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    samples : Dataset
        Its nodes, ``ContactMap.to_dataset()``.
    line : array (k, 3)
        Centreline of the resting whisker, m.
    rows : array (n, columns)
        Contacts of the cloud and their signals, as of :mod:`vibrissa.plots.chart`; those within 2°
        of rest are left out.
    """

    contacts: ContactMap
    samples: xr.Dataset
    line: Array
    rows: Array

    @property
    def whisker(self) -> Whisker:
        """Whose contacts."""
        return self.contacts.whisker


def charted(whisker: Whisker, contacts: ContactMap | None = None) -> Chart:
    """Sample all stable contacts of a whisker; its map is made unless it is given."""
    contacts = contacts or ContactMap.simulate(whisker, grid=False)
    samples, line = contacts.to_dataset(), whisker.centerline()
    # As fine as the map itself, so that every contact is one of its own, exactly.
    cells = [samples.sizes[dim] - 1 for dim in ("station", "bearing", "load")]
    nodes = fine_chart(samples, line, shape=(cells[0], cells[1], cells[2]))
    # The last bearing is the first again, and no load is no contact.
    rows = nodes[:, :-1, 2::2].reshape(-1, nodes.shape[-1])
    return Chart(contacts, samples, line, rows[rows[:, column("deflection")] > 0.0])


def places(chart: Chart) -> Array:
    """Contact points (n, 3) of the cloud, mm."""
    return to_display("contact_point", chart.rows[:, :3])


def envelope(chart: Chart) -> Body:
    """The surface at which the whisker slips off, seen from inside, so that it hides nothing."""
    nodes = fine_chart(chart.samples, chart.line, shape=_SKIN)[..., :3]
    # The end near the base stays open.
    sheet = np.concatenate([nodes[:, :, -1], nodes[-1, :, -2::-1].swapaxes(0, 1)])
    count, around = sheet.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around - 1), indexing="ij")
    corner = (i * around + j).ravel()
    first = np.stack([corner, corner + 1, corner + around + 1], axis=1)
    second = np.stack([corner, corner + around + 1, corner + around], axis=1)
    faces = np.concatenate([first, second])
    return Body(to_display("contact_point", sheet.reshape(-1, 3)), faces, CLOUD, 0.35, "back")


def coloured_cloud(chart: Chart, points: Array, colours: Bytes) -> Cloud:
    """Contacts (n, 3), mm, in their colours (n, 3)."""
    return Cloud(points, colours, float(to_display("length", _POINT * chart.whisker.length)))

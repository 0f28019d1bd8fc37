"""The contacts that a whisker can hold, sampled for the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vibrissa.contacts import ContactMap
from vibrissa.plots.chart import fine_chart
from vibrissa.quantities import to_display
from vibrissa.signals import SIGNALS
from vibrissa.viewer.drawing import CLOUD, Array, Bytes, Cloud, Painted
from vibrissa.viewer.meshes import sheet
from vibrissa.whisker import Whisker

_SKIN = (12, 48, 6)
_POINT = 0.008
"""Width of a point of the cloud, over L."""


@dataclass(frozen=True, eq=False)
class Chart:
    """A whisker's map with the samples that are drawn."""

    contact_map: ContactMap
    samples: xr.Dataset
    line: Array
    points: Array
    signals: dict[str, Array]

    @property
    def whisker(self) -> Whisker:
        """Whose contacts."""
        return self.contact_map.whisker


def charted(whisker: Whisker, contact_map: ContactMap | None = None) -> Chart:
    """Sample all stable contacts of a whisker; its map is made unless it is given."""
    contact_map = contact_map or ContactMap.simulate(whisker, grid=False)
    samples, line = contact_map.to_dataset(), whisker.centerline()
    # The last bearing is the first again, and no load is no contact.
    kept = samples.isel(bearing=slice(0, -1), load=slice(2, None, 2))
    aside = ~kept["small_deflection"].to_numpy().astype(bool)
    signals = {name: kept[name].to_numpy()[aside] for name in SIGNALS}
    return Chart(contact_map, samples, line, kept["contact_point"].to_numpy()[aside], signals)


def places(chart: Chart) -> Array:
    """Contact points (n, 3) of the cloud, mm."""
    return to_display("contact_point", chart.points)


def envelope(chart: Chart) -> Painted:
    """The surface at which the whisker slips off, seen from inside, so that it hides nothing."""
    nodes = fine_chart(chart.samples, chart.line, shape=_SKIN)[..., :3]
    # The end near the base stays open.
    skin = np.concatenate([nodes[:, :, -1], nodes[-1, :, -2::-1].swapaxes(0, 1)])
    vertices, faces = sheet(to_display("contact_point", skin))
    triangles = vertices[faces]
    colours = np.broadcast_to(np.array(CLOUD, dtype=np.uint8), triangles.shape)
    return Painted(triangles, colours, 0.45, "back")


def coloured_cloud(chart: Chart, points: Array, colours: Bytes) -> Cloud:
    """Contacts (n, 3), mm, in their colours (n, 3)."""
    return Cloud(points, colours, float(to_display("length", _POINT * chart.whisker.length)))

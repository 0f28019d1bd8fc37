"""A trial that is known by construction: a straight whisker that turns about its base."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.cameras import cameras_dataset, orthogonal_views
from vibrissa.io import RECORDING_KIND
from vibrissa.objects import Peg, objects_datasets
from vibrissa.quantities import attributes
from vibrissa.recording import recorded

COUNT, LENGTH, NODES = 12, 40e-3, 21
AZIMUTH = np.linspace(-0.3, 0.3, COUNT)
SIZE = (300, 300)


class KnownTrial:
    """Contacts at 25 mm from the fifth frame on, estimated 1 mm farther out."""

    time = np.arange(COUNT) * 1e-3
    touching = np.arange(COUNT) >= 4
    azimuth = AZIMUTH
    length = LENGTH
    radius = 25e-3
    estimated_radius = 26e-3
    peg = Peg(np.array([25e-3, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 3e-3)
    views = orthogonal_views(2e-4, SIZE, center=(20e-3, 0.0, 0.0))

    def recording(self, *, signals=True, estimates=True) -> xr.DataTree:
        """With its truth; F_x falls and M_B rises steadily."""
        zero = np.zeros(COUNT)
        cos, sin = np.cos(self.azimuth), np.sin(self.azimuth)
        turn = np.zeros((COUNT, 1, 3, 3))
        turn[:, 0, 0, 0], turn[:, 0, 1, 1], turn[:, 0, 2, 2] = cos, cos, 1.0
        turn[:, 0, 1, 0], turn[:, 0, 0, 1] = sin, -sin
        way = np.stack([cos, sin, zero], axis=-1)
        line = np.linspace(0.0, LENGTH, NODES)[:, None] * way[:, None]

        def contact(radius):
            lab = np.where(self.touching[:, None], radius * way, np.nan)
            own = np.where(self.touching[:, None], [radius, 0.0, 0.0], np.nan)
            return {
                "contact_point": recorded("contact_point", lab),
                "contact_point_whisker": recorded("contact_point_whisker", own),
                "in_contact": recorded("in_contact", self.touching),
            }

        root = xr.Dataset(
            {
                "base_position": recorded("base_position", np.zeros((COUNT, 1, 3))),
                "base_rotation": recorded("base_rotation", turn),
            },
            {
                "time": ("time", self.time, attributes("time")),
                "whisker": ["w"],
                "space": list("xyz"),
            },
            {"kind": RECORDING_KIND},
        )
        truth = contact(self.radius) | {
            "centerline": recorded("centerline", line),
        }
        groups = {"/": root, "/truth": xr.Dataset(truth)}
        groups["/cameras"] = cameras_dataset(self.views)
        groups["/whiskers/0"] = vb.Whisker.straight(LENGTH).to_dataset().drop_dims("node")
        groups["/objects"] = xr.Dataset()
        for name, dataset in objects_datasets([self.peg]).items():
            groups[f"/objects/{name}"] = dataset.drop_vars("space")
        share = np.linspace(0.0, 1.0, COUNT)
        if signals:
            groups["/signals"] = xr.Dataset(
                {
                    "Fx": recorded("Fx", -2e-5 * share),
                    "MB": recorded("MB", 4e-7 * share),
                    "MD": recorded("MD", np.full(COUNT, 1.5)),
                    "in_contact": recorded("in_contact", self.touching),
                }
            )
        if estimates:
            groups["/estimates"] = xr.Dataset(contact(self.estimated_radius))
        return xr.DataTree.from_dict(groups)


@pytest.fixture
def known() -> KnownTrial:
    """A trial that is known by construction."""
    return KnownTrial()

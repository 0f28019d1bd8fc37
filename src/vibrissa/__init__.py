"""From the forces and moments at a whisker's base to the object that it touched.

The names here are the public face of the package. Each is imported from its home when it is first
used, so that ``import vibrissa`` takes milliseconds and Numba, SciPy, xarray and Matplotlib load
only when needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vibrissa._version import __version__
from vibrissa.deferred import names_from

if TYPE_CHECKING:
    from vibrissa import (
        cameras,
        certificates,
        contacts,
        contour,
        evaluation,
        identifiability,
        io,
        numerics,
        objects,
        paper,
        pipeline,
        plots,
        quantities,
        recording,
        report,
        rod,
        samples,
        scene,
        sensors,
        signals,
        simulation,
        status,
        streaming,
        sweeps,
        tracking,
        viewer,
        whisker,
    )
    from vibrissa.contacts import (
        Contact,
        ContactFilter,
        ContactMap,
        Contacts,
        Estimator,
        Gravity,
        Prior,
        estimate_around,
        estimate_from_wrench,
        second_contact,
    )
    from vibrissa.display import show
    from vibrissa.identifiability import best_triplet, critical_cones, sensitivity, uniqueness
    from vibrissa.io import load_array, load_recording, load_signals, load_tracks, load_whisker
    from vibrissa.paper import sensitivity_findings
    from vibrissa.report import in_space
    from vibrissa.rod import (
        Deflection,
        PegContact,
        PointContact,
        PointForce,
        Resting,
        deflect,
        deflect_around,
        resting,
    )
    from vibrissa.signals import base_signals
    from vibrissa.sketch import progress
    from vibrissa.status import Status
    from vibrissa.whisker import Whisker, WhiskerArray, whisker_array


__all__ = [
    "Contact",
    "ContactFilter",
    "ContactMap",
    "Contacts",
    "Deflection",
    "Estimator",
    "Gravity",
    "PegContact",
    "PointContact",
    "PointForce",
    "Prior",
    "Resting",
    "Status",
    "Whisker",
    "WhiskerArray",
    "__version__",
    "base_signals",
    "best_triplet",
    "cameras",
    "certificates",
    "contacts",
    "contour",
    "critical_cones",
    "deflect",
    "deflect_around",
    "estimate_around",
    "estimate_from_wrench",
    "evaluation",
    "identifiability",
    "in_space",
    "io",
    "load_array",
    "load_recording",
    "load_signals",
    "load_tracks",
    "load_whisker",
    "numerics",
    "objects",
    "paper",
    "pipeline",
    "plots",
    "progress",
    "quantities",
    "recording",
    "report",
    "resting",
    "rod",
    "samples",
    "scene",
    "second_contact",
    "sensitivity",
    "sensitivity_findings",
    "sensors",
    "show",
    "signals",
    "simulation",
    "status",
    "streaming",
    "sweeps",
    "tracking",
    "uniqueness",
    "viewer",
    "whisker",
    "whisker_array",
]
__dir__ = __all__.copy  # completion lists the public names only, here and in every package

# Names by the package or module that they are imported from.
_HOMES = {
    "contacts": "Contact ContactFilter ContactMap Contacts Estimator Gravity Prior estimate_around "
    "estimate_from_wrench second_contact",
    "display": "show",
    "identifiability": "best_triplet critical_cones sensitivity uniqueness",
    "io": "load_array load_recording load_signals load_tracks load_whisker",
    "paper": "sensitivity_findings",
    "report": "in_space",
    "rod": "Deflection PegContact PointContact PointForce Resting deflect deflect_around resting",
    "signals": "base_signals",
    "sketch": "progress",
    "status": "Status",
    "whisker": "Whisker WhiskerArray whisker_array",
}

__getattr__ = names_from(__name__, _HOMES, __all__)

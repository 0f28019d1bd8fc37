"""Interactive 3D figures of whiskers, contacts and objects.

Coordinates are in mm, in the laboratory frame for a trial and in the whisker frame for a map. The
drawing library is optional: it is imported in this module only, and its script is embedded once.
"""

from __future__ import annotations

from html import escape
from importlib.util import find_spec
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contacts import ContactMap
from vibrissa.contour import shape_from_dataset, surface_grid
from vibrissa.numerics import Array
from vibrissa.quantities import quantity, shown_unit
from vibrissa.report.page import Section, paragraph
from vibrissa.rod import Deflection
from vibrissa.scene import Course, course_of, object_surface
from vibrissa.sketch import BENT, REST, thinned
from vibrissa.whisker import Whisker

# Message shown where the drawing library is not installed.
NO_SPACE = "The 3D picture needs Plotly: `pip install 'vibrissa[report]'`."
_NODES = 101  # number of points of a whisker
_MOST_POINTS = 4000
_SHAPES = 7  # number of bent whiskers that are drawn
_ROOM = 0.15  # margin around the contacts, as a share of their extent
_CAMERA = {"eye": {"x": 1.65, "y": -1.8, "z": 1.05}, "center": {"x": 0.0, "y": 0.0, "z": -0.12}}


def can_draw() -> bool:
    """Whether the drawing library is installed."""
    return find_spec("plotly") is not None


def in_space(result: Any) -> Any:
    """Draw a result as an interactive 3D figure, as in a notebook.

    Parameters
    ----------
    result : Whisker, Deflection, ContactMap or DataTree
        Whisker at rest; bent whiskers, of which some are drawn, with all contacts; all stable
        contacts of a whisker, coloured by the bending moment; or a recording, whose first whisker
        is drawn with its contact points and the known and fitted objects.

    Returns
    -------
    plotly.graph_objects.Figure
        Figure with axes in mm, which notebooks display.

    Raises
    ------
    ModuleNotFoundError
        If Plotly is not installed.
    ValueError
        If ``result`` is none of these, or there are no contacts to draw.
    """
    if not can_draw():
        raise ModuleNotFoundError(NO_SPACE)
    if isinstance(result, xr.DataTree):
        return trial_in_space(result, course_of(result))
    if isinstance(result, ContactMap):
        return reachable_space(result.to_dataset(), result.whisker.centerline(_NODES))
    if isinstance(result, Deflection):
        return _bent_in_space(result)
    if isinstance(result, Whisker):
        line = result.centerline(_NODES)
        return _framed(_whiskers(line[None], "at rest"), "whisker")
    raise ValueError(
        f"got {type(result).__name__}; a whisker, a deflection, a map of contacts or a recording "
        "is needed"
    )


def _bent_in_space(bent: Deflection) -> Any:
    """Draw bent whiskers, the resting one and the contact points."""
    rest = bent.whisker.centerline(_NODES)
    lines = bent.centerline(_NODES).reshape(-1, _NODES, 3)
    drawn = [*_whiskers(rest[None], "at rest", REST), *_whiskers(lines, "bent", BENT)]
    force = np.linalg.norm(bent.force, axis=-1).reshape(-1)
    known = np.isfinite(bent.contact_point).all(axis=-1).reshape(-1) & (force > 0.0)
    if known.any():
        points = 1e3 * bent.contact_point.reshape(-1, 3)[known]
        drawn.append(_points(points, "force", force[known], "contacts"))
    return _framed(drawn, "whisker")


def trial_in_space(trial: xr.DataTree, course: Course) -> Any:
    """Draw contact points of a recording, laboratory frame, with its known and fitted objects."""
    import plotly.graph_objects as go

    places = course.places
    known = np.zeros(0, bool) if places is None else np.isfinite(places).all(axis=-1)
    if places is None or not known.any():
        raise ValueError("there are no contact points to draw")
    points = 1e3 * places[known]
    drawn = [_points(points, "time", course.time[known], f"{course.places_as} contacts")]
    low, high = points.min(axis=0), points.max(axis=0)
    room = _ROOM * max(float((high - low).max()), 1.0)
    limits = np.stack([low - room, high + room], axis=1)
    for thing in trial["objects"].children.values() if "objects" in trial.children else ():
        vertices, faces = object_surface(thing.to_dataset(), limits)
        corners = dict(zip("xyz", vertices.T, strict=True)) | dict(zip("ijk", faces.T, strict=True))
        look = {"color": REST, "opacity": 0.35, "showlegend": True}
        drawn.append(go.Mesh3d(**corners, **look, name=f"{thing.attrs['kind']}, known"))
    if "contour" in trial.children:
        fit = shape_from_dataset(trial["contour"].to_dataset())
        grid = 1e3 * surface_grid(fit, places[known])["surface_grid_point"].values
        places_of = dict(zip("xyz", np.moveaxis(grid, -1, 0), strict=True))
        colours = {"colorscale": [[0.0, BENT], [1.0, BENT]], "showscale": False, "opacity": 0.4}
        name = f"{fit.kind}, fitted"
        drawn.append(go.Surface(**places_of, **colours, name=name, showlegend=True))
    if course.centerline is not None:
        drawn += _whiskers(course.centerline[known])
    return _framed(drawn, "laboratory")


def reachable_space(samples: xr.Dataset, centerline: Array) -> Any:
    """Draw all stable contacts of a whisker, coloured by the bending moment.

    Parameters
    ----------
    samples : Dataset
        ``ContactMap.to_dataset()``.
    centerline : array (k, 3)
        Resting whisker, m.

    Returns
    -------
    plotly.graph_objects.Figure
        Figure with axes in mm.
    """
    points = 1e3 * samples["contact_point"].transpose(..., "space").values.reshape(-1, 3)
    values = samples["MB"].values.reshape(-1)
    known = np.isfinite(points).all(axis=1) & np.isfinite(values)
    both = np.column_stack([points[known], values[known]])
    # A random choice avoids patterns due to the grid.
    both = thinned(np.random.default_rng(0).permutation(both), _MOST_POINTS)
    drawn = [_points(both[:, :3], "MB", both[:, 3], "contacts")]
    return _framed([*drawn, *_whiskers(centerline[None], "resting whisker")], "whisker")


def space_section(figure: Any, about: str) -> tuple[Section, str]:
    """Section with an interactive figure, and its script."""
    from plotly.offline import get_plotlyjs

    drawn = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id="space-picture",
        default_height="100%",
        config={"displaylogo": False, "responsive": True, "showSendToCloud": False},
    )
    hint = paragraph(f"{about} Drag to turn, scroll to zoom, click a name to hide it.", "note")
    body = f'<div class="space" role="img" aria-label="{escape(about)}">{drawn}</div>{hint}'
    return Section("space", "In space", body), get_plotlyjs()


def _points(points: Array, name: str, values: Array, label: str) -> Any:
    """Markers coloured by a quantity in SI units."""
    import plotly.graph_objects as go

    known = quantity(name)
    factor, unit = shown_unit(name, values)
    bar = {
        "title": {"text": f"{known.long_name} ({unit})", "side": "right"},
        "thickness": 12,
        "len": 0.6,
    }
    look = {"size": 2.5, "color": factor * values, "colorscale": "Viridis"}
    x, y, z = points.T
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker={**look, "colorbar": bar}, name=label)


def _whiskers(lines: Array, label: str = "whisker", colour: str = "#a0522d") -> list[Any]:
    """Lines of some of the whiskers (n, k, 3), m."""
    import plotly.graph_objects as go

    some = thinned(lines[np.isfinite(lines).all(axis=(1, 2))], _SHAPES)
    drawn = []
    look = {"mode": "lines", "line": {"color": colour, "width": 3}, "hoverinfo": "skip"}
    for count, line in enumerate(some):
        x, y, z = 1e3 * line.T
        legend = {"name": label, "legendgroup": label, "showlegend": count == 0}
        drawn.append(go.Scatter3d(x=x, y=y, z=z, **look, **legend))
    return drawn


def _framed(drawn: list[Any], frame: str) -> Any:
    """Figure with axes of equal scale."""
    import plotly.graph_objects as go

    titles = {f"{axis}axis": {"title": {"text": f"{axis} (mm)"}} for axis in "xyz"}
    return go.Figure(
        drawn,
        {
            "template": "plotly_white",
            "scene": {**titles, "aspectmode": "data", "camera": _CAMERA},
            "margin": {"l": 0, "r": 30, "t": 36, "b": 0},
            "legend": {"x": 0.0, "y": 1.0},
            "title": {"text": f"{frame} frame", "font": {"size": 13}, "x": 0.5},
        },
    )

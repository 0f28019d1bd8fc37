"""`vibrissa figures`: everything that can be drawn from a map, or from a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from vibrissa.cli.terminal import Force, free, output, progress_bars, refuse

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from vibrissa.contacts import ContactMap
    from vibrissa.rod import Deflection
    from vibrissa.whisker import Whisker

    Array = NDArray[np.float64]

Draw = Callable[[], Any]
_FORMATS = ("png", "pdf", "svg")
_WIDTHS = ("single", "double")
_COLOURS = ("time", "deflection")
_NODES = 101
_AGREE = 1e-6
"""How closely signals of a saved witness must agree with those of the map's whisker."""


def figures(
    path: Annotated[
        Path, typer.Argument(help="A map of contacts, or the recording of a trial, NetCDF.")
    ],
    folder: Annotated[
        Path, typer.Option("--output", "-o", help="Where figures go.", metavar="DIR")
    ] = Path("figures"),
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", help="png, pdf or svg; may be repeated. Default: png and pdf."),
    ] = None,
    width: Annotated[
        str, typer.Option(help="For one column of a journal, 85 mm, or two, 178 mm.")
    ] = "double",
    uniqueness: Annotated[
        Path | None,
        typer.Option(
            help="Saved result (.nc) of `vibrissa uniqueness` for this map.", metavar="FILE"
        ),
    ] = None,
    cones: Annotated[
        Path | None,
        typer.Option(help="Critical cones by curvature and taper, NetCDF.", metavar="FILE"),
    ] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            "--video", help="Of a trial: the video of a view, top and then front.", metavar="FILE"
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        typer.Option("--map", help="Of a trial's whisker; simulated by default.", metavar="MAP"),
    ] = None,
    whisker: Annotated[
        int | None, typer.Option(help="Of a trial: which whisker, from 0 (the default).")
    ] = None,
    colour: Annotated[
        str | None,
        typer.Option(help="Of a trial's contacts in both frames: time (by default) or deflection."),
    ] = None,
    force: Force = False,
) -> None:
    """Draw the figures that a map or a trial allows.

    A map: whisker, signals over space, surfaces, sensitivity; with a saved result of `vibrissa
    uniqueness` also the verdicts, the resolution and pairs of contacts that feel the same. A trial:
    frames, signals and their way through the solids of a map, contacts about the whisker and in the
    laboratory, estimates, contour. An array of whiskers, or a trial of several: the face, the
    whiskers, and what they touch. Example: `vibrissa figures map.nc -o figures --width single`
    """
    endings = _chosen(formats, width)
    if colour not in (None, *_COLOURS):
        raise ValueError(f"--colour is {colour!r}; one of {', '.join(_COLOURS)} is needed")
    from vibrissa.cli.array_figures import array_drawings
    from vibrissa.cli.sources import map_from
    from vibrissa.cli.trial_figures import trial_drawings
    from vibrissa.io import Kind, recognise
    from vibrissa.io.paths import check_folder
    from vibrissa.plots import save

    check_folder(folder)
    verdicts = None if uniqueness is None else dataset_with(uniqueness, "verdict")
    sweep = None if cones is None else dataset_with(cones, "critical_cone")
    with progress_bars() as tell:
        drawings = array_drawings(path, width)
        if not path.is_dir() and recognise(path) == Kind.RECORDING:
            refuse({"--uniqueness": uniqueness, "--cones": cones}, f"{path} is a recording")
            drawings |= trial_drawings(
                path, width, videos or [], chart, whisker or 0, tell, colour or "time"
            )
        else:
            options = {"--video": videos, "--map": chart, "--whisker": whisker, "--colour": colour}
            refuse(options, f"{path} is no recording")
        if not drawings:
            drawings = dict(map_drawings(map_from(path), width, verdicts, sweep))
        free([folder / f"{name}.{ending}" for name in drawings for ending in endings], force)
        folder.mkdir(parents=True, exist_ok=True)
        files = []
        for i, (name, draw) in enumerate(drawings.items()):
            tell("figures", i, len(drawings))
            files += save(draw(), folder / name, endings)
        tell("figures", len(drawings), len(drawings))
    for file in files:
        output.print(f"wrote {file}", highlight=False, soft_wrap=True)


def _chosen(formats: list[str] | None, width: str) -> list[str]:
    """Check what was asked for before anything is read."""
    endings = list(dict.fromkeys(formats or ["png", "pdf"]))
    unknown = [ending for ending in endings if ending not in _FORMATS]
    if unknown:
        raise ValueError(f"--format is {unknown[0]!r}; one of {', '.join(_FORMATS)} is needed")
    if width not in _WIDTHS:
        raise ValueError(f"--width is {width!r}; one of {', '.join(_WIDTHS)} is needed")
    return endings


def dataset_with(path: Path, needed: str) -> xr.Dataset:
    """Read a dataset that holds a variable."""
    from vibrissa.io import kind_of
    from vibrissa.io.netcdf import read_dataset
    from vibrissa.io.paths import CSV

    if path.suffix.lower() in CSV:
        raise ValueError(f"{path} is a table; the same saved as NetCDF (-o FILE.nc) is needed")
    kind = kind_of(path)
    data = read_dataset(path)
    if needed not in data:
        raise ValueError(
            f"{path} holds {kind or 'data of another kind'}, and no variable {needed!r}"
        )
    return data


def map_drawings(
    contact_map: ContactMap, width: Any, verdicts: xr.Dataset | None, cones: xr.Dataset | None
) -> Iterator[tuple[str, Draw]]:
    """Say what can be drawn of a map."""
    from vibrissa import plots

    whisker = contact_map.whisker
    line = whisker.centerline(_NODES)
    radius = whisker.radius(np.linspace(0.0, whisker.length, _NODES))
    samples = contact_map.to_dataset()
    assumed = whisker.assumed
    yield (
        "whisker",
        lambda: plots.whisker_views(line, radius, name=whisker.name, assumed=assumed, width=width),
    )
    yield "signal_space", lambda: plots.signal_clouds(samples, line, width=width)
    yield "contact_surfaces", lambda: plots.contact_surfaces(samples, line, width=width)
    yield "sensitivity", lambda: plots.sensitivity_panels(_derivatives(contact_map), width=width)
    yield "solid", lambda: plots.solid_slices(*_solid(contact_map), width=width)
    if cones is not None:
        yield "critical_cones", lambda: plots.critical_cones(cones, width=width)
    if verdicts is None:
        return
    yield "verdicts", lambda: plots.verdict_table(verdicts, width=width)
    if "ambiguous_share" in verdicts:
        yield "resolution", lambda: plots.resolution(verdicts, width=width)
    for name, pair in witnesses(whisker, verdicts):
        drawn = partial(plots.witness_pair, pair, width=width)
        yield f"witness_{name.replace(' ', '_')}", drawn


def _derivatives(contact_map: ContactMap) -> xr.Dataset:
    """Derivatives at the paper's contacts, which fill the panels best, or at the map's."""
    from vibrissa.identifiability import sensitivity

    return sensitivity(contact_map, at=None if contact_map.grid is None else "grid")


def _solid(contact_map: ContactMap) -> tuple[xr.Dataset, xr.Dataset | None]:
    """The slice at M_D = −π/2, and all contacts with the errors of a look-up in the grid."""
    from vibrissa.paper import error_solid, signal_slice

    return signal_slice(contact_map), None if contact_map.grid is None else error_solid(contact_map)


def witnesses(whisker: Whisker, verdicts: xr.Dataset) -> Iterator[tuple[str, xr.Dataset]]:
    """Bend a whisker into the farthest pair of contacts that feel the same, for chosen triplets."""
    from vibrissa.plots.evidence import HIGHLIGHTED

    needed = {"witness_arc_length", "witness_contact_force", "witness_separation"}
    if not needed <= set(verdicts.data_vars):
        return
    chosen = str(verdicts.attrs.get("chosen_triplet", ""))
    known = set(map(str, verdicts["triplet"].values))
    for triplet in dict.fromkeys((*HIGHLIGHTED, chosen)):
        if triplet not in known:
            continue
        found = verdicts.sel(triplet=triplet)
        if "all" in found["region"].values:
            found = found.sel(region=["all"])
        apart = found["witness_separation"].transpose("region", "witness").values
        if np.isfinite(apart).any():
            region, witness = np.unravel_index(np.nanargmax(apart), apart.shape)
            farthest = found.isel(region=int(region), witness=int(witness))
            yield triplet, _bent(whisker, farthest, triplet)


def _bent(whisker: Whisker, found: xr.Dataset, triplet: str) -> xr.Dataset:
    """The two whiskers of one witness."""
    import xarray as xr

    from vibrissa.rod import PointForce, deflect
    from vibrissa.signals import base_signals

    force = found["witness_contact_force"].transpose("pair", "component").values
    components = np.column_stack([np.zeros(2), force])
    arc_length = found["witness_arc_length"].values
    bent = deflect(whisker, PointForce(arc_length, components=components))
    signals = base_signals(bent.force, bent.moment)
    if "witness_signals" in found:
        _check_whisker(bent, signals, triplet, found["witness_signals"].values)
    data = xr.Dataset(
        {
            "rest": (("node", "space"), whisker.centerline(_NODES)),
            "centerline": (("pair", "node", "space"), bent.centerline(_NODES)),
            "contact_point": (("pair", "space"), bent.contact_point),
            "force": (("pair", "space"), bent.force),
            "arc_length": ("pair", bent.arc_length),
        },
        attrs={"triplet": triplet},
    )
    return data.assign({name: ("pair", values.values) for name, values in signals.items()})


def _check_whisker(bent: Deflection, signals: xr.Dataset, triplet: str, saved: Array) -> None:
    """Raise unless the first contact feels here as it did where the verdicts were made."""
    names = triplet.split()
    felt = np.array([signals[name].values[0] for name in names])
    force, moment = (float(np.linalg.norm(v[0])) for v in (bent.force, bent.moment))
    sizes = {"Fx": force, "FT": force, "Mx": moment, "MB": moment}
    gap = [
        abs(a - b) / sizes[name] if name in sizes else abs(np.angle(np.exp(1j * (a - b))))
        for name, a, b in zip(names, felt, saved, strict=True)
    ]
    if not np.max(gap) < _AGREE:  # also where the whisker holds no such contact
        raise ValueError(
            f"the verdicts are not of this map's whisker: for ({triplet}) the first contact of a "
            f"witness feels {felt} here, and {saved} where the verdicts were made"
        )

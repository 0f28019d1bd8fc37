"""The options of the command line, each defined once: a name means the same in all verbs.

Lengths are in mm, forces in µN, moments in µN·m and angles in degrees, unless the help of an option
states another unit.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_type_hints

import typer

_NAMED = 3
"""How many files are named in one message."""

# Files that verbs read ----------------------------------------------------------------------------

RecordingArgument = Annotated[
    Path, typer.Argument(help="A recording, NetCDF (.nc).", metavar="TRIAL.nc")
]
MapArgument = Annotated[
    Path, typer.Argument(help="A map, as `vibrissa map` writes it, NetCDF (.nc).", metavar="MAP.nc")
]
WhiskerOption = Annotated[
    Path | None,
    typer.Option(
        "--whisker",
        help="The whisker: a digitised centreline (.csv), or a recording or map that holds it "
        "(.nc). By default that of the recording; where there is none a built-in γ whisker.",
        metavar="FILE",
    ),
]
RatOption = Annotated[
    str | None,
    typer.Option(
        "--rat",
        help="Radii of the whisker by published regressions: row and column of a rat's whisker, "
        "such as C2, or any, where only its length is known.",
        metavar="NAME",
    ),
]
AnyLengthOption = Annotated[
    bool,
    typer.Option(
        "--any-length", help="A whisker shorter than 0.5 mm or longer than 0.5 m is meant."
    ),
]
MapOption = Annotated[
    Path | None,
    typer.Option("--map", help="Map of the whisker; by default it is simulated.", metavar="FILE"),
]
MapsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--map",
        help="Map of the whisker; by default it is simulated. Of several whiskers: one for each, "
        "in their order.",
        metavar="FILE",
    ),
]
VideosOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--video",
        help="Video of a view of the trial; one for each camera, in their order (top, front).",
        metavar="FILE",
    ),
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        "--cameras",
        help="Calibrated cameras: TOML of Anipose, or a recording that holds them (.nc).",
        metavar="FILE",
    ),
]
ObjectsOption = Annotated[
    Path | None,
    typer.Option(
        "--objects",
        help="Known objects: TOML with [[object]] as a trial has, or a recording that holds them.",
        metavar="FILE",
    ),
]
CorrectionsOption = Annotated[
    Path | None,
    typer.Option(
        "--corrections", help="Corrected traces: CSV of view,frame,whisker,x,y.", metavar="FILE"
    ),
]
HeadOption = Annotated[
    Path | None,
    typer.Option(
        "--head",
        help="Pose of the head: CSV of frame (or time), x, y, z and qw, qx, qy, qz (or a matrix, "
        "or azimuth, elevation, roll), or a recording.",
        metavar="FILE",
    ),
]
ContactOption = Annotated[
    Path | None,
    typer.Option(
        "--contact",
        help="Contact points tracked otherwise, to compare with: CSV of frame (or time), x, y, z, "
        "m, or of view, frame, x, y in pixels.",
        metavar="FILE",
    ),
]
SensorOption = Annotated[
    Path | None,
    typer.Option(
        "--sensor",
        help="Description of the sensor, TOML: the lines then carry its channels, raw.",
        metavar="FILE",
    ),
]
UniquenessOption = Annotated[
    Path | None,
    typer.Option(
        "--uniqueness",
        help="Result of `vibrissa uniqueness` for the map, NetCDF (.nc).",
        metavar="FILE",
    ),
]
ConesOption = Annotated[
    Path | None,
    typer.Option(
        "--cones", help="Critical cones by curvature and taper, NetCDF (.nc).", metavar="FILE"
    ),
]
TrialOption = Annotated[
    Path | None,
    typer.Option(
        "--trial",
        help="Recording, or table of signals, of the contacts of interest.",
        metavar="FILE",
    ),
]
TraceOption = Annotated[
    Path | None,
    typer.Option("--trace", help="Tracked recording whose traces are shown (.nc).", metavar="FILE"),
]
MoviesOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--movie",
        help="Movie that the page shows, .mp4; may be repeated. Linked if the page would be "
        "larger than 15 MB.",
        metavar="FILE",
    ),
]

# What verbs write ---------------------------------------------------------------------------------


def written(what: str, metavar: str = "FILE") -> Any:
    """Define the option of where the result goes."""
    return typer.Option("--output", "-o", help=f"Where the result goes: {what}.", metavar=metavar)


ForceOption = Annotated[bool, typer.Option("--force", help="Replace files that are there already.")]
TableOption = Annotated[
    Path | None,
    typer.Option(
        "--csv",
        help="Table of the contour points; by default NAME_contour.csv next to the result.",
        metavar="FILE",
    ),
]
FilmOption = Annotated[
    Path | None,
    typer.Option("--film", help="Folder for videos of the two views.", metavar="DIR"),
]
BagOption = Annotated[
    Path | None,
    typer.Option(
        "--bag-out", help="New ROS 2 bag for PointStamped and PointCloud2.", metavar="FOLDER"
    ),
]
GridOption = Annotated[
    bool,
    typer.Option("--grid/--no-grid", help="Whether the paper's 237,765 points are solved too."),
]
ExampleOption = Annotated[
    bool, typer.Option("--example", help="Print a file with all that can be stated, and stop.")
]

# Signals, and contacts estimated from them --------------------------------------------------------

Source = Literal["contact-point", "rod", "sensor"]
SourceOption = Annotated[
    Source | None,
    typer.Option(
        "--source",
        help="What signals come from: the contact point that was tracked (the paper's method), "
        "the rod that fits the images, or the sensor; by default the sensor if there is one, or "
        "else the contact point.",
    ),
]
CutoffOption = Annotated[
    float | None,
    typer.Option(
        "--cutoff",
        help="Cut-off of the low pass on the pose of the whisker's base, Hz; 85 by default, "
        "0: none.",
        metavar="HZ",
    ),
]
UsingOption = Annotated[
    str | None,
    typer.Option(
        "--using",
        help="Signals to use: three or more of Fx, FT, FD, Mx, MB, MD; or `wrench`, force and "
        "moment whole, which allows for friction and needs no map. By default Fx,MB,MD, and of "
        "signals of the rod the wrench.",
        metavar="A,B,C",
    ),
]
TripletOption = Annotated[
    str, typer.Option("--using", help="Signals to use: three.", metavar="A,B,C")
]
TripletsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--using",
        help="Signals to use: three; may be repeated. By default each of the 20 triplets.",
        metavar="A,B,C",
    ),
]
Method = Literal["exact", "lookup", "lookup-linear", "network"]
MethodOption = Annotated[
    Method,
    typer.Option(
        "--method",
        help="How contacts are found. As the paper did, of three signals and one contact where "
        "there are several: by look-up in the map's grid, or by a network, trained first.",
    ),
]
ProximalOption = Annotated[
    float | None,
    typer.Option(
        "--proximal",
        help="Smallest arc length of a contact that is considered, share of the whisker's length; "
        "0.3 by default.",
        metavar="SHARE",
    ),
]
ForceNoiseOption = Annotated[
    float | None,
    typer.Option(
        "--force-noise",
        help="Standard deviation of a force component, µN; by default as recorded, or 1.",
        min=0.0,
        metavar="µN",
    ),
]
MomentNoiseOption = Annotated[
    float | None,
    typer.Option(
        "--moment-noise",
        help="Standard deviation of a moment component, µN·m; by default as recorded, or 0.02.",
        min=0.0,
        metavar="µN·m",
    ),
]
CovarianceOption = Annotated[
    Path | None,
    typer.Option(
        "--covariance",
        help="Instead: covariance of Fx, Fy, Fz, Mx, My, Mz, six lines of six numbers in SI units.",
        metavar="FILE",
    ),
]
StiffnessSigmaOption = Annotated[
    float,
    typer.Option(
        "--stiffness-sigma",
        help="Standard deviation of the whisker's bending stiffness, %; the same error in all "
        "samples.",
        min=0.0,
        metavar="%",
    ),
]
GainSigmaOption = Annotated[
    float,
    typer.Option(
        "--gain-sigma",
        help="Standard deviation of the gain of each component of force and moment, %; likewise.",
        min=0.0,
        metavar="%",
    ),
]
MixingSigmaOption = Annotated[
    float,
    typer.Option(
        "--mixing-sigma",
        help="Standard deviation of the cross-talk among components of force, and of moment, %; "
        "likewise.",
        min=0.0,
        metavar="%",
    ),
]
RegionOption = Annotated[
    str | None,
    typer.Option(
        "--region",
        help="Region of the contacts that are considered: ELD, CF, CB, 'ELD CF' or 'ELD CB'; or "
        "limits of r (mm), theta and phi (degrees), as r=20:35,theta=-30:30.",
        metavar="REGION",
    ),
]


class Region(StrEnum):
    """Regions of contacts that have a name."""

    ALL = "all"
    ELD = "ELD"
    CF = "CF"
    CB = "CB"
    ELD_CF = "ELD CF"
    ELD_CB = "ELD CB"


class Format(StrEnum):
    """Formats of figures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


RegionsOption = Annotated[
    list[Region] | None,
    typer.Option(
        "--region",
        help="Region of the contacts that are considered: may be repeated. By default all six.",
    ),
]
LeastForceOption = Annotated[
    float | None,
    typer.Option("--least-force", help="Smallest force of a contact, µN.", min=0.0, metavar="µN"),
]
GreatestForceOption = Annotated[
    float | None,
    typer.Option("--greatest-force", help="Largest force of a contact, µN.", min=0.0, metavar="µN"),
]
ThresholdOption = Annotated[
    float,
    typer.Option(
        "--threshold",
        help="Bending moment from which there is a contact, standard deviations of its noise.",
        min=0.0,
    ),
]

# Trials and whiskers ------------------------------------------------------------------------------

WhichOption = Annotated[
    int | None,
    typer.Option("--which", help="Number of the whisker in the recording, from 0.", min=0),
]
NoiseOption = Annotated[
    bool,
    typer.Option(
        "--noise/--no-noise",
        help="Whether the simulated sensor has noise, by default 1 µN and 0.02 µN·m.",
    ),
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", help="Seed of random numbers; 0 by default.", min=0)
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", help="Duration of the trial, s.", metavar="S")
]
RateOption = Annotated[
    float | None,
    typer.Option("--rate", help="Frames per second of the trial; 1000 by default.", metavar="HZ"),
]
Side = Literal["both", "left", "right"]
BaseRadiusOption = Annotated[
    float | None,
    typer.Option("--base-radius", help="Radius of the whisker at its base, mm.", metavar="MM"),
]
AxisOption = Annotated[
    str | None,
    typer.Option("--axis", help="Direction of the axis of a peg or cylinder.", metavar="X,Y,Z"),
]

# Reading what was typed ---------------------------------------------------------------------------

Verb = TypeVar("Verb", bound=Callable[..., None])


def with_bundles(verb: Verb) -> Verb:
    """Let a verb have each field of its parameters that are data classes as an option."""
    hints = get_type_hints(verb, include_extras=True)
    given = inspect.signature(verb).parameters.values()
    flat = _flat({one.name: (hints[one.name], one.default) for one in given})

    @wraps(verb)
    def with_options(**values: Any) -> None:
        verb(**_filled({one.name: hints[one.name] for one in given}, values))

    with_options.__annotations__ = {one.name: one.annotation for one in flat}
    with_options.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
    return cast(Verb, with_options)


def _flat(kinds: Mapping[str, tuple[Any, Any]]) -> list[inspect.Parameter]:
    """Options, with the fields of data classes in their place."""
    found = []
    for name, (kind, default) in kinds.items():
        if is_dataclass(kind):
            hints = get_type_hints(kind, include_extras=True)
            found += _flat({one.name: (hints[one.name], one.default) for one in fields(kind)})
        else:
            # Options are passed by name, so that those without a default may follow others.
            default = inspect.Parameter.empty if default is MISSING else default
            how = inspect.Parameter.KEYWORD_ONLY
            found.append(inspect.Parameter(name, how, default=default, annotation=kind))
    return found


def _filled(kinds: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by name, those of data classes put together."""
    found = {}
    for name, kind in kinds.items():
        if is_dataclass(kind):
            found[name] = cast(type, kind)(**_filled(get_type_hints(kind), values))
        else:
            found[name] = values[name]
    return found


def numbers(text: str, names: Sequence[str], option: str) -> list[float]:
    """Read numbers separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise ValueError(f"{option} is {text!r}; {','.join(names)} are needed")
    return values


def free(files: Iterable[Path], force: bool) -> None:
    """Raise if files are there that are not to be replaced."""
    there = [str(file) for file in files if not force and file.exists()]
    if there:
        more = f" and {len(there) - _NAMED} more" if len(there) > _NAMED else ""
        are = "is" if len(there) == 1 else "are"
        raise FileExistsError(
            f"{', '.join(there[:_NAMED])}{more} {are} there already: write elsewhere with "
            "--output, or replace with --force"
        )


def refuse(options: Mapping[str, object], reason: str) -> None:
    """Raise if options are given that would have no effect."""
    given = [name for name, value in options.items() if not _nothing(value)]
    if given:
        raise ValueError(f"{', '.join(given)} cannot be used: {reason}")


def _nothing(value: object) -> bool:
    # Zero is a number that was given.
    return value is None or value is False or value in ([], ())

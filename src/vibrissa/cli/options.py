"""The options of the command line, each defined once: a name means the same in all verbs.

Lengths are in mm, forces in µN, moments in µN·m and angles in degrees, unless the help of an option
states another unit. A verb has options as parameters, by their names; their types say which values
there are.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast, get_origin, get_type_hints

import typer

import vibrissa as vb

_NAMED = 3
"""Number of files named in one message."""


class Option(NamedTuple):
    """Meaning of an option.

    Its names are that of the parameter, and of a switch that is on by default also its opposite,
    unless others are stated.
    """

    help: str
    metavar: str | None = None
    names: str | None = None
    least: float | None = None


OPTIONS = {
    # Files that verbs read
    "whisker": Option(
        "The whisker: a digitised centreline (.csv), or a recording or map that holds it "
        "(.nc). By default that of the recording; where there is none a built-in γ whisker.",
        "FILE",
    ),
    "rat": Option(
        "Radii of the whisker by published regressions: row and column of a rat's whisker, "
        "such as C2, or any, where only its length is known.",
        "NAME",
    ),
    "any_length": Option("A whisker shorter than 0.5 mm or longer than 0.5 m is meant."),
    "map": Option(
        "Map of the whisker; by default it is simulated. Of several whiskers: one for each, in "
        "their order, in `stream` as NAME=FILE.",
        "FILE",
    ),
    "videos": Option(
        "Video of a view of the trial; one for each camera, in their order (top, front).",
        "FILE",
        names="--video",
    ),
    "cameras": Option(
        "Calibrated cameras: TOML of Anipose, or a recording that holds them (.nc).", "FILE"
    ),
    "objects": Option(
        "Known objects: TOML with [[object]] as a trial has, or a recording that holds them.",
        "FILE",
    ),
    "corrections": Option("Corrected traces: CSV of view,frame,whisker,x,y.", "FILE"),
    "head": Option(
        "Pose of the head: CSV of frame (or time), x, y, z and qw, qx, qy, qz (or a matrix, or "
        "azimuth, elevation, roll), or a recording.",
        "FILE",
    ),
    "contact": Option(
        "Contact points tracked otherwise, to compare with: CSV of frame (or time), x, y, z, "
        "m, or of view, frame, x, y in pixels.",
        "FILE",
    ),
    "sensor": Option(
        "Description of the sensor, TOML: the lines then carry its channels, raw; or one of a "
        "suspended whisker by `vibrissa calibrate` (.nc).",
        "FILE",
    ),
    "uniqueness": Option("Result of `vibrissa uniqueness` for the map, NetCDF (.nc).", "FILE"),
    "cones": Option("Critical cones by curvature and taper, NetCDF (.nc).", "FILE"),
    "trial": Option("Recording, or table of signals, of the contacts of interest.", "FILE"),
    "trace": Option("Tracked recording whose traces are shown (.nc).", "FILE"),
    "movie": Option(
        "Movie that the page shows, .mp4; may be repeated. Linked if the page would be larger "
        "than 15 MB.",
        "FILE",
    ),
    # What verbs write
    "force": Option("Replace files that are there already."),
    "csv": Option(
        "Table of the contour points; by default NAME_contour.csv next to the result.", "FILE"
    ),
    "film": Option("Folder for videos of the two views.", "DIR"),
    "bag": Option(
        "New ROS 2 bag for contact points with covariance, forces and candidates: a folder, or a "
        "file that ends in .mcap.",
        "FOLDER",
        names="--bag-out",
    ),
    "answers": Option(
        "Send each answer there too: udp://HOST:PORT or tcp://HOST:PORT.", "ADDRESS", names="--send"
    ),
    "grid": Option("Whether the paper's 237,765 points are solved too."),
    "to": Option("Format of the table: text, Neurodata Without Borders, or MATLAB."),
    "session_start": Option(
        "Date and time with zone at which the session began, for NWB; by default when the "
        "recording was made.",
        "TIME",
    ),
    "subject": Option("Identifier of the animal, for NWB.", "NAME"),
    "species": Option("Species of the animal, for NWB: `Rattus norvegicus`.", "NAME"),
    "all": Option("List every group and variable too."),
    "example": Option("Print a file with all that can be stated, and stop."),
    "format": Option("May be repeated; png and pdf by default."),
    "width": Option("For one column of a journal, 85 mm, or two, 178 mm."),
    "fps": Option("Frames per second at which it is shown."),
    "step": Option(
        "Number of frames of the trial from one that is shown to the next; by default such "
        "that the movie lasts up to 45 s."
    ),
    "start": Option("Time of the first frame, s.", "S", names="--from"),
    "stop": Option("Time of the last frame, s.", "S", names="--until"),
    "kind": Option("What the movies show."),
    "colour": Option("Colour of a trial's contacts in both frames: time by default."),
    "make": Option("Make the movies of the trial first, next to the page.", names="--make-movies"),
    # Signals, and contacts estimated from them
    "source": Option(
        "What signals come from: the contact point that was tracked (the paper's method), the "
        "rod that fits the images, or the sensor; by default the sensor if there is one, or "
        "else the contact point."
    ),
    "cutoff": Option(
        "Cut-off of the low pass on the pose of the whisker's base, Hz; 85 by default, 0: none.",
        "HZ",
    ),
    "using": Option(
        "Signals to use, of Fx, FT, FD, Mx, MB, MD: three, or more for estimates; or `wrench`, "
        "force and moment whole, which allows for friction and needs no map. By default "
        "Fx,MB,MD, of signals of the rod the wrench, and of verdicts each of the 20 triplets.",
        "A,B,C",
    ),
    "method": Option(
        "How contacts are found. As the paper did, of three signals and one contact where "
        "there are several: by look-up in the map's grid, or by a network, trained first."
    ),
    "proximal": Option(
        "Smallest arc length of a contact that is considered, share of the whisker's length; "
        "0.3 by default.",
        "SHARE",
    ),
    "device": Option(
        "Where it is computed: cpu, or cuda, an NVIDIA GPU (extra `gpu`), for a --point or a "
        "--point-force."
    ),
    "force_noise": Option(
        "Standard deviation of a force component, µN; by default as recorded, or 1.",
        "µN",
        least=0.0,
    ),
    "moment_noise": Option(
        "Standard deviation of a moment component, µN·m; by default as recorded, or 0.02.",
        "µN·m",
        least=0.0,
    ),
    "covariance": Option(
        "Instead: covariance of Fx, Fy, Fz, Mx, My, Mz, six lines of six numbers in SI units.",
        "FILE",
    ),
    "stiffness_sigma": Option(
        "Standard deviation of the whisker's bending stiffness, %; the same error in all samples.",
        "%",
        least=0.0,
    ),
    "friction_sigma": Option(
        "Standard deviation of the ratio of the force along the whisker to that across it, such as "
        "0.3 where coefficients of friction are up to 0.5; 0, the default: no friction.",
        least=0.0,
    ),
    "second_contacts": Option(
        "Rate of false alarms, %, such as 1, at which frames are marked not_one_contact because "
        "force and moment whole show a second contact; 0, the default: no test.",
        "%",
        least=0.0,
    ),
    "compliance_sigma": Option(
        "Standard deviation of the compliance of the whisker's base about that of its "
        "--base-stiffness, by default rigid, degrees per µN·m.",
        "DEG",
        least=0.0,
    ),
    "gain_sigma": Option(
        "Standard deviation of the gain of each component of force and moment, %; likewise.",
        "%",
        least=0.0,
    ),
    "mixing_sigma": Option(
        "Standard deviation of the cross-talk among components of force, and of moment, %; "
        "likewise.",
        "%",
        least=0.0,
    ),
    "region": Option(
        "Region of the contacts that are considered: ELD, CF, CB, 'ELD CF' or 'ELD CB'; or, "
        "for estimates, limits of r (mm), theta and phi (degrees), as r=20:35,theta=-30:30. "
        "Verdicts are of all six by default. Of videos: where whiskers are, as a --mask."
    ),
    "least_force": Option("Smallest force of a contact, µN.", "µN", least=0.0),
    "greatest_force": Option("Largest force of a contact, µN.", "µN", least=0.0),
    "threshold": Option(
        "Bending moment from which there is a contact, standard deviations of its noise.", least=0.0
    ),
    "shape": Option("Shape of the object that was touched."),
    "axis": Option("Direction of the axis of a peg or cylinder.", "X,Y,Z"),
    "lean": Option(
        "Standard deviation of the angle between normals and forces, degrees; by default 5.7 "
        "for contacts from --using wrench, which allows for friction, and else 0."
    ),
    # Whiskers and their loads
    "length": Option("Length of a straight whisker, mm, instead.", "MM", least=0.0),
    "base_radius": Option("Radius of the whisker at its base, mm.", "MM"),
    "fur": Option(
        "Length of the whisker's base that fur hides, mm: --base-radius is that of the true base, "
        "and forces are as much smaller as the whisker is thinner where the fur ends.",
        "MM",
        least=0.0,
    ),
    "tip_radius": Option("Radius at the tip, mm; by default 1/15 of the base's.", "MM", least=0.0),
    "modulus": Option("Young's modulus, GPa.", "GPA", least=0.0),
    "poisson": Option("Poisson's ratio.", "RATIO"),
    "density": Option("Density of the whisker, kg/m³, for its weight or inertia.", "KG/M3"),
    "inertia": Option(
        "Remove the whisker's inertia and damping from a sensor's signals; the motion of the base "
        "must be known and smooth. A rat's whisker, known to 20 %, unless stated."
    ),
    "fit_dynamics": Option(
        "Fit density and damping to the frames in which the whisker moves freely and rings."
    ),
    "events": Option("Table of the contacts, .csv: whisker, onset, release and largest force."),
    "damping": Option("Damping ratio of the whisker's first vibration.", "RATIO", least=0.0),
    "gravity": Option(
        "Gravity minus the acceleration of the base, m/s², in the whisker's frame, or where poses "
        "of the base are known the laboratory's; 0,0,-9.81 is a level whisker. By default the "
        "whisker has no weight.",
        "X,Y,Z",
    ),
    "tare_gravity": Option(
        "Gravity, likewise, when the sensor was tared with the whisker at rest; by default as it "
        "is now. 0,0,0: the sensor reads the weight.",
        "X,Y,Z",
    ),
    "gravity_sigma": Option(
        "Standard deviation of gravity's direction about each axis, degrees.", "DEG", least=0.0
    ),
    "density_sigma": Option("Standard deviation of the whisker's density, %.", "%", least=0.0),
    "base_stiffness": Option(
        "Stiffness of the base in bending and in twist, µN·m/rad; by default it is rigid.",
        "BENDING,TWIST",
    ),
    "point": Option("Contact point, mm.", "X,Y,Z"),
    "point_force": Option(
        "Arc length of a force, mm, its size, µN, and its angle from d1 to d2, degrees.",
        "S,F,ANGLE",
    ),
    "peg": Option("A point of a peg's axis and its diameter, mm; 0 for a line.", "X,Y,Z,D"),
    "push": Option(
        "Approximate direction in which the peg pushes; by default from its nearest side.", "X,Y,Z"
    ),
    # Trials that are simulated
    "array": Option(
        "All whiskers of a face: `average` for an average rat's, or a file or folder.",
        "FILE|average",
    ),
    "side": Option("Side of the array; both by default."),
    "names": Option("Names of whiskers of the array: `C1,C2,gamma`.", "NAMES"),
    "object": Option("Kind of an object that is put within reach."),
    "duration": Option("Duration of the trial, s.", "S"),
    "rate": Option("Frames per second of the trial; 1000 by default.", "HZ"),
    "frequency": Option("Whisks per second; 5 by default.", "HZ"),
    "protraction": Option("Share of a whisk that is protraction, 0.3 to 0.7.", "SHARE"),
    "row": Option(
        "Row of the one whisker, which determines how elevation and roll depend on the "
        "azimuth; C by default."
    ),
    "friction": Option("Coefficient of Coulomb friction; 0 by default."),
    "dynamic": Option("With inertia and damping: takes half a minute a second or so."),
    "noise": Option("Whether the simulated sensor has noise, by default 1 µN and 0.02 µN·m."),
    "seed": Option("Seed of random numbers; 0 by default.", least=0),
    "full": Option("3.5 s of video, as in the paper, or half a second.", names="--full/--quick"),
    "tracking": Option("Whether the trial is filmed and tracked, or the true pose is taken."),
    # Videos that are tracked, and cameras
    "pixel_size": Option(
        "Size of a pixel of the views in space, mm, without --cameras; 0.058 by default.", "MM"
    ),
    "distance": Option(
        "Approximate distance of the cameras' lenses from the whisker, m, without --cameras, or "
        "inf for telecentric ones; by default they are far, but it is not known how far. What the "
        "views show of the free whisker corrects it.",
        "M",
    ),
    "views": Option(
        "Parts of the images of one video that show the views, as where a mirror is in the image: "
        "COLUMN,ROW,WIDTH,HEIGHT of each, one after the other; :mirrored after it exchanges left "
        "and right, :flipped up and down.",
        "X,Y,W,H[:mirrored]...",
    ),
    "unit": Option("Unit of points in space, where the file does not state it."),
    "point_sigma": Option(
        "Standard deviation of a tracked point across the whisker: pixels, by default 0.5; mm of "
        "points in space, by default a thousandth of the whisker's length."
    ),
    "offset": Option("Frames by which the second camera began earlier, or auto."),
    "base": Option(
        "Column and row where a whisker leaves the face in the first frame, view by view and "
        "then whisker by whisker; by default the whisker is traced that all views show: "
        "start.png, next to the recording, shows which.",
        "X,Y",
    ),
    "clicks": Option(
        "Bases, masks and scale as --pick saves them, TOML; by default NAME.clicks.toml next to "
        "the recording, if it is there and of the same videos.",
        "FILE",
    ),
    "pick": Option(
        "Open a window first to click bases, mask a peg or the face, and draw the scale; saved for "
        "--clicks, by default as NAME.clicks.toml next to the recording."
    ),
    "mask": Option(
        "Area of a view, counted from 0, in which no whisker is measured, such as a peg or a clip: "
        "corners of a polygon, '1:300,0 330,0 330,479 300,479', or an image of the view's size "
        "that is bright there, 1:mask.png. May be repeated.",
        "VIEW:AREA",
    ),
    "base_width": Option("Width of the whisker's base in the images, pixels, at least 3."),
    "jump": Option(
        "Largest distance of a whisker from where the frames before predict it, pixels; what "
        "is farther away is another whisker."
    ),
    "bright": Option(
        "Whether whiskers are bright on dark; by default the first frame decides.",
        names="--bright/--dark",
    ),
    "which": Option(
        "Number of the whisker in the recording, from 0; by default that most in contact.",
        least=0,
    ),
    "view": Option("Number of the view in the video, from 0."),
    "pattern": Option("Inner corners of the board, along its longer side first: 9x6.", "NxM"),
    "square": Option("Side of a square, mm.", "MM"),
    "frames": Option("Frames that are used of a video, evenly spread; 40 by default."),
    # Verdicts
    "domain": Option("All contacts, or those within the paper's grid."),
    "cone": Option("Contacts within this angle about rest are left out, degrees.", least=0.0),
    "min_separation": Option(
        "Distance within which two contacts count as one, share of the whisker's length."
    ),
    "samples": Option("Number of contacts that are tried.", least=16),
    "resolution": Option("Whether to find how finely signals must be measured."),
    "network": Option("Also train a network for each triplet, as the paper did; slow."),
    "certify": Option(
        "Also prove that (Fx, MB, MD) is unique: the certificate that is made here, .nc; one of "
        "this whisker that is there already is continued."
    ),
    "minutes": Option("Longest time that a certificate may take, minutes.", least=0.0),
    # Streams
    "udp": Option("Receive lines as UDP datagrams here instead.", "HOST:PORT"),
    "every": Option(
        "Answer every sample that comes by UDP, however late; by default the newest, and those "
        "before it that wait are dropped and counted."
    ),
    "reconnect": Option("Wait for a named pipe or serial device that closes to open again."),
    "topic": Option("Topic of WrenchStamped in a bag, where there are several.", "NAME"),
    "pose_topic": Option(
        "Topic of PoseStamped or TransformStamped in a bag: poses of the base, or of the flange.",
        "NAME",
    ),
    "count": Option("Number of lines after which to stop.", "N", least=1),
    "tare": Option(
        "Number of first samples, of a free whisker, that give the sensor's offset anew.",
        "N",
        least=1,
    ),
    "filter": Option(
        "Follow contacts over time, with the pose of the base: base_x, base_y, base_z (m) and "
        "base_qw, base_qx, base_qy, base_qz, in each line or in lines of their own."
    ),
    "speed": Option(
        "Speed of contacts in the laboratory, for the filter, mm/s; by default a quarter of "
        "the whisker's length a second.",
        "MM/S",
    ),
    "slip_speed": Option(
        "Speed of contacts in the laboratory from which they slip, mm/s; by default two lengths of "
        "the whisker a second.",
        "MM/S",
    ),
    "mount": Option(
        "Position of the whisker's base on a robot's flange, whose poses come: mm, and a "
        "quaternion from the whisker's to the flange's frame.",
        "X,Y,Z,QW,QX,QY,QZ",
    ),
    # Studies, and pages that are served
    "workers": Option("Processes on this machine, 1 by default; 0: none but this one.", least=0),
    "scheduler": Option(
        "Address of a Dask scheduler instead, or `local` for a cluster of `--workers` processes.",
        "ADDRESS",
    ),
    "again": Option("Try again what failed before."),
    "any_version": Option("Go on though another version of vibrissa began."),
    "dry_run": Option("Print number of cells, time and size, and stop."),
    "live": Option(
        "Draw the answers that `vibrissa stream --send udp://HOST:PORT` sends here.",
        "HOST:PORT",
        names="--stream",
    ),
    "host": Option("Address to listen on; 0.0.0.0 lets other machines in.", "HOST"),
    "port": Option("Port to listen on; by default the first free one from 8080."),
    "browser": Option("Whether the browser is opened."),
}
"""The options by the names of parameters."""

RecordingArgument = Annotated[
    Path, typer.Argument(help="A recording, NetCDF (.nc).", metavar="TRIAL.nc")
]
MapArgument = Annotated[
    Path, typer.Argument(help="A map, as `vibrissa map` writes it, NetCDF (.nc).", metavar="MAP.nc")
]
Source = Literal["contact-point", "rod", "sensor"]
Method = Literal["exact", "lookup", "lookup-linear", "network"]


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


Verb = TypeVar("Verb", bound=Callable[..., None])


def with_options(output: str = "") -> Callable[[Verb], Verb]:
    """Make parameters of a verb options, also those that are fields of its data classes.

    ``output`` describes what the verb writes to its parameter ``target``.
    """

    def decorated(verb: Verb) -> Verb:
        hints = get_type_hints(verb, include_extras=True)
        given = inspect.signature(verb).parameters.values()
        flat = _flat({one.name: (hints[one.name], one.default) for one in given}, output)

        @wraps(verb)
        def called(**values: Any) -> None:
            verb(**_filled({one.name: hints[one.name] for one in given}, values))

        called.__annotations__ = {one.name: one.annotation for one in flat}
        called.__signature__ = inspect.Signature(flat)  # type: ignore[attr-defined]
        return cast(Verb, called)

    return decorated


def _flat(kinds: Mapping[str, tuple[Any, Any]], output: str) -> list[inspect.Parameter]:
    """Options, with the fields of data classes in their place."""
    found = []
    for name, (kind, default) in kinds.items():
        if is_dataclass(kind):
            hints = get_type_hints(kind, include_extras=True)
            inside = {one.name: (hints[one.name], one.default) for one in fields(kind)}
            found += _flat(inside, output)
            continue
        default = inspect.Parameter.empty if default is MISSING else default
        annotation = kind
        if get_origin(kind) is not Annotated:  # else it is an argument
            annotation = Annotated[kind, _declared(name, default, output)]
        # Options are passed by name, so that those without a default may follow others.
        how = inspect.Parameter.KEYWORD_ONLY
        found.append(inspect.Parameter(name, how, default=default, annotation=annotation))
    return found


def _declared(name: str, default: Any, output: str) -> Any:
    """Declare an option to Typer."""
    if name == "target":
        text = f"Where the result goes: {output}."
        return typer.Option("--output", "-o", help=text, metavar="PATH")
    about = OPTIONS[name.rstrip("_")]
    names = f"--{name.rstrip('_').replace('_', '-')}"
    if default is True:
        names += names.replace("--", "/--no-", 1)
    return typer.Option(
        about.names or names, help=about.help, metavar=about.metavar, min=about.least
    )


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


def check_new(path: Path, endings: Sequence[str], force: bool) -> None:
    """Raise if a file cannot be written, or is there and not to be replaced."""
    vb.io.check_writable(path, endings)
    free([path], force)


def refuse(options: Mapping[str, object], reason: str) -> None:
    """Raise if options are given that would have no effect."""
    given = [name for name, value in options.items() if not _nothing(value)]
    if given:
        raise ValueError(f"{', '.join(given)} cannot be used: {reason}")


def _nothing(value: object) -> bool:
    # Zero is a number that was given.
    return value is None or value is False or value in ([], ())

"""`vibrissa estimate`: estimation of contact points from signals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import vibrissa as vb
from vibrissa.cli import inputs
from vibrissa.cli.options import Method, free, numbers, refuse, spare, with_options
from vibrissa.cli.signals import SourceOptions, described
from vibrissa.cli.terminal import Tell, progress_bars, remark, remark_once, shown
from vibrissa.deferred import xr
from vibrissa.numerics import Array

WRENCH = "wrench"
_XYZ = ("X", "Y", "Z")
# Sag of the tip of a level whisker, m, above which neglecting it is mentioned: contact points are
# wrong by several times as much. A rat's whisker sags by 0.2 mm.
_SAG = 0.5e-3
_WEAK = 1.5  # gravity, m/s², below which it is stated in another unit, or is not that of the earth


@dataclass(frozen=True)
class GravityOptions:
    """Options for gravity and its uncertainty."""

    gravity: str | None = None
    tare_gravity: str | None = None
    gravity_sigma: float | None = None
    density: float | None = None
    density_sigma: float | None = None

    def __post_init__(self) -> None:
        if self.gravity is None:
            about = {
                "--tare-gravity": self.tare_gravity,
                "--gravity-sigma": self.gravity_sigma,
                "--density": self.density,
                "--density-sigma": self.density_sigma,
            }
            refuse(about, "without --gravity the whisker has no weight")

    @property
    def known(self) -> vb.Gravity | None:
        """Gravity; None to neglect the weight of the whisker."""
        if self.gravity is None:
            return None
        x, y, z = numbers(self.gravity, _XYZ, "--gravity")
        if 0.0 < math.hypot(x, y, z) < _WEAK:
            remark(f"note: gravity is {math.hypot(x, y, z):g} m/s²; on earth it is 9.81")
        tare: Any = self.tare_gravity
        if tare is not None:
            tare = tuple(numbers(tare, _XYZ, "--tare-gravity"))
        return vb.Gravity(
            (x, y, z),
            tare,
            math.radians(self.gravity_sigma or 0.0),
            0.01 * (self.density_sigma or 0.0),
        )

    def check(self, how: EstimateOptions) -> None:
        """Raise ValueError if gravity is incompatible with the options of the estimate."""
        if how.method != "exact":
            refuse({"--gravity": self.gravity}, f"--method {how.method} neglects weight")
        if how.map:
            refuse({"--density": self.density}, "the map has that of its whisker")

    def of(self, whisker: vb.Whisker) -> vb.Whisker:
        """Whisker with the stated density."""
        return whisker if self.density is None else whisker.with_properties(density=self.density)

    def doubts(self, whisker: vb.Whisker) -> Iterator[str]:
        """Yield that the weight is neglected of a whisker that sags under it noticeably."""
        if self.gravity is not None or whisker.density is None:
            return
        try:
            below = vb.resting(whisker, vb.sensors.GRAVITY).shape().position(whisker.length)
        except ValueError:
            sag = whisker.length  # it topples
        else:
            sag = math.dist(below, whisker.position(whisker.length))
        if sag > _SAG:
            yield (
                "the weight of the whisker is neglected; if it were level, its tip would "
                f"sag by {1e3 * sag:.2g} mm. If its base is tilted or accelerated after the sensor "
                "was tared, contacts are wrong without --gravity"
            )

    def described(self) -> str:
        """Description of gravity for the end of a sentence; empty without gravity."""
        return "" if self.gravity is None else f"; bent by gravity of {self.gravity} m/s²"


@dataclass(frozen=True)
class AroundOptions:
    """Options for contacts with known objects, and the uncertainty of their position."""

    around: Path | None = None
    position_sigma: float | None = None

    def __post_init__(self) -> None:
        if (self.around is None) != (self.position_sigma is None):
            raise ValueError(
                "--around and --position-sigma belong together: the position of objects is known "
                "up to a shift (mm, one sigma, along each axis)"
            )

    def check(self, how: EstimateOptions, weight: GravityOptions) -> None:
        """Raise ValueError for options that are incompatible with known objects."""
        others = {
            "--map": how.map,
            "--using": how.using,
            "--method": None if how.method == "exact" else how.method,
            "--proximal": how.proximal,
            "--friction-sigma": how.friction_sigma or None,
            "--second-contacts": how.second_contacts or None,
            "--compliance-sigma": how.compliance_sigma or None,
            "--gravity": weight.gravity,
        }
        others |= {f"--{name.replace('_', '-')}": v for name, v in how.assumed.errors.items()}
        refuse(others, "--around takes a --whisker and its wrench, without friction or weight")
        if how.assumed.prior is not None:
            raise ValueError("--around takes no other prior than its objects")


_SHOWN = 5  # largest number of faults of a table that are reported
_ONSET = ("onset_time", "onset_sigma")
_NUMBERS = ("time", "x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True, kw_only=True)
class EstimateOptions:
    """Options for the signals and the method of the estimate."""

    map: list[Path] | None = None
    using: str | None = None
    method: Method = "exact"
    proximal: float | None = None
    friction_sigma: float = 0.0
    second_contacts: float = 0.0
    compliance_sigma: float = 0.0
    noise: inputs.NoiseOptions
    assumed: inputs.AssumptionOptions
    own: inputs.WhiskerOptions

    def __post_init__(self) -> None:
        names = self.names or vb.signals.TRIPLET
        if self.whole and self.method != "exact":
            raise ValueError(f"--using wrench has no --method {self.method}")
        if self.method != "exact" and len(names) != 3:
            raise ValueError(
                f"--method {self.method} needs three signals; got {len(names)}: {', '.join(names)}"
            )
        rubbing = {"--friction-sigma": self.friction_sigma or None}
        if self.whole:
            refuse(rubbing, "--using wrench estimates the friction")
        if self.method != "exact":
            refuse(rubbing, f"--method {self.method} assumes that there is no friction")
        if self.map and self.own.whisker is not None:
            raise ValueError("give either --map or --whisker: a map already has its whisker")
        if self.whole:
            refuse({"--proximal": self.proximal}, "--using wrench needs no map")
        if self.map:
            refuse({"--proximal": self.proximal}, "the --map has a proximal limit")
        _ = self.assumed.prior

    @property
    def whole(self) -> bool:
        """Whether the full force and moment are used."""
        return self.using == WRENCH

    @property
    def names(self) -> tuple[str, ...] | None:
        """Stated signals; None if there are none, or for the full wrench."""
        return None if self.using is None or self.whole else vb.signals.selection(self.using)

    @property
    def grid(self) -> bool:
        """Whether contacts are looked up in the paper's grid."""
        return self.method.startswith("lookup")

    @property
    def special(self) -> bool:
        """Whether options are used that a stream does not support."""
        beyond = (self.friction_sigma, self.second_contacts, self.compliance_sigma)
        return self.method != "exact" or any(beyond)

    @property
    def given(self) -> bool:
        """Whether any option is stated, so that contacts must be estimated again."""
        stated = (self.map, self.using, self.own.whisker, self.noise.given, self.special)
        return any(map(bool, (*stated, self.proximal is not None, self.assumed.described())))

    @property
    def known(self) -> inputs.WhiskerOptions:
        """Options of the stated whisker, which may be that of a map."""
        one = self.map is not None and len(self.map) == 1
        return inputs.WhiskerOptions(self.map[0]) if self.map and one else self.own

    def keywords(self) -> dict[str, Any]:
        """Keyword arguments shared by all estimates."""
        errors = dict(self.assumed.errors)
        if self.compliance_sigma:
            errors["compliance_sigma"] = math.radians(self.compliance_sigma) * 1e6
        return {
            "method": self.method,
            "errors": errors,
            "prior": self.assumed.prior,
            "friction": self.friction_sigma,
            "second_contacts": 0.01 * self.second_contacts,
        }

    def described(self, names: str, friction: float, noise: str, least: float) -> str:
        """Description of the signals, and of the assumptions of the estimate."""
        by = "" if self.method == "exact" else f" by {self.method}"
        used = f"signals ({', '.join(names.split())}){by}"
        if self.compliance_sigma:
            noise += f"; compliance of the base known to {self.compliance_sigma:g} °/(µN·m)"
        if self.second_contacts:
            noise += f"; second contacts at {self.second_contacts:g} % false alarms"
        return (
            f"{'force and moment whole' if names == WRENCH else used}{self.assumed.described()}; "
            f"{vb.contacts.friction_assumed(friction)}; "
            f"{noise}; a contact is detected where M_B exceeds {shown('MB', least)}"
        )


@with_options(
    "the recording with the contacts added, .nc, by default where it is; or the contacts as a "
    "table, .csv, by default contacts.csv"
)
def estimate(
    signals: Path,
    how: EstimateOptions,
    weight: GravityOptions,
    known: AroundOptions,
    sensor: Path | None = None,
    target: Path | None = None,
    force: bool = False,
) -> None:
    """Estimate the contact point in each frame or row of signals, with its uncertainty.

    Three signals give all contacts that explain them exactly; more signals are fitted by least
    squares. --using wrench allows for friction. If M_B is within five standard deviations of zero,
    the status is not_felt.

    The results for a table are written to a table, and the candidates of rows that have several to
    a second one, NAME_candidates.csv. For a recording they are added as the group
    `estimates`, also in the laboratory frame, where continuity selects among several contacts;
    missing signals are computed first (see `vibrissa signals`), and a contour of earlier contacts
    is removed.

    With a --sensor (.toml) the columns of a table are the sensor's channels and poses of the base,
    as in lines of `vibrissa stream`. With a --sensor of `vibrissa calibrate` (.nc) the table is a
    sweep, with positions of the stage and the channels; its results may be written to a recording
    (.nc), from which `vibrissa reconstruct` reconstructs the object.

    With --gravity a whisker of known density sags; gravity is in the laboratory frame if poses of
    the base are known, as in a recording. With --around contacts with known objects are estimated,
    also along an arc, and written to a table.

    Example: `vibrissa estimate signals.csv --map map.nc --using Fx,FT,MB,MD -o contacts.csv`
    """
    if how.noise.covariance is not None:
        how.noise.matrix()
    recorded = inputs.kind_in(vb.io.check_readable(signals)) == inputs.RECORDING
    added = recorded and known.around is None
    target = target or (signals if added else Path("contacts.csv"))
    swept = sensor is not None and vb.io.is_netcdf(sensor)
    both = (*vb.io.NETCDF, *vb.io.CSV)
    vb.io.check_writable(target, both if added or swept else vb.io.CSV)
    # Candidates belong to the contacts of the table of the same name.
    several = not (recorded or swept or known.around is not None)
    stale = target.suffix.lower() in vb.io.CSV and target.exists()
    if added:
        inputs.free_beside(signals, [target], force)
    else:
        written = [target, _candidates_beside(target)] if several or stale else [target]
        for path in written:
            spare(path, signals)
        free(written, force)
    if known.around is not None:
        known.check(how, weight)
        if sensor is not None:
            raise ValueError("--around takes force and moment, not the channels of a --sensor")
        _around(signals, target, how, known)
    elif sensor is not None and not swept:
        if recorded:
            raise ValueError(
                f"{sensor} is for tables of its channels, and {signals} is a recording"
            )
        if how.using or how.noise.given or how.special:
            raise ValueError(
                f"{sensor} states channels and noise: omit --using, --method and options of noise"
            )
        _from_lines(signals, target, how, weight, vb.sensors.load_sensor(sensor))
    elif sensor is not None:
        if recorded or how.given or weight.gravity is not None:
            raise ValueError(
                f"{sensor} is a suspended whisker, with its noise, for tables of its readings: "
                "omit other options, and recordings"
            )
        _from_sweep(signals, target, sensor)
    elif recorded:
        _from_recording(signals, target, how, weight)
    elif _named_signals(signals, how):
        _from_lines(signals, target, how, weight, None)
    else:
        _from_table(signals, target, how, weight)
    if stale and not several:
        _candidates_beside(target).unlink(missing_ok=True)


def _named_signals(table: Path, how: EstimateOptions) -> bool:
    """Whether a table has the signals themselves rather than force and moment."""
    if how.whole or how.special:
        return False
    names = how.names or vb.signals.TRIPLET
    _, cells = next(vb.io.table_rows(vb.io.read_text(table)), (0, []))
    first = ",".join(cells)
    if not first or _is_header(first, vb.streaming.COMPONENTS):
        return False
    if _is_header(first, names):
        return True
    known = [name for name in vb.signals.SIGNALS if _is_header(first, (name,))]
    if len(known) >= 3:
        raise ValueError(
            f"{table} has the signals {', '.join(known)}, but {', '.join(names)} are requested: "
            f"use --using {','.join(known)}"
        )
    return False


def _is_header(line: str, names: tuple[str, ...]) -> bool:
    """Whether a line is a header with columns of these names."""
    try:
        return vb.streaming.Lines(names)(line) is None
    except ValueError:
        return False


def _from_lines(
    signals: Path,
    target: Path,
    how: EstimateOptions,
    weight: GravityOptions,
    sensor: vb.sensors.Sensor | None,
) -> None:
    """Estimate contacts for a table whose lines are those of a stream."""
    weight.check(how)
    with progress_bars() as tell:
        if how.map:
            contact_map = inputs.maps_from(how.map, 1, False)[0]
        else:
            known = weight.of(how.own.read())
            remark(f"no map given; simulating that of {known!r}")
            contact_map = inputs.map_of(
                known, tell, grid=False, proximal=inputs.smallest_arc(how.proximal)
            )
        names = None if sensor is None else tuple(sensor.channels)
        inputs.print_notes(contact_map.whisker)
        remark_once(weight.doubts(contact_map.whisker))
        used = names or how.names or vb.signals.TRIPLET
        if sensor is None:
            _doubt_names(contact_map, used)
        estimator = inputs.estimator_of(
            contact_map, sensor, used, how.noise, how.assumed, weight.known, vb.signals.DETECTED
        )
        rows = itertools.count()
        running = vb.streaming.ContactStream(estimator, names, clock=lambda: float(next(rows)))
        records = list(running.records(vb.io.read_text(signals).splitlines()))
    faults = [f"line {one['line']}: {one['error']}" for one in records if "error" in one]
    if len(faults) == len(records) > 1:  # the rows follow from the header
        del faults[1:]
    if faults or not records:
        raise ValueError(f"{signals}: {'; '.join(faults[:_SHOWN]) or 'there are no samples'}")
    columns = {name: [one.get(name, float("nan")) for one in records] for name in _NUMBERS}
    if running.untimed:
        columns["time"] = [float(row) for row in range(len(records))]
        remark(f"{signals}: {vb.io.NUMBERED}")
    else:
        for note in vb.io.time_notes(np.array(columns["time"])):
            remark(f"{signals}: {note}")
    statuses = [int(vb.Status[one["status"].upper()]) for one in records]
    columns["friction"] = [estimator.friction] * len(records)
    happened = [vb.status.Event[one.get("event", "none").upper()] for one in records]
    begun = [[one.get(name, float("nan")) for name in _ONSET] for one in records]
    events, onsets = vb.contacts.in_order(np.array(columns["time"]), happened, begun)
    begun_at = dict(zip(_ONSET, onsets.T, strict=True))
    vb.io.save_contacts(target, {**columns, **begun_at, "event": events, "status": statuses})
    _write_candidates(target, columns["time"], [one.get("candidates", []) for one in records])
    for sentence in vb.streaming.advice(running):
        remark(sentence)
    friction = vb.contacts.friction_assumed(estimator.friction)
    noise = f"; {how.noise.described()}" if sensor is None else ""
    about = f"{how.assumed.described()}; {friction}{noise}{weight.described()}"
    remark(f"signals ({', '.join(used)}){about}")
    inputs.print_statuses(np.array(statuses))
    inputs.print_written(target)


def _from_table(signals: Path, target: Path, how: EstimateOptions, weight: GravityOptions) -> None:
    """Estimate contacts for a table of signals, whisker frame."""
    weight.check(how)
    noise = how.noise.matrix()
    frames = inputs.frames_from(signals)
    wrench = (frames["force"], frames["moment"])
    for note in frames.attrs["notes"]:
        remark(f"{signals}: {note}")
    maps = inputs.maps_from(how.map, 1, how.grid) if how.map else []
    known = maps[0].whisker if maps else weight.of(how.own.read())
    gravity = weight.known
    inputs.print_notes(known)
    with vb.io.in_file(signals):
        vb.io.check_scale(*wrench, known)
    how.noise.doubt(known)
    remark_once(_doubts(known, wrench, noise, weight))
    with progress_bars() as tell:
        if not maps and not how.whole:
            remark(f"no map given; simulating that of {known!r}")
            maps = [
                inputs.map_of(
                    known, tell, grid=how.grid, proximal=inputs.smallest_arc(how.proximal)
                )
            ]
        tell("contact points", 0, 1)
        if how.whole:
            named = how.keywords()
            others = {n: named[n] for n in ("errors", "prior", "second_contacts")}
            found = vb.pipeline.locate_from_wrench(known, frames, noise, gravity=gravity, **others)
        else:
            names, others = how.names or vb.signals.TRIPLET, how.keywords()
            _doubt_names(maps[0], names)
            found = vb.pipeline.locate(
                maps[0], frames, names, noise=noise, gravity=gravity, **others
            )
        tell("contact points", 1, 1)
    _doubt_zero(wrench, noise, found, weight)
    vb.io.save_contacts(target, vb.pipeline.contact_columns(found))
    points = np.asarray(found["candidate_points"])
    several = [one[np.isfinite(one).all(axis=1)].tolist() for one in points]
    _write_candidates(target, np.asarray(found["time"]).tolist(), several)
    used = WRENCH if how.whole else found.attrs["triplet"]
    about = how.noise.described() + weight.described()
    remark(how.described(used, found.attrs["friction"], about, found.attrs["felt_above"]))
    inputs.print_statuses(found["status"])
    inputs.print_written(target)


def _candidates_beside(target: Path) -> Path:
    """Path of the table of candidates next to that of the contacts."""
    return target.with_name(f"{target.stem}_candidates.csv")


def _write_candidates(target: Path, times: list[float], points: list[list[list[float]]]) -> None:
    """Write the candidates of samples that have several, if there are any; whisker frame."""
    rows = [
        [time, number, *point]
        for time, several in zip(times, points, strict=True)
        for number, point in enumerate(several)
        if len(several) > 1
    ]
    path = _candidates_beside(target)
    if rows:
        vb.io.write_table(path, ["time", "candidate", "x", "y", "z"], rows)
        inputs.print_written(path)
    else:
        path.unlink(missing_ok=True)  # that of former contacts, which are replaced


# Signals proposed if the requested ones do not determine contacts, fewest first.
_INSTEAD = (("FT", "MB", "MD"), ("Fx", "FT", "MB", "MD"))


def _doubt_names(contact_map: vb.ContactMap, names: tuple[str, ...]) -> None:
    """Propose other signals if the requested ones do not determine contacts."""
    if contact_map.determines(names):
        return
    better = next((one for one in _INSTEAD if contact_map.determines(one)), None)
    instead = "wrench" if better is None else ",".join(better)
    remark(
        f"({', '.join(names)}) do not determine contacts of this whisker, as (Fx, MB, MD) of a "
        f"straight cylinder: --using {instead}"
    )


def _around(signals: Path, target: Path, how: EstimateOptions, known: AroundOptions) -> None:
    """Estimate contacts with known objects, at several points or along an arc, for a table."""
    assert known.around is not None
    assert known.position_sigma is not None
    objects, noise = inputs.objects_from(known.around), how.noise.matrix()
    about = how.noise.described()
    if inputs.kind_in(signals) == inputs.RECORDING:
        tree = inputs.recording_from(signals)
        inputs.check_one_whisker(tree, signals)
        tree = _with_signals(tree, how)
        wrench, whisker = (
            tree["signals"].to_dataset().isel(whisker=0),
            how.own.in_recording(tree)[0],
        )
        stated = vb.pipeline.sensor_noise(wrench)
        if stated is not None and not how.noise.given:
            noise, about = stated, "noise as the recording states"
        if wrench.attrs.get("source") == "sensor" and "density" not in wrench.attrs:
            wrench = wrench.drop_vars("in_contact")
    else:
        wrench, whisker = inputs.wrench_from(signals), how.own.read()
        how.noise.doubt(whisker)
    inputs.print_notes(whisker)
    with vb.io.in_file(signals):
        vb.io.check_scale(wrench["force"].values, wrench["moment"].values, whisker)
    with progress_bars() as tell:
        found = vb.pipeline.locate_around(
            whisker,
            wrench,
            noise,
            objects,
            1e-3 * known.position_sigma,
            lambda done, total: tell("contact points", done, total),
        )
        tell("contact points", 1, 1)
    vb.io.save_contacts(target, vb.pipeline.contact_columns(found))
    remark(
        f"force and moment whole, around {', '.join(map(repr, objects))}, whose position is known "
        f"to {known.position_sigma:g} mm; no friction assumed; {about}; contacts are measured "
        f"where M_B exceeds {shown('MB', found.attrs['felt_above'])}"
    )
    inputs.print_statuses(found["status"].values)
    inputs.print_written(target)


def _doubts(
    whisker: vb.Whisker, wrench: tuple[Array, Array], noise: Array | None, weight: GravityOptions
) -> Iterator[str]:
    """Yield that the weight is neglected, or that the axes of a sensor with this noise seem wrong.

    Axes are not questioned with gravity, whose effects are similar.
    """
    yield from weight.doubts(whisker)
    if noise is None or weight.gravity is not None:
        return
    if doubt := vb.pipeline.doubted_axes(whisker, *wrench, noise):
        yield doubt


def _doubt_zero(
    wrench: tuple[Array, Array], noise: Array, found: vb.pipeline.Frames, weight: GravityOptions
) -> None:
    """Warn of signals that are not zero without contact, or scatter unlike their noise.

    Gravity changes them too, and is not warned of.
    """
    sigma = np.sqrt(np.diag(noise))
    free = np.asarray(found["status"] == vb.Status.NOT_FELT)
    readings = np.concatenate(wrench, axis=1)
    if doubt := vb.pipeline.doubted_noise(readings, noise, free):
        remark(f"note: {doubt}")
    if weight.gravity is not None or not sigma.all():
        return
    known = np.isfinite(readings).any(axis=0)
    zero = vb.streaming.Zero()
    for reading in (readings / sigma)[free][:, known]:
        zero.put(reading)
    if zero.off:
        remark(f"note: {vb.streaming.OFF_ZERO}")


def _from_sweep(table: Path, target: Path, path: Path) -> None:
    """Estimate contacts of a sweep with a suspended whisker, laboratory frame."""
    sensor, stage = vb.sensors.load_suspended(path)
    sweep = stage.sweep(table)
    found = vb.sensors.follow_sweep(sensor, *sweep)
    remark(
        f"{found.in_contact.sum()} of {len(found.points)} samples are in contact; m, laboratory "
        "frame"
    )
    if not found.in_contact.any():
        change = np.abs(sweep.readings - sweep.readings[0]).max(axis=0) / sensor.uncertainty
        remark(
            f"note: readings change by at most {change.max():.2g} times their uncertainty: are "
            "they in the units of the calibration, and the first sample free of contact?"
        )
    if target.suffix.lower() in vb.io.NETCDF:
        vb.io.save_recording(target, vb.pipeline.swept_recording(sensor, sweep, found))
        inputs.print_written(target)
        return
    sigma = found.covariance.diagonal(axis1=1, axis2=2) ** 0.5
    header = [a + b for a in ("", "normal_", "sigma_") for b in "xyz"]
    columns = (found.points, found.normal, sigma)
    names = ["sample", *header, "arc_length", "in_contact"]
    rows = [
        [i, *(v for part in columns for v in part[i].tolist()), float(found.arc_length[i]), int(on)]
        for i, on in enumerate(found.in_contact)
    ]
    vb.io.write_table(target, names, rows)
    inputs.print_written(target)


def _from_recording(
    signals: Path, target: Path, how: EstimateOptions, weight: GravityOptions
) -> None:
    """Estimate contacts for a recording, and add them to it or write a table."""
    tree = inputs.recording_from(signals)
    table = target.suffix.lower() in vb.io.CSV
    if table:
        inputs.check_one_whisker(tree, signals)
    with progress_bars() as tell:
        done, used = estimated(_with_signals(tree, how), how, tell, str(signals), weight)
    remark(f"{described(done)}; {used}")
    found = done["estimates"].to_dataset()
    inputs.print_statuses(found["status"].values)
    if table:
        vb.io.save_contacts(target, vb.pipeline.contact_columns(found.isel(whisker=0)))
    else:
        vb.io.save_recording(target, done)
    inputs.print_written(target, signals, "estimates")


def _with_signals(tree: xr.DataTree, how: EstimateOptions) -> xr.DataTree:
    """Add signals to a recording if they are due."""
    if "signals" not in vb.pipeline.due_stages(tree, "estimates"):
        return tree
    keywords = SourceOptions.of(tree).as_keywords(tree, how.known, how.proximal)
    return vb.pipeline.with_signals(tree, **keywords)


def estimated(
    tree: xr.DataTree,
    how: EstimateOptions,
    tell: Tell,
    name: str,
    weight: GravityOptions | None = None,
) -> tuple[xr.DataTree, str]:
    """Add contacts to a recording with signals; also return a description of the method."""
    signals = tree["signals"].to_dataset()
    source = signals.attrs.get("source")
    # A sensor without stated noise is assumed to have the default noise.
    noisy = how.noise.given or (source == "sensor" and vb.pipeline.sensor_noise(signals) is None)
    maps = inputs.maps_from(how.map, tree.sizes["whisker"], how.grid) if how.map else []
    weight = weight or GravityOptions()
    weight.check(how)
    whiskers = [one.whisker for one in maps] if maps else how.own.in_recording(tree)
    whiskers = [weight.of(one) for one in whiskers]
    inputs.print_notes(*whiskers)
    doubts: list[str] = []
    readings = []
    for k, whisker in enumerate(whiskers):
        with vb.io.in_file(name):
            one = vb.recording.Group(signals).whisker(k)
            wrench = (one["force"], one["moment"])
            vb.io.check_scale(*wrench, whisker)
        readings.append(np.concatenate(wrench, axis=1))
        sensed = how.noise.matrix() if source == "sensor" else None
        doubts += _doubts(whisker, wrench, sensed, weight)
    remark_once(doubts)
    by_default = how.using is None and how.method == "exact" and not how.friction_sigma
    whole = how.whole or (by_default and source == "rod")
    if not maps and not whole:
        single = f"no map given; simulating that of {whiskers[0]!r}"
        several = "no maps given; simulating those of the whiskers that have a contact"
        remark(single if len(whiskers) == 1 else several)
    done = vb.pipeline.with_estimates(
        tree,
        WRENCH if whole else how.names,
        noise=how.noise.matrix() if noisy else None,
        proximal=inputs.smallest_arc(how.proximal),
        progress=tell,
        gravity=weight.known,
        **how.keywords(),
        **({"contact_maps": maps} if maps else {"whiskers": whiskers}),
    )
    about = done["estimates"].attrs
    if noisy and source == "sensor":
        status = done["estimates"].to_dataset()["status"].transpose("whisker", "time")
        free = np.asarray(status == vb.Status.NOT_FELT)
        each = map(vb.pipeline.doubted_noise, readings, itertools.repeat(how.noise.matrix()), free)
        remark_once(filter(None, each))
    noise = how.noise.described() if noisy else "noise as the recording states"
    noise += weight.described()
    used, friction = str(about["signals"]), float(about["friction"])
    return done, how.described(used, friction, noise, float(about["felt_above"]))

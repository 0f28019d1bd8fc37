"""Inputs shared by verbs: groups of options, and reading and writing of files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import vibrissa as vb
from vibrissa.cli.options import free, refuse, same_file
from vibrissa.cli.terminal import Tell, remark, say
from vibrissa.deferred import xr

RECORDING, MAP = "vibrissa recording", "vibrissa contact map"  # kinds of NetCDF files
_SHORTEST, _LONGEST = 0.5, 500.0  # lengths of whiskers, mm
_LONGEST_FUR = 20.0  # longest part of a whisker that fur hides, mm
_THICKEST = 10.0  # radius of a whisker above which it may be in micrometres instead of mm, mm
# Unit of each limit of a region on the command line.
_UNITS = {"r": 1e-3, "theta": math.pi / 180.0, "phi": math.pi / 180.0}


@dataclass(frozen=True)
class WhiskerOptions:
    """Options for a whisker, and for properties that its file does not state."""

    whisker: Path | None = None
    rat: str | None = None
    any_length: bool = False
    base_end: Literal["first", "last"] | None = None

    def __post_init__(self) -> None:
        self.check(self.whisker is not None)

    def check(self, given: bool) -> None:
        """Raise ValueError for options about a whisker if none is given."""
        if (self.rat is not None or self.any_length or self.base_end) and not given:
            raise ValueError("each of --rat, --any-length and --base-end needs a --whisker")

    def read(self, path: Path | None = None) -> vb.Whisker:
        """Read the whisker, or that of another file; by default the built-in γ whisker."""
        path = self.whisker if path is None else path
        if path is None:
            return vb.samples.gamma()
        if not path.exists():
            return self._built_in(path)
        if not vb.io.is_netcdf(path):
            if vb.io.recognise(path) == vb.io.Kind.VIDEO:
                raise ValueError(f"{path} is a video; a whisker, map or recording is needed")
            how: Any = {"rat": self.rat, "any_length": self.any_length}
            return vb.load_whisker(path, base=self.base_end, **how)
        refuse({"--base-end": self.base_end}, f"the base of the whisker in {path} is known")
        whisker = _whisker_in(path)
        return whisker if self.rat is None else whisker.with_properties(rat=self.rat)

    def _built_in(self, path: Path) -> vb.Whisker:
        """Whisker of `vibrissa.samples` by its name, where there is no such file."""
        names = vb.samples.__all__
        if str(path) not in names:
            raise FileNotFoundError(
                f"there is no file {path}; built-in whiskers are {', '.join(names)}"
            )
        refuse({"--base-end": self.base_end}, f"{path} is a built-in whisker")
        whisker: vb.Whisker = getattr(vb.samples, str(path))()
        return whisker if self.rat is None else whisker.with_properties(rat=self.rat)

    def in_recording(self, recording: xr.DataTree) -> list[vb.Whisker]:
        """Whiskers along the dimension ``whisker`` of a recording."""
        count = recording.sizes["whisker"]
        if self.whisker is not None:
            if count > 1:
                raise ValueError(f"--whisker is one whisker; the recording has {count}")
            return [self.read()]
        try:
            return vb.recording.Recording(recording).whiskers
        except ValueError as fault:
            raise ValueError(f"{fault}; give its centreline with --whisker") from None


@dataclass(frozen=True)
class TrackedOptions(WhiskerOptions):
    """Options for a tracked whisker, whose shape is that in the frames unless a file is given."""

    def __post_init__(self) -> None:
        if self.base_end and self.whisker is None:
            raise ValueError("--base-end needs a --whisker")

    def tracked_length(self, length: float | None) -> float | None:
        """Stated length of the whisker, m."""
        if length is None:
            return None
        least, most = (0.0, math.inf) if self.any_length else (_SHORTEST, _LONGEST)
        if not (length > 0.0 and least <= length <= most):
            raise ValueError(
                f"--length is {length:g} mm; {_SHORTEST:g} to {_LONGEST:g} mm are allowed, and any "
                "other with --any-length"
            )
        if self.whisker is not None:
            refuse({"--length": length}, "the --whisker has a length")
        return 1e-3 * length

    def hidden(self, fur: float) -> float:
        """Length of the whisker's base that fur hides, m."""
        if not 0.0 <= fur <= _LONGEST_FUR:
            raise ValueError(f"--fur is {fur:g} mm; 0 to {_LONGEST_FUR:g} mm are allowed")
        if self.whisker is not None:
            refuse({"--fur": fur or None}, "the --whisker begins where it is seen: cut it there")
        return 1e-3 * fur

    def tracked(self, base_radius: float | None, tip_radius: float | None) -> dict[str, Any]:
        """Keyword arguments of tracking: the whisker, if given, with the stated radii."""
        stated = {"--base-radius": base_radius, "--tip-radius": tip_radius}
        properties: dict[str, Any] = {
            name[2:].replace("-", "_"): metres_of(radius, name)
            for name, radius in stated.items()
            if radius is not None
        }
        if base_radius is not None and tip_radius is not None and tip_radius > base_radius:
            raise ValueError(
                f"--tip-radius, {tip_radius:g} mm, is larger than --base-radius, {base_radius:g} "
                "mm: are they exchanged?"
            )
        if self.whisker is not None:
            return {"whisker": self.read().with_properties(**properties)}
        if self.rat is not None:
            refuse(stated, "--rat determines the radii")
            vb.Whisker.straight(0.03, rat=self.rat)  # rejects unknown names early
            properties["rat"] = self.rat
        if self.any_length:
            properties["any_length"] = True
        return {"properties": properties}


_FAINT = 1e-3  # default noise of a force, in units of EI/L², below which it is questioned


@dataclass(frozen=True)
class NoiseOptions:
    """Options for the noise of the sensor: that of each component, or their covariance."""

    force_noise: float | None = None
    moment_noise: float | None = None
    covariance: Path | None = None

    def __post_init__(self) -> None:
        if self.covariance is not None:
            components = {name: v for name, v in self.stated.items() if name != "--covariance"}
            refuse(components, "--covariance states the noise")

    @property
    def stated(self) -> dict[str, object]:
        """Options by their names."""
        return {
            "--force-noise": self.force_noise,
            "--moment-noise": self.moment_noise,
            "--covariance": self.covariance,
        }

    @property
    def given(self) -> bool:
        """Whether any noise is stated."""
        return any(one is not None for one in self.stated.values())

    def _usual(self) -> tuple[float, float]:
        """Noise of force and moment, µN and µN·m, with defaults for unstated values."""
        return (
            vb.sensors.FORCE_NOISE * 1e6 if self.force_noise is None else self.force_noise,
            vb.sensors.MOMENT_NOISE * 1e6 if self.moment_noise is None else self.moment_noise,
        )

    def matrix(self) -> vb.numerics.Array:
        """Covariance (6, 6) of force and moment, SI units."""
        import numpy as np

        if self.covariance is None:
            force, moment = self._usual()
            return vb.sensors.component_noise(force * 1e-6, moment * 1e-6)
        try:
            rows = vb.io.table_rows(vb.io.read_text(self.covariance))
            covariance = np.array([[float(cell) for cell in cells] for _, cells in rows])
        except ValueError as fault:
            raise ValueError(f"{self.covariance} is not a covariance: {fault}") from None
        if covariance.shape != (6, 6):
            got = covariance.shape
            raise ValueError(f"{self.covariance} must contain six rows of six numbers; got {got}")
        return covariance

    def described(self) -> str:
        """Description of the noise, in the units of the options."""
        if self.covariance is not None:
            return f"noise of {self.covariance}"
        return "noise {:g} µN and {:g} µN·m".format(*self._usual())

    def doubt(self, whisker: vb.Whisker) -> None:
        """Question the default noise, that of a rat's whisker, for a far stiffer one."""
        size = whisker.base_bending_stiffness / whisker.length**2
        if self.given or _FAINT * size < vb.sensors.FORCE_NOISE:
            return
        remark(
            f"no noise is stated; the default, {self.described()}, is for a rat's whisker, and "
            f"this one is stiffer (EI/L² is {size:.2g} N): state --force-noise and --moment-noise, "
            "or contacts and their standard deviations are wrong"
        )


@dataclass(frozen=True)
class AssumptionOptions:
    """Options for assumptions: errors that all samples share, and the prior over contacts."""

    stiffness_sigma: float = 0.0
    gain_sigma: float = 0.0
    mixing_sigma: float = 0.0
    region: str | None = None
    least_force: float | None = None
    greatest_force: float | None = None
    tip: float = 0.0

    @property
    def errors(self) -> dict[str, float]:
        """Nonzero standard deviations, by the names of the arguments of estimates."""
        names = ("stiffness_sigma", "gain_sigma", "mixing_sigma")
        return {name: 0.01 * getattr(self, name) for name in names if getattr(self, name) > 0.0}

    @property
    def prior(self) -> vb.Prior | None:
        """Prior over contacts; None for the default."""
        stated = (self.region, self.least_force, self.greatest_force, self.tip or None)
        if all(value is None for value in stated):
            return None
        least = 0.0 if self.least_force is None else 1e-6 * self.least_force
        greatest = math.inf if self.greatest_force is None else 1e-6 * self.greatest_force
        if not least < greatest:
            raise ValueError(
                f"--least-force must be below --greatest-force; got {1e6 * least:g} and "
                f"{1e6 * greatest:g} µN"
            )
        region = self.region or "all"
        limits = _limits(region) if "=" in region else region
        return vb.Prior(limits, least, greatest, 0.01 * self.tip)

    def described(self) -> str:
        """Description of the assumptions for the end of a sentence; empty if there are none."""
        parts = [
            f"{name.removesuffix('_sigma')} known to {100.0 * value:g} %"
            for name, value in self.errors.items()
        ]
        possible = []
        if self.region is not None and "=" in self.region:
            possible.append(f"where {self.region} (mm, degrees)")
        elif self.region is not None and self.region != "all":
            possible.append(f"in {self.region}")
        if self.least_force:
            possible.append(f"of at least {self.least_force:g} µN")
        if self.greatest_force is not None:
            possible.append(f"of at most {self.greatest_force:g} µN")
        if self.tip:
            parts.append(f"the tip touched with a probability of {self.tip:g} %")
        if possible:
            parts.append(f"contacts only {' and '.join(possible)}")
        return "".join(f"; {part}" for part in parts)


def _limits(text: str) -> dict[str, tuple[float, float]]:
    """Parse limits such as ``r=20:35,theta=-30:30``; return them in SI units."""
    limits = {}
    for part in text.split(","):
        name, _, values = part.partition("=")
        try:
            ends = [float(value) for value in values.split(":")]
            if name.strip() != "r" and any(360.0 < abs(end) < math.inf for end in ends):
                raise ValueError
            least, greatest = (end * _UNITS[name.strip()] for end in ends)
        except (KeyError, ValueError):
            raise ValueError(
                f"--region is {text!r}; a name, or limits of r (mm), theta and phi (degrees) as "
                "r=20:35,theta=-30:30 are needed, angles up to 360"
            ) from None
        limits[name.strip()] = (least, greatest)
    return limits


def estimator_of(
    contact_map: vb.ContactMap,
    sensor: vb.sensors.Sensor | None,
    using: str | Sequence[str],
    noise: NoiseOptions,
    assumed: AssumptionOptions,
    gravity: vb.Gravity | None,
    felt_above: float,
) -> vb.Estimator:
    """Create an estimator for single measurements, from a sensor or from signals."""
    prior, errors = assumed.prior, assumed.errors
    if sensor is None:
        noise.doubt(contact_map.whisker)
        return vb.Estimator(
            contact_map,
            using,
            noise.matrix(),
            felt_above=felt_above,
            prior=prior,
            gravity=gravity,
            **errors,
        )
    stiffness = errors.pop("stiffness_sigma", 0.0)
    if errors:
        raise ValueError("the --sensor's file states gain_error and mixing_error")
    return vb.Estimator.of_sensor(contact_map, sensor, stiffness, felt_above, prior, gravity)


def metres_of(radius: float, option: str) -> float:
    """Convert the radius of a whisker from mm to m."""
    if not 0.0 < radius < _THICKEST:
        raise ValueError(
            f"{option} is {radius:g} mm; more than 0 and less than {_THICKEST:g} are needed"
        )
    return 1e-3 * radius


def smallest_arc(proximal: float | None) -> float:
    """Smallest arc length of a contact, as a share of the whisker's length."""
    return vb.rod.PROXIMAL if proximal is None else proximal


def print_notes(*whiskers: vb.Whisker) -> None:
    """Print the assumptions and notes of whiskers."""
    for note in dict.fromkeys(note for whisker in whiskers for note in whisker.notes):
        remark(f"note: {note}")


def kind_in(path: Path) -> str:
    """Kind of a NetCDF file; empty for other files."""
    if not path.is_file() or path.stat().st_size == 0:
        return ""
    return (vb.io.kind_of(path) or "") if vb.io.is_netcdf(path) else ""


def _whisker_in(path: Path) -> vb.Whisker:
    """Read the whisker of a recording or a map."""
    kind = vb.io.kind_of(path)
    if kind == RECORDING:
        return vb.recording.Recording(vb.load_recording(path)).whisker()
    if kind == MAP:
        return vb.ContactMap.load(path, grid=False).whisker
    raise ValueError(f"{path} contains {kind or 'data of another kind'}, and no whisker")


def refuse_tracks(path: Path) -> None:
    """Raise ValueError for tracks of another program, with the verb that converts them."""
    kind = vb.io.recognise(path)
    if kind in (vb.io.Kind.TRACKS, *vb.io.READERS):
        raise ValueError(
            f"{path} contains tracks ({kind}): convert it to a recording by `vibrissa import "
            f"{path} -o trial.nc` first"
        )


def recording_from(path: Path) -> xr.DataTree:
    """Read a recording."""
    refuse_tracks(path)
    recording = vb.load_recording(path)
    with vb.io.naming(path, "a recording"):
        vb.pipeline.check_recording(recording)
        _ = vb.recording.Recording(recording).objects
    return recording


def map_of(whisker: vb.Whisker, tell: Tell, *, grid: bool = False, **how: Any) -> vb.ContactMap:
    """Simulate the map of a whisker."""
    stage = "map of all contacts"
    tell(stage, 0, 1)
    made = vb.ContactMap.simulate(
        whisker, grid=grid, progress=lambda done, total: tell(stage, done, total), **how
    )
    tell(stage, 1, 1)
    return made


def wrench_from(path: Path) -> xr.Dataset:
    """Read force and moment over time from a table of signals or a recording."""
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if kind_in(path) != RECORDING:
        return vb.load_signals(path)
    recording = vb.load_recording(path)
    if not {"force", "moment"} <= set(recording.data_vars):
        raise ValueError(f"{path} is a recording without force and moment")
    wrench = recording.to_dataset()[["force", "moment"]]
    if wrench.sizes["whisker"] != 1:
        raise ValueError(f"{path} is a recording of {wrench.sizes['whisker']} whiskers, not of one")
    return wrench.isel(whisker=0)


def filtered_at(cutoff: float | None, rate: float, duration: float) -> float | None:
    """Cut-off of the filter of the pose, Hz, by default the usual one; None for no filter."""
    if cutoff is None:
        return vb.tracking.usual_cutoff(rate)
    if not 0.0 <= cutoff < 0.5 * rate:
        raise ValueError(
            f"--cutoff is {cutoff:g} Hz; it must be below half of {rate:g} frames/s, or 0 for none"
        )
    if 0.0 < cutoff * duration < 1.0:
        raise ValueError(
            f"--cutoff is {cutoff:g} Hz, whose period is longer than the recording, "
            f"{duration:.3g} s; 0 leaves the pose unfiltered"
        )
    return cutoff or None


def frames_from(table: Path) -> vb.pipeline.Frames:
    """Read force and moment over time from a table of signals."""
    time, force, moment, notes = vb.io.read_signals(table)
    each = {"force": (("time", "space"), force), "moment": (("time", "space"), moment)}
    return vb.pipeline.Frames({"time": ("time", time), **each}, {"notes": notes})


def cameras_from(path: Path) -> tuple[vb.cameras.Camera, ...]:
    """Read calibrated cameras from a recording, or from TOML of Anipose."""
    if path.suffix.lower() in vb.io.NETCDF:
        return vb.recording.Recording(vb.load_recording(path)).cameras
    return vb.cameras.load_cameras(path)


def objects_from(path: Path) -> tuple[vb.objects.Surface, ...]:
    """Read known objects from a recording, or from TOML with ``[[object]]``."""
    if path.suffix.lower() not in vb.io.NETCDF:
        with vb.io.in_file(path):
            return tuple(vb.simulation.read_objects(vb.io.read_text(path), path.parent))
    objects = vb.recording.Recording(vb.load_recording(path)).objects
    if not objects:
        raise ValueError(f"{path} is a recording without objects")
    return objects


def print_statuses(codes: object, each: str = "") -> None:
    """Print the number of frames with each status."""
    for sentence, count in vb.status.describe(codes).most_common():  # type: ignore[arg-type]
        say(f"{count:6d} {each} {sentence}")


def free_beside(recording: Path, files: Iterable[Path], force: bool) -> None:
    """Raise an error if files other than the recording exist and must not be replaced."""
    free([file for file in files if not same_file(file, recording)], force)


def print_written(path: Path, recording: Path | None = None, stage: str = "") -> None:
    """Report that a file was written, or that a stage was added to a recording."""
    added = recording is not None and same_file(path, recording)
    say(f"added {stage} to {path}" if added else f"wrote {path}")


def check_one_whisker(recording: xr.DataTree, path: Path) -> None:
    """Raise ValueError if a recording has several whiskers, which do not fit into a table."""
    count = recording.sizes["whisker"]
    if count != 1:
        raise ValueError(
            f"{path} is a recording of {count} whiskers; a table can contain only one: "
            "give an --output that ends in .nc"
        )


def maps_from(paths: Sequence[Path], count: int, grid: bool = False) -> list[vb.ContactMap]:
    """Read the map of each whisker."""
    if len(paths) != count:
        raise ValueError(f"there are {len(paths)} --map for {count} whiskers; each needs one")
    found = [vb.ContactMap.load(path, grid) for path in paths]
    for path, contact_map in zip(paths, found, strict=True):
        if grid and contact_map.grid is None:
            raise ValueError(
                f"{path} has no grid to look up in: create it by `vibrissa map` without --no-grid"
            )
    return found

"""`vibrissa calibrate`: cameras by a checkerboard; sensors and suspended whiskers by touches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

import vibrissa as vb
from vibrissa.cli.inputs import WhiskerOptions
from vibrissa.cli.options import check_new, refuse, with_options
from vibrissa.cli.terminal import progress_bars, remark, say
from vibrissa.io import unit_factor
from vibrissa.numerics import Array, Mask

# Noise relative to the range of the readings above which the user is warned.
_UNEXPLAINED = 0.05
_LOUD = 5.0  # ratio of residuals and noise at rest above which the user is warned
_AGAIN = 4  # number of touches with the same extreme reading that suggests saturation
_MOST_NAMED = 5  # largest number of touches listed
_POOR = 1.0  # reprojection error above which the user is warned, pixels
_SMALLEST, _LARGEST = 0.05, 200.0  # plausible sides of squares, mm; smaller ones may be in m
_FRAMES = 40  # default number of frames used from a video
_AT_REST = 3  # smallest number of readings at rest that show the noise


@with_options("cameras, TOML of Anipose; sensor, TOML; or suspended whisker, NetCDF (.nc)")
def calibrate(
    images: list[Path],
    target: Path,
    own: WhiskerOptions,
    pattern: str | None = None,
    square: float | None = None,
    frames: int | None = None,
    components: str | None = None,
    touch_sigma: float | None = None,
    force: bool = False,
) -> None:
    """Calibrate cameras by a checkerboard, or a sensor or suspended whisker by touches.

    All cameras must record the board at the same times (requires the extra "cameras"); the board is
    rotated and moved between images. The result is for `vibrissa track --cameras`; its laboratory
    frame is that of the board in the first images in which all cameras see it. For a suspended
    whisker, the description of a stage (vibrissa.sensors.Stage) names tables of touches and of the
    resting whisker; the calibrated sensor is for `vibrissa estimate --sensor`. A linear sensor, of
    any number of channels, is calibrated by a table of touches of a --whisker (.csv): the points x,
    y, z, mm, in the whisker's frame, and a column of readings for each channel. Rows without a
    point are readings at rest, which show the noise. It is for `vibrissa stream --sensor`.
    Example: `vibrissa calibrate --pattern 9x6 --square 5 top_*.png front_*.png -o cameras.toml`;
    `vibrissa calibrate stage.toml -o sensor.nc`;
    `vibrissa calibrate touches.csv --whisker wire.nc --components My,Mz -o sensor.toml`
    """
    boards = {"--pattern": pattern, "--square": square, "--frames": frames}
    touches = {"--whisker": own.whisker, "--components": components, "--touch-sigma": touch_sigma}
    kind = images[0].suffix if len(images) == 1 else ""
    if kind in (".toml", ".csv"):
        refuse(boards, f"only a checkerboard needs it, and {images[0]} describes touches")
        if kind == ".csv":
            _linear(images[0], target, own, components, touch_sigma, force)
            return
    refuse(touches, "only a table of touches (.csv) needs it")
    if kind == ".toml":
        _suspended(images[0], target, force)
        return
    if pattern is None or square is None:
        raise ValueError("--pattern and --square of the checkerboard are needed, as 9x6 and 5")
    _cameras(images, pattern, square, target, frames, force)


def _linear(
    table: Path,
    target: Path,
    own: WhiskerOptions,
    components: str | None,
    touch_sigma: float | None,
    force: bool,
) -> None:
    """Calibrate a linear sensor."""
    check_new(target, (".toml",), force)
    if own.whisker is None:
        raise ValueError("--whisker is needed: state which whisker was touched")
    channels, points, readings = _touches(table)
    rest = readings[np.isnan(points).all(axis=1) & np.isfinite(readings).all(axis=1)]
    _check_saturation(channels, readings)
    quiet = rest.std(axis=0, ddof=1) if len(rest) >= _AT_REST else np.zeros(len(channels))
    found = vb.sensors.calibrate_on_contacts(
        own.read(),
        points,
        readings,
        point_sigma=1e-3 * (touch_sigma or 0.0),
        channels=channels,
        components=components.replace(" ", "").split(",") if components else vb.sensors.COMPONENTS,
        noise=quiet,
    )
    vb.sensors.save_sensor(target, found.sensor)
    where = [vb.sensors.COMPONENTS.index(name) for name in found.components]
    for k, name in enumerate(channels):
        sigma = np.sqrt(found.covariance[k].diagonal())
        fits = zip(found.components, found.sensor.mixing[k, where], sigma[:-1], strict=True)
        text = ", ".join(f"{one} {value:.4g} ± {error:.2g}" for one, value, error in fits)
        say(f"{name}: {text} per N or N·m; noise {found.sensor.noise[k]:.3g}")
    what = "unit, axes, origin and order of the touches"
    # Channels that the touches do not explain are warned of already.
    doubted = np.isin(channels, found.unexplained)
    _question_noise(found.sensor, readings, what, ~doubted)
    ratio = np.divide(
        found.sensor.noise, quiet, out=np.zeros(len(channels)), where=(quiet > 0.0) & ~doubted
    )
    if ratio.max() > _LOUD:
        names = ", ".join(np.array(channels)[ratio > _LOUD])
        say(
            f"  The touches leave residuals of {names} up to {ratio.max():.2g} times the noise at "
            f"rest: are {what} right, and the errors of their points stated (--touch-sigma)?"
        )
    say(f"wrote {target}")


def _touches(table: Path) -> tuple[list[str], Array, Array]:
    """Channels of a table of touches, points (n, 3), m, and readings (n, k)."""
    names, values = vb.io.read_numbers(table)
    # Units of columns that state none are those of the command line.
    units = {
        name: unit_factor(name[1:], "length") if name[1:] else 1e-3
        for name in names
        if name[:1].lower() in tuple("xyz") and not name[1:2].isalnum()
    }
    axes = sorted((name for name, unit in units.items() if unit), key=str.lower)
    if [name[0].lower() for name in axes] != list("xyz"):
        raise ValueError(
            f"{table}: columns x, y, z (mm; also x_m and so on) are needed; its columns are "
            f"{', '.join(names)}"
        )
    channels = [name for name in names if name not in (*axes, "time", "")]
    if not channels:
        raise ValueError(f"{table} has no column of readings in addition to {', '.join(names)}")
    points = values[:, [names.index(axis) for axis in axes]] * [units[axis] or 1.0 for axis in axes]
    return channels, points, values[:, [names.index(name) for name in channels]]


def _suspended(description: Path, target: Path, force: bool) -> None:
    """Calibrate a whisker on a compliant suspension."""
    check_new(target, vb.io.NETCDF, force)
    stage = vb.sensors.Stage.load(vb.io.check_readable(description))
    points, readings, rest, drift = stage.touches()
    _check_saturation(stage.channels, readings)
    whisker = stage.whisker()
    with progress_bars() as tell:
        tell("calibration", 0, 1)
        found = vb.sensors.calibrate_suspension(
            whisker,
            points,
            readings,
            channels=stage.channels,
            rest=rest,
            base_sigma=stage.base_sigma,
            drift=drift,
        )
        tell("calibration", 1, 1)
    vb.sensors.save_suspended(target, found, stage)
    far = np.flatnonzero(found.outliers)
    lost = len(points) - int(found.used.sum()) - far.size
    unused = f"; {lost} have no equilibrium in the model" * (lost > 0)
    if far.size:
        which = ", ".join(str(k + 1) for k in far[:_MOST_NAMED]) + ", …" * (far.size > _MOST_NAMED)
        unused += f"; left out as far from all others: {which} (of the touches, from 1)"
    say(f"{found.used.sum()} touches{unused}")
    spread = found.covariance.diagonal() ** 0.5
    for name, value, sigma in zip(found.names, found.values, spread, strict=True):
        open_ = "  (not determined by the touches)" if name in found.undetermined else ""
        say(f"{name}: {value:.3g} ± {sigma:.2g}{open_}")
    sensor = found.sensor
    for k, name in enumerate(sensor.channels):
        scale = abs(readings[:, k]).max()
        say(
            f"{name}: noise {sensor.noise[k]:.3g}, {100 * sensor.noise[k] / scale:.2g} % of the "
            f"largest reading; the rod leaves {found.residual[k]:.3g}; drift {sensor.drift[k]:.3g}"
        )
    _question_noise(
        sensor,
        readings,
        "origin and axes of the touches, the readings at rest and the order of the shape's points "
        "(from the base)",
    )
    say(f"wrote {target}")


def _question_noise(
    sensor: vb.sensors.Sensor | vb.sensors.SuspendedWhisker,
    readings: Array,
    what: str,
    asked: Mask | bool = True,
) -> None:
    """Warn of channels with noise that is large compared with their readings."""
    poor = (sensor.noise > _UNEXPLAINED * np.ptp(readings, axis=0)) & asked
    if poor.any():
        names = ", ".join(name for name, much in zip(sensor.channels, poor, strict=True) if much)
        say(f"  That is much noise of {names}: are {what} right?")


def _check_saturation(channels: Sequence[str], readings: Array) -> None:
    """Warn of channels that repeatedly read their largest or smallest value."""
    for name, values in zip(channels, readings.T, strict=True):
        for end in (values.min(initial=np.inf), values.max(initial=-np.inf)):
            count = int((values == end).sum())
            if count >= _AGAIN and np.ptp(values) > 0.0:
                remark(
                    f"{name} reads {end:g}, and nothing beyond, at {count} touches: does it "
                    "saturate? Leave such touches out (of a stage: `largest` in [touches])"
                )


def _cameras(
    images: list[Path], pattern: str, square: float, target: Path, frames: int | None, force: bool
) -> None:
    """Calibrate cameras."""
    corners = _corners(pattern)
    if not _SMALLEST < square < _LARGEST:
        raise ValueError(f"--square is {square:g}; the side of a square in mm is needed, as 5")
    if frames is not None and frames < 2:
        raise ValueError(f"--frames is {frames}; a few dozen are needed")
    check_new(target, (".toml",), force)
    if vb.io.Kind.VIDEO not in map(vb.io.recognise, images):
        refuse({"--frames": frames}, "only videos need it, and these are images")
    cameras, error, point_sigma = vb.cameras.calibrate(
        vb.io.load_series(images, frames or _FRAMES), corners, 1e-3 * square
    )
    vb.cameras.save_cameras(target, cameras)
    for camera in cameras:
        say(
            f"{camera.name}: {camera.size[0]} × {camera.size[1]} pixels, focal length "
            f"{camera.matrix[0, 0]:.1f} × {camera.matrix[1, 1]:.1f} pixels, "
            f"{1e3 * np.linalg.norm(camera.translation):.4g} mm from the first board's corner"
        )
    say(
        f"reprojection error {error:.3f} pixels (root mean square); points among the boards are "
        f"uncertain by {1e6 * point_sigma:.2g} µm due to it"
    )
    if error > _POOR:
        say(
            "  This error is large: perhaps the images were not taken at the same times, are "
            "blurred, or the pattern has other corners."
        )
    say(f"wrote {target}")


def _corners(text: str) -> tuple[int, int]:
    """Parse the numbers of inner corners, such as 9x6."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--pattern is {text!r}; the numbers of inner corners as 9x6 are needed")
    corners = int(parts[0]), int(parts[1])
    if min(corners) < 3:
        raise ValueError(f"--pattern is {text!r}; at least 3 inner corners each way are needed")
    return corners

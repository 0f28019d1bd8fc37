"""`vibrissa info`: versions and settings, or the contents of a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vibrissa as vb
from vibrissa.cli.inputs import MAP, frames_from
from vibrissa.cli.options import with_options
from vibrissa.cli.terminal import print_properties, shown
from vibrissa.cli.track import compared_contacts
from vibrissa.deferred import xr

_SHOWN = 12
_TABLES = """\
  signals         time, Fx, Fy, Fz, Mx, My, Mz; or three or more of Fx, FT, FD, Mx, MB, MD
  a centreline    x_mm, y_mm, z_mm, from base to tip
  contacts        time, x, y, z, r, theta, phi, sigma_x, sigma_y, sigma_z, status
  the head        time or frame; x, y, z; qw, qx, qy, qz, or r11 … r33, or angles
  contact points  time or frame, x, y, z; or view, frame, x, y
  tracked points  time or frame; x, y, z or column, row
  corrections     view, frame, whisker, x, y
  whiskers        name, x_mm, y_mm, z_mm, azimuth_deg, …, length_mm, coefficient_per_mm"""
_VERDICTS = "vibrissa uniqueness"
# Command for the next step after a file, by its kind.
_NEXT = {
    MAP: "estimate SIGNALS.csv --map {} -o contacts.csv",
    _VERDICTS: "figures MAP.nc --uniqueness {} -o figures",
    "vibrissa whisker": "map --whisker {} -o map.nc",
    "whisker": "map --whisker {} -o map.nc",
    "sensor": "estimate READINGS.csv --map MAP.nc --sensor {} -o contacts.csv",
    "calibration": "track VIDEO VIDEO --cameras {} -o trial.nc",
    "study": "sweep {} -o study.zarr",
    "settings": "simulate {} -o trial.nc",
    "stage": "calibrate {} -o sensor.nc",
    "suspended whisker": "estimate SWEEP.csv --sensor {} -o sweep.nc",
    "the head's pose": "track VIDEO VIDEO --head {} -o trial.nc",
    "contact points": "track VIDEO VIDEO --contact {} -o trial.nc",
    "corrections": "track VIDEO VIDEO --corrections {} -o trial.nc",
    "signals": "estimate {}  # the whisker: --whisker or --map FILE",
}
_SETTINGS = {
    "study": "a study, for vibrissa sweep",
    "stage": "touches of a suspended whisker by a stage",
    "settings": "settings, as of vibrissa simulate",
}
# What results for other programs are used for.
_RESULTS = {
    vb.io.Kind.CONTOUR: "no command takes the table; the points are also in the recording, which "
    "`vibrissa report`, `figures` and `view` show",
    vb.io.Kind.NWB: "in programs for NWB, and in Python by vibrissa.io.load_nwb_series; commands "
    "take the recording that was exported, and `vibrissa import` the tracked points, if any",
    vb.io.Kind.PREDICTORS: "in pandas, MATLAB and others; commands take the recording that was "
    "exported, and `vibrissa estimate` the signals of a table that is .csv",
}
_PACKAGES = ("numpy", "scipy", "numba", "xarray", "h5netcdf", "matplotlib")


@with_options()
def info(path: Path | None = None, all_: bool = False) -> None:
    """List versions and settings of this installation, or describe the contents of a file.

    For a recording these are its origin, duration, contacts, stages and object. With --all, groups
    and variables follow, and boxes of a certificate are checked. The last line is the command for
    the next step.
    Example: `vibrissa info trial.nc`
    """
    print_properties(_installation() if path is None else _file(path, all_))


def _installation() -> Iterator[tuple[str, str]]:
    import platform
    from importlib.metadata import version

    import vibrissa

    yield "vibrissa", f"{vibrissa.__version__}, {Path(vibrissa.__file__).parent}"
    yield "python", f"{platform.python_version()}, {platform.system()} {platform.machine()}"
    for name in _PACKAGES:
        yield name, version(name)
    yield "threads", f"{vb.numerics.threads()} (VIBRISSA_THREADS sets another number)"
    folder = getattr(getattr(vb.rod.evaluate, "_cache", None), "cache_path", None)
    yield "kernels", f"cached in {folder}" if folder else "compiled anew in every run"


def _follows(kind: str | None, path: Path) -> Iterator[tuple[str, str]]:
    """Yield the command for the next step after a file, if there is one."""
    if kind in _NEXT:
        yield "next", f"vibrissa {_NEXT[kind].format(path)}"


def _bag(path: Path) -> Iterator[tuple[str, str]]:
    """List the topics of a bag, and the command for its wrenches."""
    topics = vb.io.bag_topics(path)
    yield "file", str(path)
    yield "kind", f"bag of ROS, {len(topics)} topics"
    for topic, (kind, count) in sorted(topics.items()):
        yield topic, f"{count} messages, {kind}"
    # Bags written by `stream` contain the force at the contact, which no verb uses.
    wrenches = [t for t, (kind, _) in topics.items() if kind.endswith("WrenchStamped")]
    if any(not topic.endswith("/contact_force") for topic in wrenches):
        yield "next", f"vibrissa stream {path} --map MAP.nc --bag-out contacts"


def _size(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e3:.3g} kB" if size < 1e6 else f"{size / 1e6:.3g} MB"


def _file(path: Path, whole: bool) -> Iterator[tuple[str, str]]:
    if vb.io.is_bag(path):
        yield from _bag(path)
        return
    if path.is_dir():
        yield from _array(path, "folder of centrelines")
        return
    vb.io.check_readable(path)
    kind = vb.io.recognise(path)
    if kind == vb.io.Kind.RECORDING:
        yield from _recording(path, whole)
        return
    yield "file", f"{path}, {_size(path)}"
    if _is_sensor(path):
        yield from _sensor(path)
        return
    if about := _exported(path, kind):
        yield "kind", about
        yield "use", _RESULTS[kind]
    elif kind in (vb.io.Kind.ARRAY, vb.io.Kind.ARRAY_TABLE):
        yield from _array(path, kind)
    elif kind == vb.io.Kind.NETCDF:
        yield from _groups(path, whole)
    elif kind in (vb.io.Kind.TRACKS, *vb.io.READERS):
        yield from _tracks(path, kind)
    elif kind == vb.io.Kind.VIDEO:
        yield from _video(path)
    elif kind == vb.io.Kind.CALIBRATION:
        yield from _calibration(path)
    elif path.suffix == ".toml":
        yield from _settings(path)
    else:
        try:
            vb.io.read_text(path)
        except ValueError:
            kinds = [*vb.io.READERS, vb.io.Kind.TRACKS, vb.io.Kind.RECORDING, "tables as text"]
            raise ValueError(
                f"{path} is not of a known kind. Known are: {'; '.join(kinds)}"
            ) from None
        yield from _table(path)


def _exported(path: Path, kind: vb.io.Kind) -> str:
    """Description of a result for other programs; empty for other files."""
    if kind != vb.io.Kind.NWB:
        return kind if kind in _RESULTS else ""
    try:
        series = ", ".join(map(str, vb.io.load_nwb_series(path)))
    except ValueError:
        return ""
    return f"{kind}, as vibrissa export writes it: {series}"


def _recording(path: Path, whole: bool) -> Iterator[tuple[str, str]]:
    """Describe a recording in five lines: contents, assumptions, and what comes next."""
    with vb.io.naming(path, "a recording"):
        tree = _summarised(path)
        vb.io.check_units(tree)
        vb.pipeline.check_recording(tree)
        found = vb.pipeline.TrialSummary(tree)
    one = len(found.whiskers) == 1
    names = ", ".join(found.whiskers[:_SHOWN]) + (", …" if len(found.whiskers) > _SHOWN else "")
    yield (
        "what",
        f"vibrissa recording, {found.origin}, {_size(path)}; "
        f"{'whisker' if one else f'whiskers {len(found.whiskers)}'}: {names}",
    )
    moves = f"; the base moves within {shown('base_position', found.extent, 3)}"
    moves = moves if np.isfinite(found.extent) else ""
    lasts = f"{found.frames} frame{'s' * (found.frames != 1)}, without times"
    if found.duration:
        rate = found.frames / found.duration
        lasts = f"{found.duration:g} s, {found.frames} frames at {rate:g} a second"
    yield "duration", f"{lasts}{moves}"
    yield "contacts", _contacts(found)
    if found.events:
        events = ", ".join(f"{name}: {n}" for name, n in found.events.items())
        yield "events", f"{events} (of the estimates)"
    # Of a stage the earlier ones are not needed: a sweep of a suspended whisker has no signals.
    stages = vb.pipeline.STAGES
    missing = stages[stages.index(found.stages[-1]) + 1 :] if found.stages else stages
    lacking = ", ".join(missing)
    there = ", ".join(found.stages) or "none"
    yield "stages", f"{there}{f' (missing: {lacking})' if missing else ''}"
    thing = f"fitted: {found.fitted}" if found.fitted else "none fitted"
    if np.isfinite(found.distance):
        thing += f", contacts {1e6 * found.distance:.1f} µm from it (median)"
    yield "object", f"{thing}{f'; known: {found.known}' if found.known else ''}"
    yield from _compared(path)
    yield from _groups(path) if whole else _all_notes(path)
    # Estimates exist, but without contacts from which an object could be reconstructed.
    stuck = "estimates" in found.stages and not found.estimated
    follows = "report" if stuck or not missing else "reconstruct"
    yield "next", f"vibrissa {follows} {path}{'' if whole else '  # groups and variables: --all'}"


def _contacts(found: vb.pipeline.TrialSummary) -> str:
    """Description of contacts, their forces, and the number of estimated contact points."""
    if found.contacts is None:
        return "not known"
    text = f"{found.contacts}, in {found.in_contact} frames"
    if np.isfinite(found.largest_force):
        force, moment = found.largest_force, found.largest_moment
        text += f", up to {shown('force', force, 3)} and {shown('moment', moment, 3)}"
    if not found.estimated:
        return text
    how = f", {found.assumption}" if found.assumption else ""
    return f"{text}; {found.estimated} contact points estimated{how}"


def _summarised(path: Path) -> xr.DataTree:
    """Read only the variables of a recording needed for a summary, for speed."""
    with vb.io.opened(path, "a recording") as file:
        groups = [name for name in ("truth", "signals", "estimates", "contour") if name in file]
        objects = [f"objects/{name}" for name in file["objects"]] if "objects" in file else []
    # Bases are compared with the centreline, which shows a wrong unit of theirs.
    needed = ["in_contact", "status", "force", "moment", "centerline", *vb.pipeline.EVENTS]
    pose = ["time", "whisker", "base_position", "base_rotation"]
    parts: dict[str, list[str] | None] = {"/": [*pose, *needed]}
    parts |= {name: None if name == "contour" else needed for name in groups}
    parts |= dict.fromkeys(objects)
    # Without all inputs, their checksums cannot be compared.
    read = vb.io.read_parts(path, parts).items()
    return xr.DataTree.from_dict(
        {name: data.drop_vars("made_from", errors="ignore") for name, data in read}
    )


def _settings(path: Path) -> Iterator[tuple[str, str]]:
    """Describe other settings, which are checked by the verbs that use them."""
    settings = vb.io.read_toml(path)
    kind = "settings"
    if {"whiskers", "tasks"} & set(settings):
        kind = "study"
    elif "touches" in settings:
        kind = "stage"
    yield "kind", _SETTINGS[kind]
    yield "states", ", ".join(settings) or "nothing"
    yield from _follows(kind, path)


def _is_sensor(path: Path) -> bool:
    if path.suffix != ".toml":
        return False
    settings = vb.io.read_toml(path)
    return "noise" in settings and not isinstance(settings["noise"], dict)


def _sensor(path: Path) -> Iterator[tuple[str, str]]:
    """Describe a sensor, one line per channel."""
    sensor = vb.sensors.load_sensor(path)
    yield "kind", "sensor; channels, in their own units, of components in N and N·m"
    each = (sensor.mixing, sensor.noise, sensor.bias, sensor.resolution, sensor.drift)
    for name, mixing, noise, bias, step, drift, largest in zip(
        sensor.channels, *each, sensor.largest, strict=True
    ):
        parts = [f"{a:g} {c}" for a, c in zip(mixing, vb.sensors.COMPONENTS, strict=True) if a]
        ends = f", resolution {step:.3g}" if step else ""
        ends += f", drift {drift:.3g} in a second" if drift else ""
        ends += f", saturates at ±{largest:g}" if np.isfinite(largest) else ""
        formula = " + ".join([*parts, f"{bias:.4g}"]).replace("+ -", "- ")
        yield name, f"{formula}, noise {noise:.3g}{ends}"
    x, y, z = 1e3 * sensor.frame.position
    hand = "right" if sensor.frame.handedness > 0 else "left"
    counts = ", measures the reaction" if sensor.frame.reaction else ""
    yield "frame", f"{hand}-handed, origin at ({x:z.2f}, {y:z.2f}, {z:z.2f}) mm{counts}"
    yield "carries", f"{1e3 * sensor.mass:.3g} g"
    known = []
    if sensor.gain_error.any():
        known.append(f"gain known to {100.0 * sensor.gain_error.max():g} %")
    if sensor.mixing_error.any():
        share = (
            f"{100.0 * sensor.mixing_error:g} %" if sensor.mixing_error.ndim == 0 else "a matrix"
        )
        known.append(f"mixing to {share}")
    if sensor.mixing_covariance.any():
        known.append("mixing and offset as a calibration left them")
    yield "errors", ", ".join(known) or "none stated: gain and mixing count as exact"
    yield from _follows("sensor", path)


def _array(path: Path, kind: str) -> Iterator[tuple[str, str]]:
    """Describe the whiskers of an array, one line each."""
    array = vb.load_array(path)
    yield "kind", kind
    sides = [array.identity(name).side for name in array]
    yield "whiskers", f"{len(array)}: {sides.count('left')} left, {sides.count('right')} right"
    for name, whisker in array.items():
        x, y, z = whisker.pose.origin * 1e3
        yield name, f"base at ({x:z.2f}, {y:z.2f}, {z:z.2f}) mm; {repr(whisker).split(': ', 1)[1]}"


def _video(path: Path) -> Iterator[tuple[str, str]]:
    found = vb.io.video_info(path)
    yield "kind", f"video, {found.codec}"
    yield "size", f"{found.width} × {found.height} pixels"
    yield "frames", f"{found.frames or 'number not stated'}, shown at {found.rate:g} a second"
    yield "next", f"vibrissa track {path} [VIDEO of the other view] -o trial.nc"


def _calibration(path: Path) -> Iterator[tuple[str, str]]:
    yield "kind", "calibration of cameras"
    for camera in vb.cameras.load_cameras(path):
        yield camera.name, f"{camera.size[0]} × {camera.size[1]} pixels, {camera.projection}"
    yield from _follows("calibration", path)


def _tracks(path: Path, kind: str) -> Iterator[tuple[str, str]]:
    """Describe sizes, times and missing points of tracks, whose unit may be unknown."""
    yield "kind", kind
    unstated = ""
    if kind == vb.io.Kind.TRACKS:
        tracks = vb.load_tracks(path)
    else:
        raw = vb.io.READERS[vb.io.Kind(kind)](path)
        tracks, unstated = _without_unit(raw, path)
    for name in ("source_software", "scorer", "identity", "direction", "variable"):
        if tracks.attrs.get(name):
            yield name.replace("_", " "), str(tracks.attrs[name])
    time = tracks["time"]
    unit = time.attrs.get("units", "")
    first, last = float(time.min()), float(time.max())
    span = f"from {first:g} to {last:g} s" if unit == "s" else f"numbered {first:g} to {last:g}"
    yield "frames", f"{time.size}, {span}"
    for dim in ("whisker", "view", "node"):
        if dim in tracks.sizes:
            yield f"{dim}s", _listed(tracks, dim)
    for name in ("trace", "centerline"):
        if name in tracks:
            found = tracks[name]
            there = 100.0 * float(found.notnull().all(str(found.dims[-1])).mean())
            where = found.attrs.get("reference_frame", "")
            units = found.attrs["units"]
            if name == "centerline" and unstated:
                units = f"unit not stated (plausible: {unstated})"
            yield name, f"{units}{f', {where} frame' if where else ''}; {there:.1f} % of points"
    others = [
        str(name)
        for name, values in tracks.data_vars.items()
        if name not in ("trace", "centerline") and values.notnull().any()
    ]
    if others:
        yield "also", ", ".join(others)
    yield "next", _import(path, tracks, unstated)


def _import(path: Path, tracks: xr.Dataset, unstated: str) -> str:
    """Command that converts tracks to a recording."""
    words = ["vibrissa import", str(path)]
    hint = ""
    if "centerline" in tracks:
        words += [f"--unit {unstated}"] if unstated else []
    elif tracks.sizes["view"] > 2:
        words += ["--cameras CAMERAS.toml"]
    else:
        if tracks.sizes["view"] == 1:
            words += ["[FILE of the other view]"]
            hint = "  # with one view the whisker is assumed to stay in its plane"
        words += ["--pixel-size MM (or --cameras CAMERAS.toml)"]
    if tracks["time"].attrs.get("units") != "s":
        words += ["--rate FRAMES_A_SECOND"]
    return f"{' '.join(words)} -o trial.nc{hint}"


def _without_unit(raw: vb.io.RawTracks, path: Path) -> tuple[xr.Dataset, str]:
    """Label tracks; if the unit of their points is not stated, with the first plausible unit."""
    if raw.space is None or raw.unit:
        return vb.io.labelled(raw, path), ""
    if raw.usual_unit:
        with suppress(ValueError):
            return vb.io.labelled(raw, path), ""
    for unit in ("mm", "m"):
        with suppress(ValueError):
            return vb.io.labelled(raw, path, unit=unit), unit
    return vb.io.labelled(raw, path, unit="um"), "um"


def _listed(tracks: xr.Dataset, dim: str) -> str:
    count = tracks.sizes[dim]
    if dim not in tracks.coords:
        return str(count)
    names = [str(name) for name in tracks[dim].values[:8]]
    return f"{count}: {', '.join(names)}{', …' if count > 8 else ''}"


def _suspended(path: Path) -> Iterator[tuple[str, str]]:
    """Describe a calibrated suspended whisker, one line per channel."""
    sensor, _ = vb.sensors.load_suspended(path)
    yield "whisker", repr(sensor.whisker).split(": ", 1)[1]
    for name, noise, drift in zip(sensor.channels, sensor.noise, sensor.drift, strict=True):
        yield name, f"noise {noise:.3g}, drift {drift:.3g} from one recording to the next"


def _groups(path: Path, whole: bool = False) -> Iterator[tuple[str, str]]:
    """Describe kind, groups and variables of a NetCDF file; of its values only names are read."""
    import h5netcdf

    kind = vb.io.kind_of(path)
    yield "kind", kind or "unknown"
    if "certificate" in (kind or "") and kind == vb.certificates.KIND:
        yield from _certificate(path, whole)
        return
    if kind in (MAP, _VERDICTS, "suspended whisker") and not whole:
        if kind == MAP:
            yield "map", f"{vb.ContactMap.load(path)!r}"[1:-1]
        elif kind == _VERDICTS:
            yield from _verdicts(path)
        else:
            yield from _suspended(path)
        yield "also", "groups and variables: --all"
        yield from _follows(kind, path)
        return
    with vb.io.opened(path, "NetCDF-4", soft_links=False), h5netcdf.File(path, "r") as file:
        names = [_text(one) for one in file.variables["whisker"][...]] if _many(file) else []
        for name, group in _within(file, "/"):
            if not (names and f"{name}/".startswith("/whiskers/")):
                yield from _variables(name, group)
        if names:
            yield "/whiskers", f"{len(names)}: {', '.join(names)}"
            yield from _notes(file.groups["whiskers"])
        yield from _remarks(file)
    yield from _follows(kind, path)


def _verdicts(path: Path) -> Iterator[tuple[str, str]]:
    """List which triplets locate contacts uniquely in which regions."""
    found = vb.io.read_dataset(path)
    regions = found["notation"].to_series()
    held = regions[regions != "–"]
    proved = int((found["evidence"] == "proved").any("region").sum())
    yield "whisker", str(found.attrs["whisker"])
    yield "unique", "; ".join(f"{name} ({where})" for name, where in held.items()) or "none"
    yield "evidence", f"{proved} proved, {len(held) - proved} with no counterexample found"
    yield "not unique", f"{len(regions) - len(held)} of {len(regions)} triplets in any region"
    yield "left out", f"contacts within {np.degrees(found.attrs['cone']):.3g}° of rest"


def _certificate(path: Path, whole: bool) -> Iterator[tuple[str, str]]:
    """Describe the statement of a certificate, and its number of boxes."""
    found = vb.certificates.load_certificate(path)
    yield "whisker", found.whisker
    yield "states", found.summary()
    for name, part in found.parts.items():
        yield name, f"{len(part.certified)} boxes certain, {len(part.undecided)} undecided"
    yield "identity", found.identity
    if whole:
        try:
            checked = vb.certificates.check_certificate(path)
        except ValueError as fault:
            yield "checked", f"no: {fault}"
            return
        yield (
            "checked",
            f"the boxes {'fill' if checked.covers else 'do not fill'} the domain; an independent "
            f"check confirms {checked.confirmed} of {checked.boxes} random ones",
        )


def _many(file: Any) -> bool:
    """Whether a file has several whiskers, whose names are listed instead of their variables."""
    if "whiskers" not in file.groups or "whisker" not in file.variables:
        return False
    group = file.groups["whiskers"]
    return len(group.groups) > 1 or len(group.variables) > 0


def _within(group: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield a group and all groups below it, with their paths."""
    yield name, group
    for key, below in group.groups.items():
        yield from _within(below, f"{name.rstrip('/')}/{key}")


def _variables(name: str, group: Any) -> Iterator[tuple[str, str]]:
    """List sizes and variables of a group, without the coordinates of dimensions."""
    sizes: dict[str, int] = {}
    apart: set[str] = set()
    for variable in group.variables.values():
        sizes |= dict(zip(variable.dimensions, variable.shape, strict=True))
        apart |= set(_text(variable.attrs.get("coordinates", "")).split())
    apart |= set(_text(group.attrs.get("coordinates", "")).split())
    shown = {n: v for n, v in group.variables.items() if n not in sizes and n not in apart}
    if not shown:
        return
    listed = ", ".join(f"{dim} {size}" for dim, size in sizes.items())
    yield from _notes(group)
    yield name, listed or "no dimensions"
    for variable, data in shown.items():
        units = _text(data.attrs.get("units", ""))
        yield f"  {variable}", f"({', '.join(data.dimensions)}) {'' if units == '1' else units}"


def _notes(group: Any) -> Iterator[tuple[str, str]]:
    """List the assumptions about the whiskers of a group."""
    import json

    if _text(group.attrs.get("kind", "")) != "vibrissa whisker":
        return
    texts = [_text(group.attrs["notes"])] if "notes" in group.attrs else []
    if "notes" in group:
        texts += [_text(one) for one in group["notes"][...]]
    try:
        notes = [str(note) for text in texts for note in json.loads(text)]
    except (ValueError, TypeError):
        notes = texts
    yield from (("note", note) for note in dict.fromkeys(notes))


def _remarks(file: Any) -> Iterator[tuple[str, str]]:
    """List what tracking noted about a recording."""
    yield from (("note", line) for line in _text(file.attrs.get("remarks", "")).splitlines())


def _all_notes(path: Path) -> Iterator[tuple[str, str]]:
    """List the notes about all whiskers, and about the recording as a whole."""
    with vb.io.opened(path, "NetCDF-4", soft_links=False) as file:
        for group in vb.io.all_groups(file):
            yield from _notes(group)
        yield from _remarks(file)


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _compared(path: Path) -> Iterator[tuple[str, str]]:
    """Compare contact points from other sources with those of the fitted rod."""
    with vb.io.opened(path, "a recording") as file:
        if "measured/contact_difference" not in file:
            return
    # Only the necessary variables are read, for speed.
    measured = ["contact_difference", "contact_point", "arc_length"]
    parts = vb.io.read_parts(path, {"/": ["arc_length"], "measured": measured})
    recording = xr.DataTree.from_dict(parts)
    for k, name in enumerate(recording.coords["whisker"].values):
        for sentence in compared_contacts(recording, k):
            yield str(name), sentence


def _table(path: Path) -> Iterator[tuple[str, str]]:
    """Describe a CSV file."""
    # Centrelines are tried last, as other tables have columns x, y and z too.
    readers: tuple[tuple[str, vb.io.Kind | None, Callable[[Path], Any]], ...] = (
        ("contacts", vb.io.Kind.CONTACTS, vb.io.load_contacts),
        ("signals", vb.io.Kind.SIGNALS, frames_from),
        ("the head's pose", vb.io.Kind.HEAD, vb.io.load_head),
        ("contact points", None, vb.io.load_contact_points),
        ("corrections", vb.io.Kind.CORRECTIONS, vb.io.load_corrections),
        ("whisker", vb.io.Kind.CENTERLINE, partial(vb.load_whisker, any_length=True)),
    )
    looks = vb.io.recognise(path)
    for kind, known, reader in readers:
        try:
            data = reader(path)
        except ValueError:
            # The error for the most similar kind of table is the most helpful one.
            if known == looks:
                raise
            continue
        yield "kind", f"table of {kind}" if kind != "whisker" else "centreline of a whisker"
        yield from _rows(kind, data)
        # The next verb would refuse a whisker of such a length.
        if kind != "whisker" or not vb.whisker.length_faults(data.length):
            yield from _follows(kind, path)
        return
    cells = next(vb.io.table_rows(vb.io.read_text(path)), (0, []))[1]
    columns = {re.split(r"[ _/(\[]", cell)[0] for cell in cells}
    used = [name for name in vb.signals.SIGNALS if name in columns]
    if len(used) >= 3:
        yield "kind", f"table of the signals {', '.join(used)}"
        yield "next", f"vibrissa {_NEXT['signals']}".format(f"{path} --using {','.join(used)}")
        return
    first = ", ".join(cells[:_SHOWN]) + (", …" if len(cells) > _SHOWN else "")
    header = f"its first line is {first}" if cells else "it has no lines"
    raise ValueError(f"{path} is not a table of a known kind: {header}. Known are\n{_TABLES}")


def _rows(kind: str, data: Any) -> Iterator[tuple[str, str]]:
    """Describe the rows of a table."""
    if kind == "whisker":
        yield "whisker", repr(data)
        base, tip = (data.pose.to_source(data.position(s)) * 1e3 for s in (0.0, data.length))
        for name, (x, y, z) in (("base", base), ("tip", tip)):
            yield name, f"at ({x:z.2f}, {y:z.2f}, {z:z.2f}) mm in the file"
        yield from (
            ("note", note) for note in (*data.notes, *vb.whisker.length_faults(data.length))
        )
    elif kind == "corrections":
        for view, each in data.items():
            yield f"view {view}", f"{len(each)} corrected traces"
    elif "frame" in data:
        first, last = data["frame"].values.min(), data["frame"].values.max()
        yield "rows", f"{data.sizes['frame']}, from frame {first} to {last}"
    else:
        time = np.asarray(data["time"])
        known = time[np.isfinite(time)]
        notes = data.attrs.get("notes", ())
        span = (
            f"from {known.min():.10g} to {known.max():.10g} s" if known.size else "at unknown times"
        )
        yield "rows", f"{time.size}" if vb.io.NUMBERED in notes else f"{time.size}, {span}"
        yield from (("note", note) for note in notes)
        if kind == "signals":
            sizes = {n: np.linalg.norm(data[n], axis=-1) for n in ("force", "moment")}
            most = [shown(n, float(np.nanmax(v, initial=0.0)), 3) for n, v in sizes.items()]
            yield "largest", f"force {most[0]}, moment {most[1]}"
        if kind == "contacts":
            for sentence, count in vb.status.describe(data["status"].values).most_common():
                yield str(count), sentence

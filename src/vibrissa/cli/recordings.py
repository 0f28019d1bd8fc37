"""What the verbs that add a stage to a recording share: reading, whiskers, maps, noise, writing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vibrissa.cli.terminal import Tell, errors, free, output

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import xarray as xr

    from vibrissa.contacts import ContactMap
    from vibrissa.numerics import Array
    from vibrissa.whisker import Whisker


def recording_from(path: Path) -> xr.DataTree:
    """Read a recording."""
    from vibrissa.io import load_recording
    from vibrissa.io.paths import check_readable
    from vibrissa.pipeline.frames import check_recording

    recording = load_recording(check_readable(path))
    try:
        check_recording(recording)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None
    return recording


def is_recording(path: Path) -> bool:
    """Tell whether a file holds a recording."""
    from vibrissa.io import is_netcdf, kind_of

    if not path.is_file() or path.stat().st_size == 0:
        return False
    return is_netcdf(path) and kind_of(path) == "vibrissa recording"


def whiskers_for(recording: xr.DataTree, path: Path | None) -> list[Whisker]:
    """Find the whisker of each that a recording has signals of."""
    from vibrissa.cli.sources import whisker_from
    from vibrissa.recording import Recording

    count = recording.sizes["whisker"]
    if path is not None:
        if count > 1:
            raise ValueError(f"--whisker is one whisker; the recording has {count}")
        return [whisker_from(path)]
    try:
        return Recording(recording).whiskers
    except ValueError as fault:
        raise ValueError(f"{fault}; give its centreline with --whisker") from None


def maps_from(charts: Sequence[Path], count: int, grid: bool = False) -> list[ContactMap]:
    """Read the map of each whisker."""
    from vibrissa.cli.sources import map_from

    if len(charts) != count:
        raise ValueError(f"there are {len(charts)} --map for {count} whiskers; each needs one")
    found = [map_from(chart) for chart in charts]
    for chart, contacts in zip(charts, found, strict=True):
        if grid and contacts.grid is None:
            raise ValueError(
                f"{chart} has no grid to look up in: make it by `vibrissa map` without --no-grid"
            )
    return found


def maps_of(
    whiskers: Sequence[Whisker], tell: Tell, grid: bool, proximal: float
) -> list[ContactMap]:
    """Simulate the map of each whisker, and say so."""
    from vibrissa.contacts import ContactMap

    maps = []
    for k, whisker in enumerate(whiskers):
        say(f"no map given; simulating that of {whisker!r}")
        tell("map of all contacts", k, len(whiskers))
        maps.append(ContactMap.simulate(whisker, grid=grid, proximal=proximal))
        tell("map of all contacts", k + 1, len(whiskers))
    return maps


def noise_from(
    path: Path | None, force_noise: float | None, moment_noise: float | None
) -> tuple[Array, str] | None:
    """Read the noise that is given on the command line."""
    import numpy as np

    from vibrissa.io.table import read_text, table_rows
    from vibrissa.pipeline import component_noise

    if path is None:
        if force_noise is None and moment_noise is None:
            return None
        force, moment = usual_noise(force_noise, moment_noise)
        covariance = component_noise(force * 1e-6, moment * 1e-6)
        return covariance, f"noise {force:g} µN and {moment:g} µN·m"
    try:
        rows = [[float(cell) for cell in cells] for _, cells in table_rows(read_text(path))]
        covariance = np.array(rows, dtype=np.float64)
    except ValueError as fault:
        raise ValueError(f"{path} is no covariance: {fault}") from None
    if covariance.shape != (6, 6):
        raise ValueError(f"{path} must hold six lines of six numbers; got {covariance.shape}")
    return covariance, f"noise of {path}"


def usual_noise(force_noise: float | None, moment_noise: float | None) -> tuple[float, float]:
    """Fill in the usual sensor's noise."""
    from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE

    return (
        FORCE_NOISE * 1e6 if force_noise is None else force_noise,
        MOMENT_NOISE * 1e6 if moment_noise is None else moment_noise,
    )


def say(line: str) -> None:
    """Print what is done by default, beside the results."""
    errors.print(line, highlight=False, soft_wrap=True)


def tell_statuses(codes: object) -> None:
    """Print how many frames have which status."""
    from vibrissa.status import describe

    for sentence, count in describe(codes).most_common():  # type: ignore[arg-type]
        output.print(f"{count:6d}  {sentence}", highlight=False, soft_wrap=True)


def free_beside(recording: Path, files: Iterable[Path], force: bool) -> None:
    """Raise if files are there that nobody said to replace; a recording is added to."""
    free([file for file in files if not _same(file, recording)], force)


def _same(path: Path, other: Path) -> bool:
    return path.resolve() == other.resolve()


def tell_written(path: Path, recording: Path | None = None, stage: str = "") -> None:
    """Print that a file is there, or that a recording has a stage more."""
    added = recording is not None and _same(path, recording)
    said = f"added {stage} to {path}" if added else f"wrote {path}"
    output.print(said, highlight=False, soft_wrap=True)

"""What the verbs that add a stage to a recording share: reading, whiskers, maps, noise, writing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vibrissa.cli.terminal import Tell, errors, free, output

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import xarray as xr

    from vibrissa.mapping import ContactMap
    from vibrissa.rod.arrays import Array
    from vibrissa.whisker import Whisker


def recording_from(path: Path) -> xr.DataTree:
    """Read a recording.

    Parameters
    ----------
    path : Path
        NetCDF.

    Returns
    -------
    DataTree
        The recording.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no recording, or has neither frames nor whiskers.
    """
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
    """Tell whether a file holds a recording.

    Parameters
    ----------
    path : Path
        Any.

    Returns
    -------
    bool
        False too if there is no such file.
    """
    from vibrissa.io import is_netcdf, kind_of

    if not path.is_file() or path.stat().st_size == 0:
        return False
    return is_netcdf(path) and kind_of(path) == "vibrissa recording"


def whiskers_for(recording: xr.DataTree, path: Path | None) -> list[Whisker]:
    """Find the whisker of each that a recording has signals of.

    Parameters
    ----------
    recording : DataTree
        The recording.
    path : Path or None
        A file with the one whisker, where the recording does not carry it or another is wanted.

    Returns
    -------
    list of Whisker
        Along the dimension ``whisker``.

    Raises
    ------
    ValueError
        If the recording does not carry them, or one is given for several.
    """
    from vibrissa.cli.sources import whisker_from
    from vibrissa.trial import recorded_whisker

    count = recording.sizes["whisker"]
    if path is not None:
        if count > 1:
            raise ValueError(f"--whisker is one whisker; the recording has {count}")
        return [whisker_from(path)]
    try:
        return [recorded_whisker(recording, k) for k in range(count)]
    except ValueError as fault:
        raise ValueError(f"{fault}; give its centreline with --whisker") from None


def maps_from(charts: Sequence[Path], count: int, grid: bool = False) -> list[ContactMap]:
    """Read the map of each whisker.

    Parameters
    ----------
    charts : sequence of Path
        Their files.
    count : int
        How many whiskers there are.
    grid : bool
        Whether the paper's grid is needed.

    Returns
    -------
    list of ContactMap
        One for each.

    Raises
    ------
    ValueError
        If there are not as many, or the grid is missing.
    """
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
    """Simulate the map of each whisker, and say so.

    Parameters
    ----------
    whiskers : sequence of Whisker
        Whose.
    tell : callable
        Of progress.
    grid : bool
        Whether the paper's grid is needed.
    proximal : float
        Smallest arc length of a contact, share of the length.

    Returns
    -------
    list of ContactMap
        One for each.
    """
    from vibrissa.mapping import ContactMap

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
    """Read the noise that is given on the command line.

    Parameters
    ----------
    path : Path or None
        Covariance of force and moment, six lines of six numbers, SI units.
    force_noise, moment_noise : float or None
        Standard deviation of a component, µN and µN·m; that of the usual sensor where only the
        other is given.

    Returns
    -------
    tuple or None
        Covariance of (F, M), SI units, and how it was given; None if it was not.

    Raises
    ------
    ValueError
        If the file is no covariance.
    """
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
    """Fill in the usual sensor's noise.

    Parameters
    ----------
    force_noise, moment_noise : float or None
        As given, µN and µN·m.

    Returns
    -------
    tuple of float
        The same, with the usual where nothing is given.
    """
    from vibrissa.sensing import FORCE_NOISE, MOMENT_NOISE

    return (
        FORCE_NOISE * 1e6 if force_noise is None else force_noise,
        MOMENT_NOISE * 1e6 if moment_noise is None else moment_noise,
    )


def say(line: str) -> None:
    """Print what is done by default, beside the results.

    Parameters
    ----------
    line : str
        One line.
    """
    errors.print(line, highlight=False, soft_wrap=True)


def tell_statuses(codes: object) -> None:
    """Print how many frames have which status.

    Parameters
    ----------
    codes : array_like of int
        Statuses.
    """
    from vibrissa.status import describe

    for sentence, count in describe(codes).most_common():  # type: ignore[arg-type]
        output.print(f"{count:6d}  {sentence}", highlight=False, soft_wrap=True)


def free_beside(recording: Path, files: Iterable[Path], force: bool) -> None:
    """Raise if files are there that nobody said to replace; a recording is added to.

    Parameters
    ----------
    recording : Path
        To which a stage may be added where it is.
    files : iterable of Path
        To be written.
    force : bool
        Whether others may be replaced.

    Raises
    ------
    FileExistsError
        If there is one.
    """
    free([file for file in files if not _same(file, recording)], force)


def _same(path: Path, other: Path) -> bool:
    return path.resolve() == other.resolve()


def tell_written(path: Path, recording: Path | None = None, stage: str = "") -> None:
    """Print that a file is there, or that a recording has a stage more.

    Parameters
    ----------
    path : Path
        Which.
    recording : Path, optional
        What was read.
    stage : str
        What was added to it.
    """
    added = recording is not None and _same(path, recording)
    said = f"added {stage} to {path}" if added else f"wrote {path}"
    output.print(said, highlight=False, soft_wrap=True)

"""Where a page comes from: command, files, versions, seed and date."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from vibrissa._version import __version__
from vibrissa.report.page import Section, table

_PACKAGES = ("numpy", "scipy", "numba", "xarray", "h5netcdf", "matplotlib", "av", "plotly")
_BLOCK = 1 << 20
_EPOCH = "SOURCE_DATE_EPOCH"


@dataclass(frozen=True)
class Provenance:
    """What has to be known to make a page again.

    Parameters
    ----------
    command : str
        As it would be typed.
    inputs : tuple of (str, int, str)
        Name of each file that was read, its size in bytes, and its SHA-256 in hexadecimal.
    versions : tuple of (str, str)
        Of the package, of Python and of libraries.
    seed : int or None
        Of the draws behind what is predicted; None where nothing is drawn.
    date : datetime
        With a time zone.
    """

    command: str
    inputs: tuple[tuple[str, int, str], ...]
    versions: tuple[tuple[str, str], ...]
    seed: int | None
    date: datetime


def provenance(command: Sequence[str], inputs: Sequence[Path], seed: int | None) -> Provenance:
    """Gather it now.

    The date is that of the environment variable ``SOURCE_DATE_EPOCH``, seconds since 1970 in UTC,
    if it is set; then the same command gives the same page.
    """
    files = tuple((str(path), path.stat().st_size, sha256(path)) for path in inputs)
    return Provenance(shlex.join(command), files, tuple(_versions()), seed, _date())


def sha256(path: Path) -> str:
    """SHA-256 of a file's content."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            found.update(block)
    return found.hexdigest()


def _versions() -> list[tuple[str, str]]:
    rows = [
        ("vibrissa", __version__),
        ("Python", f"{platform.python_version()}, {platform.system()} {platform.machine()}"),
    ]
    for name in _PACKAGES:
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            rows.append((name, "not installed"))
    return rows


def _date() -> datetime:
    seconds = os.environ.get(_EPOCH)
    if seconds is None:
        return datetime.now(UTC)
    try:
        return datetime.fromtimestamp(int(seconds), UTC)
    except (ValueError, OverflowError, OSError) as fault:
        raise ValueError(
            f"{_EPOCH} is {seconds!r}; whole seconds since 1970 are needed, as of `date +%s`"
        ) from fault


def provenance_section(known: Provenance) -> Section:
    """Show where a page comes from."""
    rows = [
        ("command", known.command),
        ("made", known.date.strftime("%Y-%m-%d %H:%M:%S UTC")),
        (
            "seed",
            "none: no random numbers are used"
            if known.seed is None
            else f"{known.seed}, for the predicted errors",
        ),
    ]
    files = [
        (name, f"{size / 1e6:.3f} MB", f"SHA-256 {digest}") for name, size, digest in known.inputs
    ]
    body = table(rows) + table(files, caption="Files that were read")
    return Section("provenance", "Provenance", body + table(known.versions, caption="Versions"))

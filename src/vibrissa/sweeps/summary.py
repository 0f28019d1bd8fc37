"""What came out of a study, in a few lines."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

_MM = 1e3


def sweep_summary(found: xr.Dataset) -> str:
    """Say how far a study is, and what it found.

    Parameters
    ----------
    found : Dataset
        Of `open_sweep`.

    Returns
    -------
    str
        Lines of text: which versions computed; by task, how many cells are done; by group of
        whiskers and triplet, for how many it is unique, with the median and the largest critical
        cone; and the medians of errors.
    """
    return "\n".join(_lines(found))


def _lines(found: xr.Dataset) -> Iterator[str]:
    yield f"study {found.attrs.get('study', '')!r}: {found.sizes['whisker']} whiskers"
    for number, origin in enumerate(np.atleast_1d(found.attrs["origins"])):
        yield f"  {int((found['origin'] == number).sum())} cells by {origin}"
    for task in found["task"].values:
        status = found["status"].sel(task=task).values
        counts = [int((status == code).sum()) for code in (1, 2, 0)]
        seconds = float(np.nansum(found["seconds"].sel(task=task).values))
        spoilt = int((status == 3).sum())
        again = f", {spoilt} damaged (`vibrissa sweep` does them again)" if spoilt else ""
        yield "  {}: {} done, {} failed, {} to do{}; {:.0f} s of CPU".format(
            task, *counts, again, seconds
        )
    groups = list(dict.fromkeys(map(str, found["group"].values)))
    for task in map(str, found["task"].values):
        for group in groups:
            rows = found.isel(whisker=found["group"].values == group)
            yield from _verdicts(rows, task, group)
            yield from _errors(rows, task, group)


def _verdicts(rows: xr.Dataset, task: str, group: str) -> Iterator[str]:
    name = f"{task}_verdict"
    if name not in rows or not (rows[name] != "").any():
        return
    yield f"{task}, {group}: unique | off a surface | not; critical cone: median, largest"
    verdict, cone = rows[name], rows[f"{task}_critical_cone"]
    _, first, second = verdict.dims
    for a in rows[first].values:
        for b in rows[second].values:
            at = {first: a, second: b}
            words = verdict.sel(at).values
            counts = [
                int((words == one).sum())
                for one in ("unique", "unique off a surface", "not unique")
            ]
            degrees = np.degrees(cone.sel(at).values[words != ""])
            if degrees.size:
                label = str(a) if rows.sizes[second] == 1 else f"{a}, {b}"
                middle, high = np.nanmedian(degrees), np.nanmax(degrees)
                tally = "{:4d} | {:4d} | {:4d}".format(*counts)
                yield f"  {label:10s} {tally};  {middle:5.2f}°, {high:5.2f}°"


def _errors(rows: xr.Dataset, task: str, group: str) -> Iterator[str]:
    name = f"{task}_median_error"
    if name not in rows or not np.isfinite(rows[name].values).any():
        return
    yield f"{task}, {group}: error of the contact point, mm: median of whiskers, largest"
    error = rows[name]
    dim = error.dims[1]
    for label in rows[dim].values:
        values = error.sel({dim: label}).values * _MM
        if np.isfinite(values).any():
            yield f"  {label!s:10s} {np.nanmedian(values):.3g}, {np.nanmax(values):.3g}"

"""Which whiskers of a recording touched, and what tracking found without knowing the truth."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.quantities import quantity
from vibrissa.recording import Recording
from vibrissa.report.page import paragraph, table
from vibrissa.report.values import shown_value


def whiskers_table(recording: xr.DataTree, chosen: int) -> str:
    """Tell which whiskers touched for how long, and how strongly."""
    names = [str(name) for name in recording.coords["whisker"].values]
    touching = contacts_by_whisker(recording)
    force = Recording(recording).root.get("force")
    rows = []
    for k in np.flatnonzero(touching):
        largest = np.nan
        if force is not None:
            size = np.linalg.norm(force[:, k], axis=1)
            largest = float(np.max(size, initial=0.0, where=np.isfinite(size)))
        rows.append((names[k], str(k), str(touching[k]), shown_value("force", largest)))
    told = paragraph(
        f"Signals and estimated contacts below are of whisker {names[chosen]}, number {chosen}; "
        "`--which` chooses another. The contour is of all."
    )
    if not rows:
        return told + paragraph(f"None of the {len(names)} whiskers is known to touch anything.")
    heading = ("whisker", "number", "frames in contact", "largest force")
    note = f"{len(names) - len(rows)} others are not known to touch anything."
    return told + table(rows, heading, "Whiskers that touch", note)


def contacts_by_whisker(recording: xr.DataTree) -> NDArray[np.int64]:
    """Count frames in contact by what tells of it first: estimates, signals, tracking, truth.

    Parameters
    ----------
    recording : DataTree
        A trial.

    Returns
    -------
    array (whiskers,) of int
        Frames; zero where nothing tells.
    """
    trial = Recording(recording)
    for group in map(trial.find, ("estimates", "signals", "", "truth")):
        if group is not None and "in_contact" in group:
            return np.asarray(group["in_contact"].sum(axis=0), dtype=np.int64)
    return np.zeros(recording.sizes["whisker"], dtype=np.int64)


def tracked_table(root: xr.Dataset) -> str:
    """Tell what tracking found, and how well by its own account."""
    touching = root["in_contact"].values.astype(bool)
    rows = [
        ("frames", str(touching.size)),
        ("of these in contact", str(int(touching.sum()))),
        ("lost", str(int((~np.isfinite(root["base_position"].values)).any(axis=-1).sum()))),
    ]
    for name in ("force", "moment"):
        size = np.linalg.norm(root[name].values, axis=-1)[touching] if name in root else []
        if np.isfinite(size).any():
            middle, largest = float(np.nanmedian(size)), float(np.nanmax(size))
            told = f"{shown_value(name, middle)}, up to {shown_value(name, largest)}"
            rows.append((f"{quantity(name).long_name}, in contact", told))
    if "contact_covariance" in root:
        covariance = root["contact_covariance"].values[touching]
        sigma = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        if np.isfinite(sigma).any():
            told = shown_value("contact_point", float(np.nanmedian(sigma)), 3)
            rows.append(("standard deviation of the contact point", f"{told}, median, in space"))
    return table(rows, caption="By the rod that fits the images")

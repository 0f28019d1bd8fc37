"""Contact events of a recording: onset, loss and slip, by `vibrissa.contacts.ContactEvents`.

If contact is detected from the sensor's readings, these also give the onset time. Otherwise the
onset is the first frame of a contact, without a standard deviation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contacts import SLIPPING, ContactEvents, Place, in_order
from vibrissa.numerics import Array, contacts_in
from vibrissa.quantities import attributes
from vibrissa.status import Event, Status, flag_attributes

# Variables that `with_events` adds.
EVENTS = ("event", "onset_time", "onset_sigma")

_UNIQUE = (Status.OK, Status.UNIQUE)


def with_events(
    located: xr.Dataset, point: str, covariance: str, pose: tuple[Array, Array] | None = None
) -> xr.Dataset:
    """Add onset, loss and slip to the contacts of one whisker.

    Parameters
    ----------
    located : xarray.Dataset
        Result of `locate`, or the same in the laboratory.
    point, covariance : str
        Names of the variables with the contact point, preferably in the laboratory frame, and its
        covariance.
    pose : tuple, optional
        Rotations (n, 3, 3) and positions (n, 3) of the base, if the point is in the laboratory
        frame.

    Returns
    -------
    xarray.Dataset
        Copy of ``located`` with the variables `EVENTS`. A contact that includes the first frame has
        no onset; slips are detected only where covariances are known.
    """
    time, touching = located["time"].values, located["in_contact"].values
    known = located["status"].values != Status.MISSING
    events = ContactEvents(SLIPPING * float(located.attrs["length"]))
    points, spreads = located[point].values, located[covariance].values
    unique = np.isin(located["status"].values, _UNIQUE) & np.isfinite(spreads).all(axis=(1, 2))
    readings, valid = located["excess"].values, located["covariance_valid"].values
    happened, onsets = [], []
    for i, moment in enumerate(time.tolist()):
        held = () if pose is None else (pose[0][i], pose[1][i])
        place = Place(points[i], spreads[i], bool(valid[i]), *held) if unique[i] else None
        on = bool(touching[i]) if known[i] else None
        happened.append(events(moment, on, readings[i], place))
        onsets.append(events.onset)
    if known.any() and touching[first := int(known.argmax())]:
        happened[first] = Event.NONE
    codes, begun = in_order(time, happened, onsets)
    values = (codes.astype(np.int8), begun[:, 0], begun[:, 1])
    about = {"event": flag_attributes(Event)}
    return located.assign(
        {
            name: ("time", each, {**attributes(name), **about.get(name, {})})
            for name, each in zip(EVENTS, values, strict=True)
        }
    )


def contact_events(contacts: xr.Dataset) -> xr.Dataset:
    """List contacts with their onset and release.

    Parameters
    ----------
    contacts : xarray.Dataset
        Group ``estimates`` or ``signals`` of a recording, as returned by `estimates_of` or
        `signals_of`. Inertia does not cause spurious contacts in signals made with ``dynamics``.

    Returns
    -------
    xarray.Dataset
        Dataset with the dimension ``contact``, in order of time: name of the ``whisker``, ``onset``
        and ``release``, s, NaN where the recording begins or ends in contact, and
        ``largest_force``, N. For estimates also ``onset_sigma``, s, and the number of ``slips``.
    """
    time, rows = contacts["time"].values, []
    dated = all(name in contacts for name in EVENTS)
    for k, name in enumerate(contacts["whisker"].values):
        one = contacts.isel(whisker=k)
        size = np.linalg.norm(one["force"].values, axis=-1)
        seen = one["status"].values != Status.MISSING if "status" in one else None
        for first, end in contacts_in(one["in_contact"].values.astype(bool), seen):
            onset = time[first] if first else np.nan
            release = time[end] if end < len(time) else np.nan
            row = [first, str(name), onset, release, _largest(size[first:end])]
            if dated:
                inside = one.isel(time=slice(first, end))
                begun = inside["onset_time"].values[-1]
                row[2] = begun if first and np.isfinite(begun) else onset
                row += [inside["onset_sigma"].values[-1]]
                row += [int((inside["event"].values == Event.SLIP).sum())]
            rows.append(tuple(row))
    rows.sort()
    names = ("onset", "release", "largest_force", *(("onset_sigma", "slips") if dated else ()))
    columns: list[Any] = list(zip(*(row[1:] for row in rows), strict=True)) or [()] * 6
    data: dict[str, Any] = {"whisker": ("contact", list(columns[0]))}
    for name, values in zip(names, columns[1 : len(names) + 1], strict=True):
        data[name] = ("contact", np.array(values), attributes(name))
    return xr.Dataset(data)


def _largest(sizes: Any) -> float:
    """Largest finite value; NaN if there is none."""
    return float(np.nanmax(sizes)) if np.isfinite(sizes).any() else np.nan

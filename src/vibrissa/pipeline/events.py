"""Contacts of one whisker over time: onsets, losses and slips, and columns of a table."""

from __future__ import annotations

import numpy as np

from vibrissa.contacts import SLIPPING, ContactEvents, Place, in_order
from vibrissa.numerics import AnyArray, Array
from vibrissa.pipeline.frames import Labelled
from vibrissa.quantities import attributes
from vibrissa.signals import spherical
from vibrissa.status import Event, Status, flag_attributes

EVENTS = ("event", "onset_time", "onset_sigma")  # variables that `with_events` adds
_UNIQUE = (Status.OK, Status.UNIQUE)
_AROUND = ("arc_length", "last_arc_length", "shift_x", "shift_y", "shift_z")


def contact_columns(contacts: Labelled) -> dict[str, AnyArray]:
    """Columns of a table of contacts, whisker frame."""
    point = np.asarray(contacts["contact_point_whisker"])
    variance = np.einsum("tii->ti", np.asarray(contacts["covariance"]))
    values = np.concatenate([point, spherical(point), np.sqrt(variance)], axis=1)
    names = ("x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
    columns: dict[str, AnyArray] = dict(zip(names, values.T, strict=True))
    columns["friction"] = np.full(len(values), contacts.attrs["friction"])
    if "event" not in contacts:
        contacts = with_events(contacts, "contact_point_whisker", "covariance")
    kept = ("time", "one_contact", "status", *EVENTS, *(_AROUND if "shift_x" in contacts else ()))
    return columns | {name: np.asarray(contacts[name]) for name in kept if name in contacts}


def with_events(
    located: Labelled, point: str, covariance: str, pose: tuple[Array, Array] | None = None
) -> Labelled:
    """Add onset, loss and slip (variables `EVENTS`) to the contacts of one whisker from `locate`.

    ``point`` and ``covariance`` name the variables with the contact point and its covariance;
    ``pose`` are the rotations (n, 3, 3) and positions (n, 3) of the base if the point is in the
    laboratory frame. A contact that includes the first frame has no onset, and slips are detected
    only where covariances are known. If contact is detected from the sensor's readings, these also
    give the onset time; otherwise it is that of the first frame, without a standard deviation.
    """
    names = ("time", "in_contact", "status", point, covariance, "excess", "covariance_valid")
    read = (np.asarray(located[name]) for name in names)
    time, touching, status, points, spreads, readings, valid = read
    known = status != Status.MISSING
    events = ContactEvents(SLIPPING * float(located.attrs["length"]))
    unique = np.isin(status, _UNIQUE) & np.isfinite(spreads).all(axis=(1, 2))
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

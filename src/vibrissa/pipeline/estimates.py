"""Contact points of every frame and whisker from the signals of a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contacts import ContactMap, Prior
from vibrissa.pipeline.frames import signals_in
from vibrissa.pipeline.laboratory import in_laboratory
from vibrissa.pipeline.locate import TRIPLET, locate, locate_from_wrench, unfelt
from vibrissa.pipeline.signals import sensor_noise
from vibrissa.recording import Group, Recording
from vibrissa.rod import PROXIMAL
from vibrissa.signals import selection
from vibrissa.status import is_ok
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how much of how much is."""

WHOLE = "wrench"
"""Instead of names of signals: force and moment whole."""

_KEPT = (
    "contact_point",
    "contact_covariance",
    "contact_normal",
    "normal_covariance",
    "point_normal_covariance",
    "contact_point_whisker",
    "covariance",
    "arc_length",
    "force",
    "friction_angle",
    "candidates",
    "in_contact",
    "status",
)


def estimates_of(
    recording: xr.DataTree,
    signals: str | Sequence[str] | None = None,
    *,
    noise: ArrayLike | None = None,
    contact_maps: Sequence[ContactMap] | None = None,
    whiskers: Sequence[Whisker] | None = None,
    method: str = "exact",
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
    proximal: float = PROXIMAL,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Estimate the contact point in every frame in which a contact is felt.

    Parameters
    ----------
    recording : xarray.DataTree
        With a group ``signals``; see `signals_of`.
    signals : str or sequence of str, optional
        Three or more of the six, or "wrench": force and moment whole, which allows for friction. By
        default `TRIPLET`, but of the rod "wrench", as its wrench has some friction in it.
    noise : array_like (6, 6), optional
        Covariance of (F, M), SI units; by default what the signals say of themselves. Signals of a
        sensor have to have one or the other; without any there are no covariances.
    contact_maps : sequence of ContactMap, optional
        One for each whisker; by default simulated for those that feel a contact.
    whiskers : sequence of Whisker, optional
        One for each, where there are no maps; by default those of the recording.
    method : {"exact", "lookup", "lookup-linear", "network"}
        Exact, or one of the paper's methods, as of :func:`vibrissa.paper.estimate`.
    errors : mapping of str to float, optional
        ``stiffness_sigma``, ``gain_sigma`` and ``mixing_sigma``, as of ``ContactMap.estimate``:
        the same errors in all frames. They need noise.
    prior : Prior, optional
        Which contacts are possible; others are left out of the candidates.
    proximal : float
        Smallest arc length of a contact of maps that are simulated, share of the length.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.Dataset
        Dims time, whisker, space, the group ``estimates`` of a recording. In the laboratory
        ``contact_point`` with ``contact_covariance``, ``contact_normal`` with
        ``normal_covariance``, and ``point_normal_covariance``; in the whisker's frame
        ``contact_point_whisker`` with ``covariance``, ``arc_length`` and ``force``; how many
        ``candidates`` there were, of which the one that goes on from the frames around is taken;
        ``in_contact`` (felt) and ``status``. Attributes ``signals``, ``source`` and ``felt_above``,
        M_B from which contacts are felt, N·m. Frames whose signals have no answer keep the status
        that says why.

    Raises
    ------
    ValueError
        If there are no signals, their noise is not known, or names or numbers do not fit.

    Notes
    -----
    Covariances come from the noise of the signals and from that of the base's pose: of signals of
    the rod and of the tracked contact point both, with what they have in common; of a sensor's the
    pose's where a camera tells it (`placed_by`). So an error of the pose does not move a contact
    point that was tracked, as the same pose leads there and back, but it turns the normal.
    """
    data = signals_in(recording)
    if signals is None:
        signals = WHOLE if data.attrs.get("source") == "rod" else TRIPLET
    whole = signals == WHOLE
    names = TRIPLET if whole else selection(signals)
    count = data.sizes["whisker"]
    tell = progress or _silent
    if whiskers is None:
        if contact_maps is not None:
            whiskers = [one.whisker for one in contact_maps]
        else:
            whiskers = Recording(recording).whiskers
    for given in (whiskers, contact_maps):
        if given is not None and len(given) != count:
            raise ValueError(f"there are signals of {count} whiskers; {len(given)} are given")
    if noise is None and data.attrs.get("source") == "sensor" and sensor_noise(data) is None:
        raise ValueError("the sensor's noise is not known: give the covariance of (F, M) as noise")
    parts = []
    for k, whisker in enumerate(whiskers):
        tell("contact points", k, count)
        one = Group(data).whisker(k).data
        sigma = sensor_noise(one) if noise is None else np.asarray(noise, dtype=np.float64)
        wrench = one[["force", "moment"]]
        if data.attrs.get("source") != "sensor":
            wrench = wrench.assign(in_contact=one["in_contact"])
        found = None if whole else unfelt(whisker, wrench, names, noise=sigma)
        if whole:
            found = locate_from_wrench(whisker, wrench, sigma, errors, prior)
        elif found is None:
            if contact_maps is not None:
                contact_map = contact_maps[k]
            else:
                tell("map of all contacts", k, count)
                grid = method.startswith("lookup")
                contact_map = ContactMap.simulate(whisker, grid=grid, proximal=proximal)
                tell("map of all contacts", k + 1, count)
            found = locate(
                contact_map, wrench, names, noise=sigma, method=method, errors=errors, prior=prior
            )
        parts.append(_placed(one, found, given=noise is not None))
        tell("contact points", k + 1, count)
    out = xr.concat(parts, "whisker").transpose("time", "whisker", ...)
    about: dict[str, Any] = {
        "signals": WHOLE if whole else " ".join(names),
        "source": str(data.attrs.get("source", "not known")),
        "felt_above": float(np.median([part.attrs["felt_above"] for part in parts])),
    }
    if method != "exact":
        about["method"] = method
    about |= errors or {}
    if prior is not None:
        about["prior"] = repr(prior)
    out.attrs = about
    return out.assign_coords({n: data[n].variable for n in ("time", "whisker", "space")})


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _placed(signals: xr.Dataset, found: xr.Dataset, *, given: bool) -> xr.Dataset:
    """Contacts of one whisker in the laboratory, with what became of frames without signals."""
    known = Group(signals)
    names = ("pose_covariance", "pose_wrench_covariance")
    pose = {name: known[name] for name in names if name in known}
    if given:
        # The noise given is that of another instrument.
        pose.pop("pose_wrench_covariance", None)
    placed = in_laboratory(found, known["base_rotation"], known["base_position"], **pose)
    said = signals["status"].values
    status = np.where(is_ok(said), placed["status"].values, said).astype(np.int8)
    placed["status"] = placed["status"].copy(data=status)
    return placed[[name for name in _KEPT if name in placed]]

"""The truth of a trial together with its tracks, and what its scores do not test."""

from __future__ import annotations

import xarray as xr

from vibrissa.recording import Group, Recording
from vibrissa.whisker import Whisker

_POSE = ("base_position", "base_rotation")

_CIRCULAR = (
    "The model computes signals for the contact that was tracked, and inverts them: this tests "
    "tracking and inversion, not what a whisker measures."
)


def with_truth(tracked: xr.DataTree, simulated: xr.DataTree) -> xr.DataTree:
    """Tracked recording with the truth of its simulated trial."""
    groups = {group.path: group.to_dataset(inherit=False) for group in tracked.subtree}
    for group in simulated.subtree:
        if group.path.startswith(("/truth", "/objects")):
            # The curves of the truth have nodes of their own.
            data = group.to_dataset(inherit=False)
            groups[group.path] = data.rename(node="true_node") if "node" in data.dims else data
        elif group.path.startswith("/whiskers"):
            groups[f"/truth{group.path}"] = group.to_dataset(inherit=False)
    root = simulated.to_dataset()
    groups["/truth"] = groups["/truth"].assign({name: root[name].variable for name in _POSE})
    return xr.DataTree.from_dict(groups)


def truth_of(recording: xr.DataTree, whisker: int = 0) -> tuple[xr.Dataset, Whisker]:
    """Truth of one whisker.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording with a group ``truth``, simulated or of `with_truth`.
    whisker : int
        Number of the whisker along the dimension ``whisker``.

    Returns
    -------
    truth : xarray.Dataset
        Truth, dimension time, with the base's true ``base_position`` and ``base_rotation`` unless
        they are not known.
    whisker : Whisker
        True whisker; the tracked one where nothing else is known.
    """
    group = recording.children["truth"]
    truth = group.to_dataset()
    if "measured" not in recording.children:
        root = recording.to_dataset()
        truth = truth.assign({n: root[n] for n in _POSE if n in root and n not in truth})
    known = group if "whiskers" in group.children else recording
    return Group(truth).whisker(whisker).data, Recording(known).whisker(whisker)


def caution(source: object) -> str | None:
    """What errors of contacts do not test, by the source of their signals."""
    return _CIRCULAR if source in ("contact point", "rod") else None

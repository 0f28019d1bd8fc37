"""What `vibrissa track` says of what it found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vibrissa.cli.terminal import output, shown

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import xarray as xr

    from vibrissa.tracking import Start

_POOR = 2.0


def tell_lengths(videos: Sequence[Path], traces: Sequence[Sequence[Any]], used: int) -> None:
    """Say so where videos differ in length."""
    frames = [len(view[0]) for view in traces]
    if len(set(frames)) > 1:
        listed = ", ".join(f"{path} {n}" for path, n in zip(videos, frames, strict=True))
        output.print(
            f"the videos differ in frames ({listed}); {used} of each are used: if the cameras did "
            "not start together or dropped frames, track with --offset auto",
            highlight=False,
            soft_wrap=True,
        )


def tell_start(start: Start, names: Sequence[str], picture: Path) -> None:
    """Say what is taken for the whisker."""
    bases = start.bases or []
    places = " and ".join(
        f"{column:.0f},{row:.0f} ({name})" for name, (column, row) in zip(names, bases, strict=True)
    )
    output.print(
        f"the whisker is taken to begin at {places}, as in {start.agreed[0]} of {start.agreed[1]} "
        f"frames, with confidence {start.confidence:.2f}: see {picture}",
        highlight=False,
        soft_wrap=True,
    )
    if start.doubts:
        output.print(
            f"not sure: {'; '.join(start.doubts)}. If it is not the whisker, say where that leaves "
            f"the face, once for each view: {' '.join('--base X,Y' for _ in names)}",
            highlight=False,
            soft_wrap=True,
        )


def tell_recording(result: xr.DataTree, path: Path) -> None:
    """Say what was tracked of each whisker."""
    import numpy as np

    from vibrissa.cli.sources import tell_notes
    from vibrissa.recording import Group, Recording

    data = result.to_dataset()
    for k, name in enumerate(data["whisker"].values):
        one = Group(data).whisker(k).data
        lost = int((one["confidence"] == 0.0).sum())
        length = Recording(result).whisker(k).length
        touching = int(np.nansum(one["in_contact"].values))
        line = (
            f"{name}: {shown('length', length)} long, in contact in {touching} of "
            f"{one.sizes['time']} frames, lost in {lost}, misfit of the traces "
            f"{float(one['trace_misfit'].median()):.2f} of their standard deviation"
        )
        output.print(line, highlight=False, soft_wrap=True)
        if float(one["trace_misfit"].median()) > _POOR:
            output.print(
                "  The bent rod does not explain the traces: perhaps too few frames are free of "
                "contact, or the traces are wrong; see trace_misfit and deviation.",
                highlight=False,
                soft_wrap=True,
            )
        for line in compared_contacts(result, k):
            output.print(f"  {line}", highlight=False, soft_wrap=True)
    tell_notes(*(Recording(result).whisker(k) for k in range(data.sizes["whisker"])))
    for line in result.attrs.get("remarks", "").splitlines():
        output.print(f"note: {line}", highlight=False, soft_wrap=True)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def compared_contacts(recording: xr.DataTree, whisker: int) -> Iterator[str]:
    """Say how contact points found otherwise compare with those of the rod."""
    import numpy as np

    from vibrissa.recording import Recording

    trial = Recording(recording)
    measured = trial.find("measured")
    if measured is None or "contact_difference" not in measured:
        return
    one = measured.whisker(whisker)
    away = one["contact_difference"]
    along = one["arc_length"] - trial.root.whisker(whisker)["arc_length"]
    both = np.isfinite(away) & np.isfinite(along)
    found = int(np.isfinite(one["contact_point"]).all(axis=-1).sum())
    source = one.data["contact_point"].attrs["source"]
    if not both.any():
        yield f"contact point ({source}): in {found} frames, in none of them has the rod one"
        return
    half, most = np.percentile(away[both], [50.0, 95.0])
    yield (
        f"contact point ({source}): in {found} frames; in {int(both.sum())} the rod has one too, "
        f"{shown('contact_difference', half, 3)} away (median; 95 % within "
        f"{shown('contact_difference', most, 3)}), "
        f"{shown('contact_difference', float(np.median(along[both])), 3)} farther out along the "
        "whisker"
    )

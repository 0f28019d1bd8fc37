"""`vibrissa export`: export of a trial as a table of predictors."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli.inputs import recording_from
from vibrissa.cli.options import check_new, refuse, with_options
from vibrissa.cli.terminal import remark, say


@with_options("the table of one recording, by default next to it: NAME.csv, NAME.nwb or NAME.mat")
def export(
    recordings: list[Path],
    to: Literal["csv", "nwb", "mat"] = "csv",
    target: Path | None = None,
    session_start: str | None = None,
    subject: str | None = None,
    species: str | None = None,
    force: bool = False,
) -> None:
    """Write a table by frame and whisker: forces, angles, their rates, contacts.

    The table contains force and moment, the six signals, the pose of the base, rates of change,
    contact points and flags, in SI units; the file describes every column. Missing signals are
    computed first, as by `vibrissa signals`. NWB files also contain the tracked whisker.
    For several recordings, each table is written next to its recording.
    Example: `vibrissa export trial.nc --to nwb --session-start 2026-03-01T14:30+01:00`
    """
    ending = f".{to}"
    if to != "nwb":
        about = {"--session-start": session_start, "--subject": subject, "--species": species}
        refuse(about, "only NWB files contain it")
    if len(recordings) > 1:
        refuse({"--output": target}, "each table is written next to its recording")
        refuse({"--session-start": session_start}, "recordings did not begin at the same time")
    recordings = [vb.io.check_readable(one) for one in recordings]
    targets = [one.with_suffix(ending) if target is None else target for one in recordings]
    for path in targets:
        check_new(path, (ending,), force)
    animal = {"subject_id": subject, "species": species}
    stated = {name: value for name, value in animal.items() if value is not None}
    for recording, path in zip(recordings, targets, strict=True):
        _export(recording, path, stated, session_start)


def _export(recording: Path, target: Path, subject: dict[str, Any], start: str | None) -> None:
    """Write the table of one recording."""
    tree = recording_from(recording)
    if "signals" not in tree.children:
        remark("the recording has no signals yet: they are computed as by `vibrissa signals`")
        with vb.io.in_file(recording):
            tree = vb.pipeline.with_signals(tree)
    table = vb.pipeline.predictors(tree)
    if target.suffix == ".nwb":
        session = vb.io.Session(_start(start, recording), subject=subject)
        vb.io.save_nwb(target, tree, session, predictors=table)
    else:
        vb.io.save_predictors(target, table)
    touching = int(table["in_contact"].sum()) if "in_contact" in table else 0
    count, duration = table.sizes["whisker"], float(np.ptp(table["time"].values))
    say(
        f"{table.sizes['time']} frames in {duration:g} s of {count} whisker{'s' * (count > 1)}, "
        f"{touching} in contact; {len(table)} columns, {len(table.attrs['predictors'].split())} of "
        "them predictors of models of spikes"
    )
    say(f"wrote {target}")


def _start(text: str | None, recording: Path) -> datetime:
    """Start time of the session; by default the time at which the file was written."""
    if text is None:
        start = datetime.fromtimestamp(recording.stat().st_mtime, UTC)
        remark(f"--session-start is not stated: {start:%Y-%m-%dT%H:%MZ}, when {recording} was made")
        return start
    try:
        start = datetime.fromisoformat(text)
    except ValueError:
        start = datetime.min
    if start.tzinfo is None:
        raise ValueError(
            f"--session-start is {text!r}; a date and time with its zone is needed, such as "
            "2026-03-01T14:30+01:00"
        )
    return start

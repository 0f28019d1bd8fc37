"""`vibrissa uniqueness`: signals that locate a contact uniquely."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli.options import Region, check_new, with_options
from vibrissa.cli.terminal import output, progress_bars, remark, say, shown
from vibrissa.deferred import xr

_DIGITS = 14  # number of digits for which the recomputed signals of a pair agree to 1e-10
_ASKED = "Fx MB MD"  # triplet of the paper; its witness, if any, is the one printed


@with_options("all evidence, .nc or .csv; by default nowhere")
def uniqueness(
    path: Path,
    using: list[str] | None = None,
    region: list[Region] | None = None,
    domain: Literal["reachable", "paper"] = "reachable",
    cone: float = 2.0,
    min_separation: float = 0.025,
    samples: int = 4096,
    resolution: bool = True,
    network: bool = False,
    certify: Path | None = None,
    minutes: float = 30.0,
    target: Path | None = None,
    force: bool = False,
) -> None:
    """Find which triplets of signals locate the contact uniquely, and witnesses against others.

    A witness is a pair of contacts with the same three signals. If there are any, the table states
    up to which deflection from rest they exist; contacts within --cone of rest do not count.

    Example: `vibrissa uniqueness map.nc -o uniqueness.nc`
    """
    if target is not None:
        check_new(target, vb.identifiability.ENDINGS, force)
    if certify is not None:
        vb.io.check_writable(certify, (".nc",))
    contact_map = vb.ContactMap.load(path, grid=False)
    with progress_bars() as tell:
        certificate = None
        if certify is not None:
            try:
                certificate = vb.certificates.certify(
                    contact_map,
                    float(np.deg2rad(cone)),
                    path=certify,
                    seconds=60.0 * minutes,
                    progress=lambda done, total: tell("certificate", done, total),
                )
            except KeyboardInterrupt:
                if certify.exists():  # not where it was still being set up
                    remark(f"{certify} contains the proof so far; the same command continues it")
                raise
        tell("verdicts", 0, 1)
        found = vb.uniqueness(
            contact_map,
            using or "all",
            [str(one) for one in region] if region else "all",
            cone=float(np.deg2rad(cone)),
            domain=domain,
            min_separation=min_separation,
            samples=samples,
            resolution=resolution,
            certificate=certificate,
            progress=lambda done, total: tell("verdicts", done, total),
        )
        if certificate is not None:
            tell("witnesses", 0, 1)
            found = vb.identifiability.with_proved_witnesses(contact_map, found)
            bracket = vb.identifiability.cone_bracket(contact_map, certificate, samples)
            tell("witnesses", 1, 1)
        if network:
            found = vb.paper.with_network_errors(
                contact_map, found, progress=lambda done, total: tell("networks", done, total)
            )
    say(f"{contact_map.whisker!r}\n")
    output.print(
        vb.identifiability.verdict_table(found), highlight=False, soft_wrap=True, markup=False
    )
    if certificate is not None:
        say(f"\n{certificate.summary()}\nwrote {certify}")
        _print_proofs(found, bracket)
    _print_witness(found)
    if target is not None:
        vb.identifiability.save_uniqueness(found, target)
        say(f"wrote {target}")


def _print_proofs(found: xr.Dataset, bracket: tuple[float, float]) -> None:
    """Print proved bounds on the critical cone, and triplets with proved witnesses."""
    low, high = np.rad2deg(bracket)
    below = f"{low:.3g}° (witness, proved) ≤ " if low > 0.0 else ""
    above = f" ≤ {high:.3g}° (certificate)" if np.isfinite(high) else ""
    if below or above:
        say(f"{below}critical cone of (Fx, MB, MD){above}")
    over = ["region", "witness"]
    there = found["witness_separation"].notnull().any(over).values
    proved = (found["witness_proved"] == 1).any(over).values
    for word, which in (("proved", there & proved), ("not proved", there & ~proved)):
        if which.any():
            names = [f"({t.replace(' ', ', ')})" for t in found["triplet"].values[which]]
            say(f"not unique (witness), {word}: {', '.join(names)}")


def _print_witness(found: xr.Dataset) -> None:
    """Print one witness with enough digits to reproduce it."""
    apart = found["witness_separation"].isel(witness=0).max("region").to_series().dropna()
    if apart.empty:
        return
    triplet = _ASKED if _ASKED in apart.index else str(apart.index[0])
    row = found.sel(triplet=triplet).isel(witness=0)
    cell = row.isel(region=int(np.nanargmax(row["witness_separation"].values)))
    say(
        f"\nA witness for ({triplet.replace(' ', ', ')}), {cell['region'].item()}: two contacts "
        f"{shown('contact_point', float(cell['witness_separation']))} apart that have the same "
        f"signals, with {int(cell['witness_steps'])} integration steps."
    )
    for pair in ("first", "second"):
        one = cell.sel(pair=pair)
        fy, fz = one["witness_contact_force"].values
        say(
            f"  at {shown('arc_length', float(one['witness_arc_length']), _DIGITS)} with the force "
            f"({shown('Fx', fy, _DIGITS)}, {shown('Fx', fz, _DIGITS)}) along d1 and d2"
        )
    values = zip(triplet.split(), cell["witness_signals"].values, strict=True)
    say("  " + ", ".join(f"{name} {shown(name, value, 10)}" for name, value in values))

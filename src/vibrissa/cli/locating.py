"""`vibrissa estimate`: from signals to contact points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from vibrissa.cli.assumptions import (
    Assumed,
    GainSigma,
    GreatestForce,
    LeastForce,
    MixingSigma,
    Proximal,
    Region,
    StiffnessSigma,
    assumed,
    smallest_arc,
)
from vibrissa.cli.terminal import Force, Tell, progress_bars, refuse, shown

if TYPE_CHECKING:
    from collections.abc import Sequence

    import xarray as xr

    from vibrissa.numerics import Array
    from vibrissa.whisker import Whisker


def estimate(
    signals: Annotated[
        Path,
        typer.Argument(
            help="A recording, .nc; or a table with time, Fx, Fy, Fz, Mx, My, Mz in SI units.",
            metavar="SIGNALS",
        ),
    ],
    charts: Annotated[
        list[Path] | None,
        typer.Option(
            "--map",
            help="Of the whisker (of several: one for each, in their order); simulated if not "
            "given.",
            metavar="FILE",
        ),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(
            help="Centreline as CSV, where no map is given and it is not that of the recording.",
            metavar="FILE",
        ),
    ] = None,
    triplet: Annotated[
        str | None,
        typer.Option(
            "--signals",
            "--triplet",
            help="The signals to use, three or more of Fx, FT, FD, Mx, MB, MD; by default "
            "Fx,MB,MD, but of signals of the rod --wrench.",
            metavar="A,B,C",
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="exact; or, of three signals, as the paper did: lookup or lookup-linear, in the "
            "map's grid, or network, trained first (ten seconds). These give one contact where "
            "there are several."
        ),
    ] = "exact",
    all_six: Annotated[
        bool,
        typer.Option(
            "--wrench", help="Use force and moment whole, without assuming that nothing rubs."
        ),
    ] = False,
    force_noise: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a force component, µN; by default what the recording says, "
            "or 1.",
            min=0.0,
        ),
    ] = None,
    moment_noise: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a moment component, µN·m; by default what the recording "
            "says, or 0.02.",
            min=0.0,
        ),
    ] = None,
    noise: Annotated[
        Path | None,
        typer.Option(
            help="Instead: covariance of Fx, Fy, Fz, Mx, My, Mz, six lines of six numbers, in SI "
            "units.",
            metavar="FILE",
        ),
    ] = None,
    stiffness_sigma: StiffnessSigma = 0.0,
    gain_sigma: GainSigma = 0.0,
    mixing_sigma: MixingSigma = 0.0,
    region: Region = None,
    least_force: LeastForce = None,
    greatest_force: GreatestForce = None,
    proximal: Proximal = None,
    path: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Where a recording goes with the contacts added, .nc, by default to where it is; "
            "or the contacts as a table, .csv, by default contacts.csv.",
            metavar="FILE",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Find the contact point in each frame or row of signals, with its uncertainty.

    From three signals all contacts that give them exactly, from more by least squares; with
    --wrench whatever the friction, and no map is needed. Where nothing is felt (M_B within five
    standard deviations of zero) the status is not_felt. To a recording they are added as a group
    `estimates`, in the laboratory too, where continuity tells which of several contacts it was;
    signals are made first where there are none (see `vibrissa signals`), and a contour that was
    made of other contacts is left out. A table goes to a table.
    Example: `vibrissa estimate signals.csv --map map.nc --signals Fx,FT,MB,MD -o contacts.csv`
    """
    from vibrissa.cli.recordings import free_beside, is_recording, noise_from
    from vibrissa.io.paths import CSV, NETCDF, check_readable, check_writable

    how = how_to(triplet, method, all_six, charts, whisker)
    beforehand = assumed(
        stiffness_sigma, gain_sigma, mixing_sigma, region, least_force, greatest_force
    )
    if charts:
        refuse({"--proximal": proximal}, "it is of maps that are simulated, and --map is given")
    if all_six:
        refuse({"--proximal": proximal}, "it is of a map, and --wrench needs none")
    how = how._replace(assumed=beforehand, proximal=proximal)
    if noise is not None:
        options = {"--force-noise": force_noise, "--moment-noise": moment_noise}
        refuse(options, "--noise tells it all")
    sigma = noise_from(noise, force_noise, moment_noise)
    recorded = is_recording(check_readable(signals))
    if path is None:
        path = signals if recorded else Path("contacts.csv")
    check_writable(path, (*NETCDF, *CSV) if recorded else CSV)
    free_beside(signals, [path], force)
    if recorded:
        _from_recording(signals, path, how, sigma)
    else:
        _from_table(signals, path, how, sigma)


class How(NamedTuple):
    """How contacts are estimated."""

    names: tuple[str, ...] | None
    method: str
    all_six: bool
    charts: tuple[Path, ...]
    whisker: Path | None
    assumed: Assumed = Assumed({}, None)
    proximal: float | None = None

    @property
    def known(self) -> Path | None:
        """The file that holds the one whisker, if one is given."""
        return self.charts[0] if len(self.charts) == 1 else self.whisker

    @property
    def grid(self) -> bool:
        """Whether the paper's grid is looked up in."""
        return self.method.startswith("lookup")

    def used(self, names: str) -> str:
        """Say by which signals, and what is known beforehand."""
        by = "" if self.method == "exact" else f" by {self.method}"
        used = f"signals ({', '.join(names.split())}){by}"
        return ("force and moment whole" if names == "wrench" else used) + self.assumed.said()


def how_to(
    triplet: str | None,
    method: str,
    all_six: bool,
    charts: Sequence[Path] | None,
    whisker: Path | None,
) -> How:
    """Read how to estimate from options of the command line."""
    from vibrissa.pipeline import TRIPLET
    from vibrissa.signals import selection

    names = None if triplet is None else selection(triplet)
    _check_method(method, names or TRIPLET, all_six)
    if charts and whisker is not None:
        raise ValueError("give either --map or --whisker: a map already has its whisker")
    if all_six:
        refuse({"--signals": triplet}, "--wrench uses force and moment whole")
    return How(names, method, all_six, tuple(charts or ()), whisker)


def _from_table(signals: Path, path: Path, how: How, noise: tuple[Array, str] | None) -> None:
    """Contacts in the whisker's frame, as a table."""
    from vibrissa.cli.recordings import (
        maps_from,
        maps_of,
        noise_from,
        say,
        tell_statuses,
        tell_written,
    )
    from vibrissa.cli.sources import tell_notes, whisker_from, wrench_from
    from vibrissa.io import save_contacts
    from vibrissa.pipeline import TRIPLET, contact_columns, locate, locate_from_wrench
    from vibrissa.sensors import FORCE_NOISE

    covariance, said = noise or noise_from(None, FORCE_NOISE * 1e6, None) or (None, "")
    wrench, _ = wrench_from(signals)
    for note in wrench.attrs.get("notes", ()):
        say(f"{signals}: {note}")
    maps = maps_from(how.charts, 1, how.grid) if how.charts else []
    known = maps[0].whisker if maps else whisker_from(how.whisker)
    tell_notes(known)
    _check_scale(signals, wrench, known)
    with progress_bars() as tell:
        if not maps and not how.all_six:
            maps = maps_of([known], tell, how.grid, smallest_arc(how.proximal))
        tell("contact points", 0, 1)
        if how.all_six:
            found = locate_from_wrench(known, wrench, covariance, *how.assumed)
        else:
            found = locate(
                maps[0],
                wrench,
                how.names or TRIPLET,
                noise=covariance,
                method=how.method,
                **how.assumed._asdict(),
            )
        tell("contact points", 1, 1)
    save_contacts(path, contact_columns(found))
    felt = shown("MB", found.attrs["felt_above"])
    used = how.used("wrench" if how.all_six else found.attrs["triplet"])
    say(f"{used}; {said}; contacts are felt where M_B exceeds {felt}")
    tell_statuses(found["status"].values)
    tell_written(path)


def _from_recording(signals: Path, path: Path, how: How, noise: tuple[Array, str] | None) -> None:
    """Contacts added to a recording, or as a table."""
    from vibrissa.cli.feeling import described
    from vibrissa.cli.recordings import recording_from, say, tell_statuses, tell_written
    from vibrissa.io import save_contacts, save_recording
    from vibrissa.io.paths import CSV
    from vibrissa.pipeline import contact_columns

    tree = recording_from(signals)
    table = path.suffix.lower() in CSV
    if table and tree.sizes["whisker"] != 1:
        raise ValueError(
            f"{signals} is a recording of {tree.sizes['whisker']} whiskers; a table has the "
            "contacts of one: give an --output that ends in .nc"
        )
    with progress_bars() as tell:
        done, said = estimated(tree, how, noise, tell, str(signals))
    say(f"{described(done)}; {said}")
    found = done["estimates"].to_dataset()
    tell_statuses(found["status"].values)
    if table:
        save_contacts(path, contact_columns(found.isel(whisker=0)))
    else:
        save_recording(path, done)
    tell_written(path, signals, "estimates")


def estimated(
    tree: xr.DataTree, how: How, noise: tuple[Array, str] | None, tell: Tell, name: str
) -> tuple[xr.DataTree, str]:
    """Add contacts to a recording, and signals where there are none."""
    from vibrissa.cli.feeling import signal_options
    from vibrissa.cli.recordings import maps_from, noise_from, say, whiskers_for
    from vibrissa.cli.sources import tell_notes
    from vibrissa.pipeline import sensor_noise, with_estimates, with_signals
    from vibrissa.sensors import FORCE_NOISE

    if "signals" not in tree.children:
        tree = with_signals(tree, **signal_options(tree, None, None, how.known))
    signals = tree["signals"].to_dataset()
    if noise is None and sensor_noise(signals) is None and signals.attrs.get("source") == "sensor":
        noise = noise_from(None, FORCE_NOISE * 1e6, None)
    maps = maps_from(how.charts, tree.sizes["whisker"], how.grid) if how.charts else []
    whiskers = [one.whisker for one in maps] if maps else whiskers_for(tree, how.whisker)
    tell_notes(*whiskers)
    for k, whisker in enumerate(whiskers):
        _check_scale(name, signals.isel(whisker=k), whisker)
    by_default = how.names is None and how.method == "exact"
    all_six = how.all_six or (by_default and signals.attrs.get("source") == "rod")
    if not maps and not all_six:
        one = f"no map given; simulating that of {whiskers[0]!r}"
        several = "no maps given; simulating those of the whiskers that feel a contact"
        say(one if len(whiskers) == 1 else several)
    options: dict[str, Any] = {"contact_maps": maps} if maps else {"whiskers": whiskers}
    done = with_estimates(
        tree,
        "wrench" if all_six else how.names,
        noise=None if noise is None else noise[0],
        method=how.method,
        proximal=smallest_arc(how.proximal),
        progress=tell,
        **how.assumed._asdict(),
        **options,
    )
    said = "noise as the recording says" if noise is None else noise[1]
    about = done["estimates"].attrs
    felt = shown("MB", float(about["felt_above"]), 3)
    return (
        done,
        f"{how.used(str(about['signals']))}; {said}; contacts are felt where M_B exceeds {felt}",
    )


def _check_method(method: str, names: tuple[str, ...], all_six: bool) -> None:
    from vibrissa.paper import METHODS

    if method not in ("exact", *METHODS):
        allowed = ", ".join(("exact", *METHODS))
        raise ValueError(f"--method is {method!r}; one of {allowed} is needed")
    if method == "exact":
        return
    if all_six:
        raise ValueError(f"--wrench uses force and moment whole; it has no --method {method}")
    if len(names) != 3:
        raise ValueError(
            f"--method {method} takes three signals; got {len(names)}: {', '.join(names)}"
        )


def _check_scale(path: Path | str, wrench: xr.Dataset, whisker: Whisker) -> None:
    from vibrissa.io.signals_table import check_scale

    try:
        check_scale(wrench, whisker)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None

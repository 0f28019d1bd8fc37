"""`vibrissa reconstruct`: from a recording to the object that was touched."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from vibrissa.cli.terminal import Force, Tell, numbers, output, progress_bars

if TYPE_CHECKING:
    from collections.abc import Iterator

    import xarray as xr

    from vibrissa.cli.locating import How
    from vibrissa.numerics import Array
    from vibrissa.objects.surface import Surface
    from vibrissa.whisker import Whisker

_SUSPECT = 1.5
"""χ² per degree of freedom from which it is asked whether another shape goes better."""


def reconstruct(
    recording: Annotated[
        Path,
        typer.Argument(help="A recording that was tracked or simulated, .nc.", metavar="TRIAL.nc"),
    ],
    path: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Where the recording goes with all that was found added, .nc; by default to "
            "where it is.",
            metavar="FILE",
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            help="Where the contour points go; by default beside the recording, NAME_contour.csv.",
            metavar="FILE",
        ),
    ] = None,
    shape: Annotated[
        str, typer.Option(help="What was touched: cylinder, sphere, plane or free.")
    ] = "cylinder",
    axis: Annotated[
        str | None,
        typer.Option(help="Direction of a cylinder's axis, if it is known.", metavar="X,Y,Z"),
    ] = None,
    lean: Annotated[
        float | None,
        typer.Option(
            help="How far normals may lean from forces, degrees (standard deviation): by default "
            "5.7 for contacts from --wrench, which allows for friction, and else 0."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            help="What signals come from: contact point, rod or sensor (see `vibrissa signals`).",
            metavar="SOURCE",
        ),
    ] = None,
    cutoff: Annotated[
        float | None,
        typer.Option(help="Low pass of the pose the contact point is seen from, Hz: 85; 0: none."),
    ] = None,
    triplet: Annotated[
        str | None,
        typer.Option(
            "--signals",
            help="What contacts are estimated from (see `vibrissa estimate`): Fx,MB,MD.",
            metavar="A,B,C",
        ),
    ] = None,
    all_six: Annotated[
        bool, typer.Option("--wrench", help="Estimate from force and moment whole.")
    ] = False,
    charts: Annotated[
        list[Path] | None,
        typer.Option(
            "--map", help="Of the whisker (of several: one for each); simulated if not given."
        ),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV, if the recording has no whisker.", metavar="FILE"),
    ] = None,
    force_noise: Annotated[
        float | None,
        typer.Option(help="Of a sensor's force component, µN, if not as recorded.", min=0.0),
    ] = None,
    moment_noise: Annotated[
        float | None,
        typer.Option(help="Of a sensor's moment component, µN·m, if not as recorded.", min=0.0),
    ] = None,
    objects: Annotated[
        Path | None,
        typer.Option(
            help="Recording whose objects are known, to compare with; by default TRIAL.nc.",
            metavar="FILE",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Find the object that was touched from a recording alone.

    Signals and estimates that the recording already has are used; what is missing is made first, by
    defaults that are printed, and what options ask for is made anew. All is added to the recording
    as groups `signals`, `estimates` and `contour`; what else it held stays as it was. The contour
    points go to a table as well; one that holds just what the recording held goes along with it
    when that is made anew. Example: `vibrissa reconstruct trial.nc --shape cylinder`
    """
    from vibrissa.cli.locating import how_to
    from vibrissa.cli.recordings import free_beside, noise_from, recording_from, tell_written
    from vibrissa.io import save_contour, save_recording
    from vibrissa.io.paths import CSV, NETCDF, check_writable
    from vibrissa.pipeline import contour_points
    from vibrissa.recording import Recording

    target = recording if path is None else path
    points = target.with_name(f"{target.stem}_contour.csv") if csv is None else csv
    check_writable(target, NETCDF)
    check_writable(points, CSV)
    own = not force and _of_contour(points, recording, whisker)
    free_beside(recording, [target] if own else [target, points], force)
    direction = None if axis is None else numbers(axis, ("X", "Y", "Z"), "--axis")
    _check_shape(shape, direction is not None)
    if lean is not None and not 0.0 <= lean < 90.0:
        raise ValueError(f"--lean is {lean:g}; degrees from 0 to 90 are needed")
    wanted = _Wanted(
        source=source,
        cutoff=cutoff,
        how=how_to(triplet, "exact", all_six, charts, whisker),
        noise=noise_from(None, force_noise, moment_noise),
        shape=shape,
        axis=direction,
        lean=None if lean is None else math.radians(lean),
    )
    tree = recording_from(recording)
    known = Recording(tree if objects is None else recording_from(objects)).objects
    with progress_bars() as tell:
        made = []
        try:
            for name, after in _stages(tree, wanted, known, tell, str(recording)):
                made.append(name)
                tree = after
        except ValueError as fault:
            if not made:
                raise
            save_recording(target, tree)
            raise ValueError(f"{fault}; {' and '.join(made)} are in {target}") from None
    whiskers = wanted.whiskers(tree)
    _tell(tree, known, whiskers, wanted)
    save_recording(target, tree)
    save_contour(points, contour_points(tree, whiskers))
    tell_written(target, recording, "contour")
    tell_written(points)


class _Wanted(NamedTuple):
    """What was asked for: of signals, of contacts, and of the object."""

    source: str | None
    cutoff: float | None
    how: How
    noise: tuple[Array, str] | None
    shape: str
    axis: list[float] | None
    lean: float | None

    @property
    def contacts(self) -> bool:
        """Whether contacts are to be estimated in a way of their own."""
        how = self.how
        ways = (how.names, how.all_six, how.charts, how.whisker, self.noise)
        return any(bool(way) for way in ways)

    def whiskers(self, tree: xr.DataTree) -> list[Whisker]:
        """That touched."""
        from vibrissa.cli.recordings import whiskers_for

        return whiskers_for(tree, self.how.known)


def _stages(
    tree: xr.DataTree, wanted: _Wanted, known: tuple[Surface, ...], tell: Tell, name: str
) -> Iterator[tuple[str, xr.DataTree]]:
    """The recording after each stage that is missing or asked for in another way."""
    from vibrissa.cli.feeling import described, signal_options
    from vibrissa.cli.locating import estimated
    from vibrissa.cli.recordings import say
    from vibrissa.pipeline import with_contour, with_signals

    source, cutoff = wanted.source, wanted.cutoff
    made = tree["signals"].attrs if "signals" in tree.children else None
    if made and wanted.how.whisker is not None and source is None and cutoff is None:
        # The same way, by another whisker.
        source = made.get("source")
        cutoff = float(made.get("cutoff", 0.0)) if source == "contact point" else None
    if source is not None or cutoff is not None or made is None:
        tell("signals", 0, 1)
        tree = with_signals(tree, **signal_options(tree, source, cutoff, wanted.how.known))
        tell("signals", 1, 1)
        yield "signals", tree
    say(described(tree))
    if wanted.contacts or "estimates" not in tree.children:
        tree, said = estimated(tree, wanted.how, wanted.noise, tell, name)
        say(said)
        yield "estimates", tree
    tell(wanted.shape, 0, 1)
    tree = with_contour(
        tree,
        wanted.shape,
        axis=wanted.axis,
        lean=wanted.lean,
        whiskers=wanted.whiskers(tree),
        objects=known,
    )
    tell(wanted.shape, 1, 1)
    yield "contour", tree


def _tell(
    tree: xr.DataTree, known: tuple[Surface, ...], whiskers: list[Whisker], wanted: _Wanted
) -> None:
    """What became of the frames, the object, and how far contacts are from one that is known."""
    from vibrissa.cli.contour_tables import distance_table, object_table, summary
    from vibrissa.cli.recordings import tell_statuses
    from vibrissa.contour import shape_from_dataset
    from vibrissa.evaluation import caution
    from vibrissa.pipeline import compare_contacts, compare_shapes, distances_by_class

    contour, estimates = (tree[name].to_dataset() for name in ("contour", "estimates"))
    shapes, fit = None, shape_from_dataset(contour)
    if wanted.shape != "free" and fit.misfit > _SUSPECT:
        shapes = compare_shapes(estimates, whiskers, axis=wanted.axis, lean=wanted.lean)
    tell_statuses(estimates["status"].values)
    output.print(object_table(fit, contour, known))
    for line in summary(fit, contour, shapes):
        output.print(line, highlight=False, soft_wrap=True)
    if known:
        compared = compare_contacts(tree, known, whiskers)
        output.print(distance_table(distances_by_class(compared)["deflection_angle"]))
    if said := caution(contour.attrs.get("source")):
        output.print(said, highlight=False, soft_wrap=True)


def _of_contour(points: Path, recording: Path, whisker: Path | None) -> bool:
    """Whether a table holds what the recording does: replaced with it, nothing else is lost."""
    from vibrissa.cli.recordings import is_recording, recording_from, whiskers_for
    from vibrissa.io.contacts_table import holds_contour
    from vibrissa.pipeline import contour_points

    if not points.is_file() or not is_recording(recording):
        return False
    tree = recording_from(recording)
    if not {"estimates", "contour"} <= set(tree.children):
        return False
    try:
        return holds_contour(points, contour_points(tree, whiskers_for(tree, whisker)))
    except ValueError:
        return False


def _check_shape(shape: str, axis: bool) -> None:
    from typing import get_args

    from vibrissa.pipeline import Shape

    if shape not in get_args(Shape):
        raise ValueError(f"--shape is {shape!r}; one of {', '.join(get_args(Shape))} is needed")
    if axis and shape != "cylinder":
        raise ValueError(f"--axis is for a cylinder; --shape is {shape}")

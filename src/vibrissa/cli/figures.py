"""`vibrissa figures`: everything that can be drawn from a map, or from a trial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import vibrissa as vb
from vibrissa.cli.drawings import Draw, TrialOptions, array_drawings, map_drawings, trial_drawings
from vibrissa.cli.inputs import map_from
from vibrissa.cli.options import Format, free, refuse, with_options
from vibrissa.cli.terminal import Tell, progress_bars, say

if TYPE_CHECKING:
    import xarray as xr


@with_options("figures, in a folder")
def figures(
    path: Annotated[
        Path,
        typer.Argument(
            help="A map of contacts, the recording of a trial, NetCDF, or an array.",
            metavar="MAP | TRIAL",
        ),
    ],
    of_trial: TrialOptions,
    target: Path = Path("figures"),
    format_: list[Format] | None = None,
    width: Literal["single", "double"] = "double",
    uniqueness: Path | None = None,
    cones: Path | None = None,
    colour: Literal["time", "deflection"] | None = None,
    force: bool = False,
) -> None:
    """Draw the figures that a map or a trial allows.

    A map: whisker, signals over space, surfaces, sensitivity; with a saved result of `vibrissa
    uniqueness` also the verdicts, the resolution and pairs of contacts with the same signals. A
    trial: frames, signals and their course through the solids of a map, contacts about the whisker
    and in the laboratory, estimates, contour. An array of whiskers, or a trial of several: the
    face, the whiskers, and what they touch.
    Example: `vibrissa figures map.nc -o figures --width single`
    """
    endings = tuple(dict.fromkeys(map(str, format_ or ("png", "pdf"))))
    vb.io.check_folder(target)
    verdicts = None if uniqueness is None else dataset_with(uniqueness, "verdict")
    sweep = None if cones is None else dataset_with(cones, "critical_cone")
    with progress_bars() as tell:
        drawings = array_drawings(path, width)
        if not path.is_dir() and vb.io.recognise(path) == vb.io.Kind.RECORDING:
            refuse({"--uniqueness": uniqueness, "--cones": cones}, f"{path} is a recording")
            drawings |= trial_drawings(path, width, of_trial, tell, colour or "time")
        else:
            refuse(of_trial.given() | {"--colour": colour}, f"{path} is not a recording")
        if not drawings:
            drawings = dict(map_drawings(map_from(path), width, verdicts, sweep))
        free([target / f"{name}.{ending}" for name in drawings for ending in endings], force)
        target.mkdir(parents=True, exist_ok=True)
        files = saved(drawings, target, endings, tell)
    for file in files:
        say(f"wrote {file}")


def saved(
    drawings: dict[str, Draw], folder: Path, endings: Sequence[str], tell: Tell
) -> list[Path]:
    """Draw figures into a folder."""
    files: list[Path] = []
    for i, (name, draw) in enumerate(drawings.items()):
        tell("figures", i, len(drawings))
        files += vb.plots.save(draw(), folder / name, endings)
    tell("figures", len(drawings), len(drawings))
    return files


def dataset_with(path: Path, needed: str) -> xr.Dataset:
    """Read a dataset that holds a variable."""
    if path.suffix.lower() in vb.io.CSV:
        raise ValueError(f"{path} is a table; the same saved as NetCDF (-o FILE.nc) is needed")
    kind = vb.io.kind_of(path)
    data = vb.io.read_dataset(path)
    if needed not in data:
        raise ValueError(
            f"{path} holds {kind or 'data of another kind'}, and no variable {needed!r}"
        )
    return data

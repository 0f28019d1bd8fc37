"""`vibrissa calibrate`: from images of a checkerboard to calibrated cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.cli.terminal import Force, free, output, refuse

_POOR = 1.0
"""Reprojection error above which something is wrong, pixels."""

_LARGEST = 0.2


def calibrate(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Images of all cameras, named like top_01.png, front_01.png, or a video of each.",
            metavar="IMAGE...",
        ),
    ],
    pattern: Annotated[
        str, typer.Option(help="Inner corners of the board, along its longer side first: 9x6.")
    ],
    square: Annotated[float, typer.Option(help="Side of a square, m.")],
    cameras: Annotated[
        Path,
        typer.Option("--output", "-o", help="Cameras to write, TOML of Anipose.", metavar="FILE"),
    ],
    frames: Annotated[
        int | None, typer.Option(help="Frames to take of a video, evenly spread; 40 by default.")
    ] = None,
    force: Force = False,
) -> None:
    """Calibrate cameras by a checkerboard that they see at the same moments (extra cameras).

    The board is to be turned and moved between images. The file is for `vibrissa track --cameras`;
    its laboratory frame is that of the board in the first moment in which all cameras see it.
    Example: `vibrissa calibrate --pattern 9x6 --square 5e-3 top_*.png front_*.png -o cameras.toml`
    """
    from vibrissa.cameras import calibrate as calibrated
    from vibrissa.cameras import save_cameras
    from vibrissa.io import Kind, load_series, recognise
    from vibrissa.io.paths import check_readable, check_writable

    corners = _corners(pattern)
    if not 0.0 < square < _LARGEST:
        raise ValueError(f"--square is {square:g}; the side of a square in m is needed, as 5e-3")
    if frames is not None and frames < 2:
        raise ValueError(f"--frames is {frames}; a few dozen are needed")
    check_writable(cameras, (".toml",))
    free([cameras], force)
    if not any(recognise(check_readable(image)) == Kind.VIDEO for image in images):
        refuse({"--frames": frames}, "it is of videos, and these are images")
    series = load_series(images, frames or 40)
    found, error = calibrated(series, corners, square)
    save_cameras(cameras, found)
    for camera in found:
        output.print(
            f"{camera.name}: {camera.size[0]} × {camera.size[1]} pixels, focal length "
            f"{camera.matrix[0, 0]:.1f} × {camera.matrix[1, 1]:.1f} pixels",
            highlight=False,
            soft_wrap=True,
        )
    output.print(f"reprojection error {error:.3f} pixels (root mean square)", highlight=False)
    if error > _POOR:
        output.print(
            "  That is much: perhaps the images do not belong together, are blurred, or the "
            "pattern has other corners.",
            highlight=False,
            soft_wrap=True,
        )
    output.print(f"wrote {cameras}", highlight=False, soft_wrap=True)


def _corners(text: str) -> tuple[int, int]:
    """Read 9x6."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--pattern is {text!r}; the numbers of inner corners as 9x6 are needed")
    corners = int(parts[0]), int(parts[1])
    if min(corners) < 3:
        raise ValueError(f"--pattern is {text!r}; a board has at least 3 inner corners each way")
    return corners

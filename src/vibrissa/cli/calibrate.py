"""`vibrissa calibrate`: from images of a checkerboard to calibrated cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.cli.options import free, refuse, with_options
from vibrissa.cli.terminal import say

_POOR = 1.0
"""Reprojection error above which something is wrong, pixels."""

_SMALLEST, _LARGEST = 0.05, 200.0
"""Sides of squares, mm: what is smaller was typed in m."""

_FRAMES = 40
"""Frames that are used of a video, by default."""


@with_options("the cameras, TOML of Anipose")
def calibrate(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Images of all cameras, named like top_01.png, front_01.png, or a video of each.",
            metavar="IMAGE...",
        ),
    ],
    pattern: str,
    square: float,
    target: Path,
    frames: int | None = None,
    force: bool = False,
) -> None:
    """Calibrate cameras by a checkerboard that they see at the same moments (extra cameras).

    The board is to be turned and moved between images. The file is for `vibrissa track --cameras`;
    its laboratory frame is that of the board in the first moment in which all cameras see it.
    Example: `vibrissa calibrate --pattern 9x6 --square 5 top_*.png front_*.png -o cameras.toml`
    """
    from vibrissa.cameras import calibrate as calibrated
    from vibrissa.cameras import save_cameras
    from vibrissa.io import Kind, check_readable, check_writable, load_series, recognise

    corners = _corners(pattern)
    if not _SMALLEST < square < _LARGEST:
        raise ValueError(f"--square is {square:g}; the side of a square in mm is needed, as 5")
    if frames is not None and frames < 2:
        raise ValueError(f"--frames is {frames}; a few dozen are needed")
    check_writable(target, (".toml",))
    free([target], force)
    if not any(recognise(check_readable(image)) == Kind.VIDEO for image in images):
        refuse({"--frames": frames}, "it is of videos, and these are images")
    cameras, error = calibrated(load_series(images, frames or _FRAMES), corners, 1e-3 * square)
    save_cameras(target, cameras)
    for camera in cameras:
        say(
            f"{camera.name}: {camera.size[0]} × {camera.size[1]} pixels, focal length "
            f"{camera.matrix[0, 0]:.1f} × {camera.matrix[1, 1]:.1f} pixels"
        )
    say(f"reprojection error {error:.3f} pixels (root mean square)")
    if error > _POOR:
        say(
            "  That is much: perhaps the images do not belong together, are blurred, or the "
            "pattern has other corners."
        )
    say(f"wrote {target}")


def _corners(text: str) -> tuple[int, int]:
    """Read 9x6."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--pattern is {text!r}; the numbers of inner corners as 9x6 are needed")
    corners = int(parts[0]), int(parts[1])
    if min(corners) < 3:
        raise ValueError(f"--pattern is {text!r}; a board has at least 3 inner corners each way")
    return corners

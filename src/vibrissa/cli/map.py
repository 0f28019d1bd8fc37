"""`vibrissa map`: the map of all contacts of a whisker."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import vibrissa as vb
from vibrissa.cli.inputs import WhiskerOptions, map_of, metres_of, print_notes, smallest_arc
from vibrissa.cli.options import check_new, numbers, refuse, with_options
from vibrissa.cli.terminal import progress_bars, say


@dataclass(frozen=True)
class MadeOptions(WhiskerOptions):
    """Options for a whisker from a file or a straight one, of any thickness and material."""

    length: float | None = None
    base_radius: float | None = None
    tip_radius: float | None = None
    modulus: float | None = None
    poisson: float | None = None
    density: float | None = None
    base_stiffness: str | None = None

    def __post_init__(self) -> None:
        self.check(self.whisker is not None or self.length is not None)
        if self.length is not None and self.whisker is not None:
            raise ValueError("give either --whisker or the --length of a straight one")
        if self.whisker is None:
            refuse({"--base-end": self.base_end}, "--length states a straight whisker")
        if self.rat is not None:
            radii = {"--base-radius": self.base_radius, "--tip-radius": self.tip_radius}
            refuse(radii, "--rat determines the radii")

    def read(self, path: Path | None = None) -> vb.Whisker:
        """Read or construct the whisker with the stated thickness and material."""
        if self.length is None:
            whisker = super().read(path)
        else:
            whisker = vb.Whisker.straight(
                1e-3 * self.length, rat=self.rat, any_length=self.any_length
            )
        changes: dict[str, Any] = {}
        if self.base_radius is not None or self.tip_radius is not None:
            base, tip = whisker.base_radius, None
            if self.base_radius is not None:
                base = metres_of(self.base_radius, "--base-radius")
            if self.tip_radius is not None:
                tip = metres_of(self.tip_radius, "--tip-radius")
            changes |= {
                "base_radius": base,
                "tip_radius": base / vb.whisker.TAPER if tip is None else tip,
            }
        if self.modulus is not None:
            changes["youngs_modulus"] = 1e9 * self.modulus
        if self.poisson is not None:
            changes["poisson_ratio"] = self.poisson
        if self.density is not None:
            changes["density"] = self.density
        if self.base_stiffness is not None:
            stiffness = numbers(self.base_stiffness, ("BENDING", "TWIST"), "--base-stiffness")
            changes["base_stiffness"] = tuple(1e-6 * value for value in stiffness)
        return whisker.with_properties(**changes) if changes else whisker


@with_options("the map, .nc")
def simulate_map(
    own: MadeOptions,
    proximal: float | None = None,
    target: Path = Path("map.nc"),
    grid: bool = True,
    force: bool = False,
) -> None:
    """Find all stable contacts of a whisker, and solve the paper's grid of contact points.

    Radii, modulus and Poisson's ratio are those of the file, or by default of an average whisker.
    Example: `vibrissa map --whisker C1.csv -o map.nc`; steel wire:
    `vibrissa map --length 300 --base-radius 0.5 --tip-radius 0.25 --modulus 200 --poisson 0.29`
    """
    check_new(target, vb.io.NETCDF, force)
    whisker = own.read()
    print_notes(whisker)
    with progress_bars() as tell:
        contact_map = map_of(whisker, tell, grid=grid, proximal=smallest_arc(proximal))
        contact_map.save(target)
    say(repr(contact_map))
    say(f"wrote {target}")

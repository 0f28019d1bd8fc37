"""Options that say what is known beforehand: errors that all samples share, possible contacts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from vibrissa.contacts import Prior

StiffnessSigma = Annotated[
    float,
    typer.Option(
        "--stiffness-sigma",
        help="Standard deviation of the whisker's bending stiffness, %; the same error in all "
        "samples.",
        min=0.0,
    ),
]
GainSigma = Annotated[
    float,
    typer.Option(
        "--gain-sigma",
        help="Standard deviation of the gain of each component of force and moment, %; likewise.",
        min=0.0,
    ),
]
MixingSigma = Annotated[
    float,
    typer.Option(
        "--mixing-sigma",
        help="Standard deviation of the cross-talk among components of force, and of moment, %; "
        "likewise.",
        min=0.0,
    ),
]
Region = Annotated[
    str | None,
    typer.Option(
        "--region",
        help="Where contacts may be: ELD, CF, CB, 'ELD CF' or 'ELD CB'; or limits of r (mm), theta "
        "and phi (degrees), as r=20:35,theta=-30:30. Others are left out.",
        metavar="REGION",
    ),
]
LeastForce = Annotated[
    float | None,
    typer.Option("--least-force", help="Smallest force of a contact, µN.", min=0.0),
]
GreatestForce = Annotated[
    float | None,
    typer.Option("--greatest-force", help="Largest force of a contact, µN.", min=0.0),
]
Proximal = Annotated[
    float | None,
    typer.Option(
        "--proximal",
        help="Smallest arc length of a contact of a simulated map, share of the whisker's length; "
        "0.3 by default.",
        metavar="SHARE",
    ),
]

# Unit of each limit on the command line.
_UNITS = {"r": 1e-3, "theta": math.pi / 180.0, "phi": math.pi / 180.0}


class Assumed(NamedTuple):
    """What is known beforehand."""

    errors: dict[str, float]
    prior: Prior | None

    def said(self) -> str:
        """Say it, to be put behind a sentence; empty where nothing is."""
        parts = [
            f"{name.removesuffix('_sigma')} known to {100.0 * value:g} %"
            for name, value in self.errors.items()
        ]
        if self.prior is not None:
            parts.append(f"contacts only {_possible(self.prior)}")
        return "".join(f"; {part}" for part in parts)


def _possible(prior: Prior) -> str:
    """Say which contacts are possible, in the units of the options."""
    parts = []
    if not isinstance(prior.region, str):
        limits = (
            f"{name}={least / _UNITS[name]:g}:{greatest / _UNITS[name]:g}"
            for name, (least, greatest) in prior.region.items()
        )
        parts.append(f"where {','.join(limits)} (mm, degrees)")
    elif prior.region != "all":
        parts.append(f"in {prior.region}")
    if prior.least_force > 0.0:
        parts.append(f"of at least {1e6 * prior.least_force:g} µN")
    if prior.greatest_force < math.inf:
        parts.append(f"of at most {1e6 * prior.greatest_force:g} µN")
    return " and ".join(parts) or "of any place and force"


def assumed(
    stiffness_sigma: float = 0.0,
    gain_sigma: float = 0.0,
    mixing_sigma: float = 0.0,
    region: str | None = None,
    least_force: float | None = None,
    greatest_force: float | None = None,
) -> Assumed:
    """Read what is known beforehand from options."""
    given = {
        "stiffness_sigma": stiffness_sigma,
        "gain_sigma": gain_sigma,
        "mixing_sigma": mixing_sigma,
    }
    errors = {name: 0.01 * value for name, value in given.items() if value > 0.0}
    if region is None and least_force is None and greatest_force is None:
        return Assumed(errors, None)
    from vibrissa.contacts import Prior

    least = 0.0 if least_force is None else 1e-6 * least_force
    greatest = math.inf if greatest_force is None else 1e-6 * greatest_force
    if not least < greatest:
        raise ValueError(
            f"--least-force must be below --greatest-force; got {1e6 * least:g} and "
            f"{1e6 * greatest:g} µN"
        )
    where = "all" if region is None else region
    return Assumed(errors, Prior(_limits(where) if "=" in where else where, least, greatest))


def smallest_arc(proximal: float | None) -> float:
    """Give the smallest arc length of a contact, share of the length: what is given, or 0.3."""
    from vibrissa.rod import PROXIMAL

    return PROXIMAL if proximal is None else proximal


def _limits(text: str) -> dict[str, tuple[float, float]]:
    """Read limits as ``r=20:35,theta=-30:30``, in SI units."""
    limits = {}
    for part in text.split(","):
        name, _, values = part.partition("=")
        try:
            least, greatest = (float(value) * _UNITS[name.strip()] for value in values.split(":"))
        except (KeyError, ValueError):
            raise ValueError(
                f"--region is {text!r}; a name, or limits of r (mm), theta and phi (degrees) as "
                "r=20:35,theta=-30:30 are needed"
            ) from None
        limits[name.strip()] = (least, greatest)
    return limits

"""Cross-section and material: what makes a whisker stiff.

A circular section of radius r(s), of one isotropic material:

    B(s) = diag(GJ, EI, EI),    I = π r⁴ / 4,    J = 2 I,    G = E / (2 (1 + ν))

By default r falls linearly from base to tip. Sampled radii are joined by a monotone cubic (PCHIP),
which has no kinks and cannot overshoot below zero.
"""

from collections.abc import Callable, Sequence
from typing import TypedDict, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from vibrissa.whisker.profile import UNRESOLVED, Profile, approximate, array_function, linear

Array = NDArray[np.float64]

BASE_RADIUS = 100e-6
TAPER = 15.0
YOUNGS_MODULUS = 3e9
POISSON_RATIO = 0.38

# From a soft gel to diamond, Pa; what lies outside is in another unit.
_SOFTEST, _HARDEST = 1e3, 1e13
# A rod's radius is at most this share of its length.
_STOUT = 0.1

COVERAGE = 0.01
"""Share of the length by which radius samples may fall short of base or tip."""


class Section(TypedDict, total=False):
    """Keywords that state the radius."""

    base_radius: float
    tip_radius: float | None
    radius: Callable[..., object] | ArrayLike | None


class Holding(TypedDict, total=False):
    """Keywords that state the material, how the base is held, and a name."""

    youngs_modulus: float
    poisson_ratio: float
    base_stiffness: tuple[float, float] | None
    name: str


class Properties(Section, Holding, total=False):
    """Keywords that every constructor of a whisker takes."""


def split(properties: Properties) -> tuple[Section, Holding]:
    """Take the keywords for the radius apart from the others."""
    section = {key: value for key, value in properties.items() if key in _SECTION_KEYS}
    others = {key: value for key, value in properties.items() if key not in _SECTION_KEYS}
    return cast(Section, section), cast(Holding, others)


_SECTION_KEYS = Section.__optional_keys__


def settled(
    length: float, breaks: Sequence[float], properties: Properties
) -> tuple[Profile, Holding, tuple[str, ...]]:
    """Turn the keywords of a constructor into a radius profile and checked material.

    Parameters
    ----------
    length : float
        Arc length of the whisker, m.
    breaks : sequence of float
        Arc lengths, m, where the radius may have a kink or a jump.
    properties : Properties
        What the caller stated.

    Returns
    -------
    section : Profile
        Radius over arc length, m.
    holding : Holding
        Material, holding and name as stated.
    notes : tuple of str
        What the user should know about them.

    Raises
    ------
    ValueError
        All faults of them in one message.
    """
    stated, holding = split(properties)
    faults = material_faults(
        holding.get("youngs_modulus", YOUNGS_MODULUS),
        holding.get("poisson_ratio", POISSON_RATIO),
        holding.get("base_stiffness"),
    )
    try:
        section = radius_profile(length, breaks=breaks, **stated)
    except ValueError as fault:
        raise ValueError("no whisker: " + "; ".join([*faults, str(fault)])) from None
    thickest = float(section(np.linspace(0.0, length, 101)).max())
    if thickest > _STOUT * length:
        faults.append(
            f"the radius is up to {thickest:.4g} m at a length of {length:.4g} m, more than a "
            "tenth of it: these look like millimetres given as metres; multiply by 1e-3"
        )
    if faults:
        raise ValueError("no whisker: " + "; ".join(faults))
    notes: tuple[str, ...] = ()
    if section(length, "left") > section(0.0) * (1.0 + 1e-9):
        notes += ("the tip is thicker than the base",)
    if section.error > UNRESOLVED:
        notes += (
            f"the radius is met to {section.error:.1e} of its largest value only; it has kinks or "
            "jumps that should be stated as breaks",
        )
    return section, holding, notes


def material_faults(
    youngs_modulus: float, poisson_ratio: float, base_stiffness: tuple[float, float] | None
) -> list[str]:
    """Say what is wrong with a material and its holding; empty if nothing is."""
    faults = []
    if not (np.isfinite(youngs_modulus) and youngs_modulus > 0.0):
        faults.append(f"youngs_modulus is {youngs_modulus!r} Pa; it must be positive")
    elif not _SOFTEST <= youngs_modulus <= _HARDEST:
        faults.append(
            f"youngs_modulus is {youngs_modulus:.4g} Pa, and from a gel to diamond it is between "
            f"{_SOFTEST:.0e} and {_HARDEST:.0e}: is it in Pa? 1 GPa is 1e9"
        )
    if not -1.0 < poisson_ratio <= 0.5:
        faults.append(f"poisson_ratio is {poisson_ratio!r}; it must lie in (-1, 0.5]")
    if base_stiffness is not None:
        values = np.asarray(base_stiffness, dtype=np.float64)
        if values.shape != (2,) or not (np.isfinite(values).all() and (values > 0.0).all()):
            faults.append(
                f"base_stiffness is {base_stiffness!r}; None (a rigid clamp) or two positive "
                "numbers (bending, twist) in N·m/rad are allowed"
            )
    return faults


def length_faults(length: float) -> list[str]:
    """Say what is wrong with a length, m; empty if nothing is."""
    if not (np.isfinite(length) and length > 0.0):
        return [f"length is {length!r} m; it must be positive"]
    if length > 0.5:
        return [
            f"length is {length:.4g} m, longer than the 0.5 m allowed: these look like millimetres "
            "given as metres, or micrometres as millimetres; multiply by 1e-3"
        ]
    if length < 0.5e-3:
        return [
            f"length is {length:.4g} m, shorter than the 0.5 mm allowed: these look like metres "
            "given as millimetres, or converted once too often; lengths are given in m"
        ]
    return []


def radius_profile(
    length: float,
    base_radius: float = BASE_RADIUS,
    tip_radius: float | None = None,
    radius: Callable[..., object] | ArrayLike | None = None,
    breaks: Sequence[float] = (),
) -> Profile:
    """Radius over arc length from any of the ways to state it.

    Parameters
    ----------
    length : float
        Arc length of the whisker, m.
    base_radius : float
        Radius at the base, m; not used where `radius` is given.
    tip_radius : float, optional
        Radius at the tip, m; by default a fifteenth of the base's.
    radius : callable or array, optional
        Radius r(s), m, of arc length s, m; or radii (n,) equally spaced from base to tip; or pairs
        (n, 2) of arc length and radius.
    breaks : sequence of float
        Arc lengths, m, where a callable radius has a kink or a jump.

    Returns
    -------
    Profile

    Raises
    ------
    ValueError
        If radii are not positive or do not cover the whisker.
    """
    if radius is None:
        bad = [
            f"{what} is {value!r} m; it must be positive"
            for what, value in (("base_radius", base_radius), ("tip_radius", tip_radius))
            if value is not None and not (np.isfinite(value) and value > 0.0)
        ]
        if bad:
            raise ValueError("; ".join(bad))
        tip = base_radius / TAPER if tip_radius is None else tip_radius
        return linear(float(base_radius), float(tip), length)
    if tip_radius is not None:
        raise ValueError("tip_radius and radius were both given; give one of them")
    if callable(radius):
        function = array_function(radius, (), "radius")
        profile = approximate(function, np.unique([0.0, *breaks, length]))
    else:
        profile = _joined(length, np.asarray(radius, dtype=np.float64))
    _require_positive(profile, length)
    return profile


def _joined(length: float, samples: Array) -> Profile:
    """PCHIP through radius samples, (n,) or (n, 2)."""
    if samples.ndim == 1 and samples.size >= 2:
        s, r = np.linspace(0.0, length, samples.size), samples
    elif samples.ndim == 2 and samples.shape[1] == 2 and len(samples) >= 2:
        s, r = samples.T
    else:
        raise ValueError(
            f"radius has shape {samples.shape}; a function of arc length, at least 2 radii (n,) "
            "equally spaced from base to tip, or at least 2 pairs (n, 2) of arc length and radius "
            "are allowed"
        )
    if not (np.isfinite(samples).all() and (np.diff(s) > 0.0).all()):
        raise ValueError("radius samples must be finite, at increasing arc lengths")
    if s[0] > COVERAGE * length or s[-1] < (1.0 - COVERAGE) * length:
        raise ValueError(
            f"radius samples reach from {s[0]:.4g} to {s[-1]:.4g} m; they must cover the whisker "
            f"from 0 to {length:.4g} m"
        )
    if not (r > 0.0).all():
        raise ValueError(f"radius is {r.min():.4g} m at sample {r.argmin()}; it must be positive")
    cubic = PchipInterpolator(s, r)
    joints = np.concatenate([[0.0], s[(s > 1e-9 * length) & (s < (1 - 1e-9) * length)], [length]])
    return approximate(lambda x: np.asarray(cubic(np.clip(x, s[0], s[-1]))), joints)


def _require_positive(profile: Profile, length: float) -> None:
    fine = np.concatenate([np.linspace(0.0, length, 2001), profile.knots])
    values = profile(fine)
    if not (values > 0.0).all():
        worst = int(values.argmin())
        raise ValueError(
            f"radius is {values[worst]:.4g} m at arc length {fine[worst]:.4g} m; it must be "
            "positive from base to tip"
        )

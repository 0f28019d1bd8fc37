"""Cross-section and material of a whisker, which determine its stiffness.

A circular section of radius r(s), of one isotropic material:

    B(s) = diag(GJ, EI, EI),    I = π r⁴ / 4,    J = 2 I,    G = E / (2 (1 + ν))

By default r decreases linearly from base to tip. Sampled radii are interpolated by monotone cubics
between the jumps and kinks found in them (`vibrissa.whisker.profile`).
"""

from collections.abc import Callable, Container, Sequence
from typing import TypedDict, Unpack, cast

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.whisker.morphology import published_note, published_radii
from vibrissa.whisker.profile import (
    JUMP,
    UNRESOLVED,
    Profile,
    approximate,
    array_function,
    linear,
    sampled_radius,
    scatter,
)

BASE_RADIUS = 100e-6
TAPER = 15.0
YOUNGS_MODULUS = 3e9
POISSON_RATIO = 0.38

# Young's moduli from a gel that can hold a rod to diamond, Pa; values outside are assumed to be in
# another unit: 3000 MPa is usual, stated as Pa or as GPa.
_SOFTEST, _HARDEST = 1e4, 2e12
# Densities from a foam to osmium, kg/m³.
_LIGHTEST, _HEAVIEST = 10.0, 23000.0
SHORTEST, LONGEST = 0.5e-3, 0.5
"""Shortest and longest length, m, accepted without confirmation."""

# Ways to confirm other lengths.
CONFIRMATION = "any_length=True (Python) or --any-length (command line)"
# Bounds of the largest radius of a rod, over its length; that of a carbon fibre of 10 cm is 3e-5.
_THIN, _STOUT = 1e-5, 0.1

# Scatter of samples, as a share of the radius, above which there is a note; and error of the base
# signals of a rod through samples that scatter, in units of the scatter.
_NOTABLE_SCATTER, _SIGNAL_ERROR = 2e-3, 0.04

COVERAGE = 0.01  # largest distance of radius samples from base or tip, over the length


class Section(TypedDict, total=False):
    """Keywords for the radius, and for kinks and jumps of it or the curvature."""

    base_radius: float
    tip_radius: float | None
    radius: Callable[..., object] | ArrayLike | None
    breaks: Sequence[float]
    rat: str | None


class Holding(TypedDict, total=False):
    """Keywords for the material, the stiffness of the base, and a name."""

    youngs_modulus: float
    poisson_ratio: float
    density: float | None
    base_stiffness: tuple[float, float] | None
    name: str


class Properties(Section, Holding, total=False):
    """Keywords accepted by every constructor of a whisker."""

    any_length: bool


def split(properties: Properties) -> tuple[Section, Holding]:
    """Separate the keywords for the radius from the others."""
    section = {key: value for key, value in properties.items() if key in _SECTION_KEYS}
    others = {
        key: value
        for key, value in properties.items()
        if key not in _SECTION_KEYS and key != "any_length"
    }
    return cast(Section, section), cast(Holding, others)


_SECTION_KEYS = Section.__optional_keys__
_BEYOND = 10.0  # samples up to this many lengths may belong to a whisker before it was trimmed
# Ending of a note on an assumed property.
ASSUMED = " assumed, not measured"
_RADIUS_ASSUMED = f"radius{ASSUMED}"
# A modulus, Pa, below which materials are nearly incompressible, and their least Poisson's ratio;
# stiffness of a base, relative to EI/L, that no whisker turns noticeably.
_GEL, _INCOMPRESSIBLE, _RIGID = 1e6, 0.45, 1e6
_NOTED = {"youngs_modulus": "Young's modulus", "poisson_ratio": "Poisson's ratio"}


def parse_properties(
    length: float, properties: Properties
) -> tuple[Profile, Holding, tuple[str, ...]]:
    """Convert a constructor's keywords to radius profile, checked material, and notes."""
    stated, holding = split(properties)
    faults = material_faults(
        holding.get("youngs_modulus", YOUNGS_MODULUS),
        holding.get("poisson_ratio", POISSON_RATIO),
        holding.get("base_stiffness"),
        holding.get("density"),
    )
    try:
        section = radius_profile(length, **stated)
    except ValueError as fault:
        raise ValueError("no whisker: " + "; ".join([*faults, str(fault)])) from None
    if faults:
        raise ValueError("no whisker: " + "; ".join(faults))
    return section, holding, radius_notes(length, section, stated)


def doubtful_units(
    stated: Container[str],
    youngs_modulus: float,
    poisson_ratio: float,
    base_stiffness: tuple[float, float] | None,
    bending: float,
) -> list[str]:
    """Doubts about a modulus and a base stiffness that are possible, but are rather in other units.

    The base stiffness is compared with EI/L, `bending`.
    """
    doubts = []
    if "youngs_modulus" in stated and youngs_modulus < _GEL and poisson_ratio < _INCOMPRESSIBLE:
        doubts.append(
            f"youngs_modulus is {youngs_modulus:.4g} Pa, as of a gel or soft silicone (then state "
            f"its poisson_ratio, above {_INCOMPRESSIBLE:g}): is it in MPa? Steel has 200e9 Pa"
        )
    least = 0.0 if base_stiffness is None else min(base_stiffness)
    if "base_stiffness" in stated and least > _RIGID * bending:
        doubts.append(
            f"base_stiffness is {least:.4g} N·m/rad, {least / bending:.0e} times that of the "
            "whisker, so that the base is rigid: is it in µN·m?"
        )
    return doubts


def assumptions(length: float, section: Profile, properties: Properties) -> tuple[str, ...]:
    """Notes on the properties of a measured whisker that were not given and are assumed."""
    notes = []
    stated = {name for name, value in properties.items() if value is not None}
    if not stated & {"radius", "base_radius", "rat"}:
        notes.append(_assumed_radius(length, section))
    elif not stated & {"radius", "tip_radius", "rat"}:
        notes.append(f"radius of the tip{ASSUMED}: the base's over {TAPER:g}")
    if "youngs_modulus" not in stated:
        notes.append(
            f"Young's modulus{ASSUMED}: {YOUNGS_MODULUS * 1e-9:g} GPa; forces are "
            "proportional to it"
        )
    if "poisson_ratio" not in stated:
        notes.append(f"Poisson's ratio{ASSUMED}: {POISSON_RATIO:g}")
    return tuple(notes)


def _assumed_radius(length: float, section: Profile) -> str:
    """Note on the assumed radius."""
    base, tip = float(section(0.0)) * 1e6, float(section(length, "left")) * 1e6
    return (
        f"{_RADIUS_ASSUMED}: {base:.4g} µm at the base, {tip:.3g} µm at the tip; forces scale "
        "with its fourth power. --rat C2 (in Python rat=) uses published regressions instead, by "
        "row and column of a rat's whisker or by its length"
    )


def kept_notes(notes: Sequence[str], properties: Section | Holding) -> tuple[str, ...]:
    """Omit the notes on properties that are given anew."""
    about = []
    if stated := properties.keys() & _SECTION_KEYS - {"breaks"}:
        about += ["radius of the tip", "the radius", "the tip"]
    if stated - {"tip_radius"}:
        about.append("radius")
    about += [begin for name, begin in _NOTED.items() if name in properties]
    return tuple(note for note in notes if not note.startswith(tuple(about)))


def renewed_notes(notes: Sequence[str], length: float, section: Profile) -> tuple[str, ...]:
    """Update notes on the assumed radius after the radius or the length was changed."""
    return tuple(
        _assumed_radius(length, section) if note.startswith(_RADIUS_ASSUMED) else note
        for note in notes
    )


def radius_notes(length: float, section: Profile, stated: Section) -> tuple[str, ...]:
    """Notes on a radius that the user should read."""
    notes = []
    if (rat := stated.get("rat")) is not None:
        notes.append(published_note(rat, length))
    if section(length, "left") > section(0.0) * (1.0 + 1e-9):
        notes.append("the tip is thicker than the base")
    if section.error > UNRESOLVED:
        notes.append(
            f"the radius is approximated to {section.error:.1e} of its largest value only; it has "
            "kinks or jumps that should be stated as breaks"
        )
    radius = stated.get("radius")
    if radius is None or callable(radius):
        return tuple(notes)
    breaks = section.breaks()
    change = np.abs(section(breaks) / section(breaks, "left") - 1.0)
    steps = change[change > JUMP]
    if steps.size:
        notes.append(
            f"the radius jumps at {steps.size} arc lengths, by up to {steps.max():.1%}: these are "
            "treated as steps of the rod, not smoothed"
        )
    noise = scatter(*_as_samples(length, np.asarray(radius, dtype=np.float64)))
    if noise > _NOTABLE_SCATTER:
        notes.append(
            f"the radius samples scatter by {noise:.2g} of the radius, and forces scale with "
            f"its fourth power; signals follow the samples to about {_SIGNAL_ERROR * noise:.0e}"
        )
    return tuple(notes)


def material_faults(
    youngs_modulus: float,
    poisson_ratio: float,
    base_stiffness: tuple[float, float] | None,
    density: float | None,
) -> list[str]:
    """List the faults of a material and of the base stiffness."""
    given = {"youngs_modulus": youngs_modulus, "poisson_ratio": poisson_ratio, "density": density}
    faults = [
        f"{name} is {value!r}; one number is needed"
        for name, value in given.items()
        if value is not None and not (np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf")
    ]
    if faults:
        return faults
    if not (np.isfinite(youngs_modulus) and youngs_modulus > 0.0):
        faults.append(f"youngs_modulus is {youngs_modulus!r} Pa; it must be positive")
    elif not _SOFTEST <= youngs_modulus <= _HARDEST:
        faults.append(
            f"youngs_modulus is {youngs_modulus:.4g} Pa; materials from gels to diamond are "
            f"between {_SOFTEST:.0e} and {_HARDEST:.0e}: is it in Pa? 1 MPa is 1e6, 1 GPa 1e9"
        )
    if density is not None and not (np.isfinite(density) and density > 0.0):
        faults.append(f"density is {density!r} kg/m³; it must be positive, or None if not known")
    elif density is not None and not _LIGHTEST <= density <= _HEAVIEST:
        faults.append(
            f"density is {density:.4g} kg/m³; materials from foams to osmium are between "
            f"{_LIGHTEST:g} and {_HEAVIEST:g}: is it in kg/m³? 1 g/cm³ is 1000"
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


def length_faults(length: float, any_length: bool | None = False) -> list[str]:
    """List the faults of a length."""
    if np.ndim(length) or np.asarray(length).dtype.kind not in "fiu":
        return [f"length is of type {type(length).__name__}; a number is needed, m"]
    if not (np.isfinite(length) and length > 0.0):
        return [f"length is {length!r} m; it must be positive"]
    if any_length or SHORTEST <= length <= LONGEST:
        return []
    if length > LONGEST:
        fault = (
            f"length is {length:.4g} m, longer than the {LONGEST:g} m of any whisker: these look "
            "like millimetres given as metres, or micrometres as millimetres; multiply by 1e-3"
            if length <= 1e3 * LONGEST
            else f"length is {length:.4g} m, longer than the {LONGEST:g} m of any whisker: these "
            "look like micrometres or pixels given as metres; lengths are given in m"
        )
    else:
        fault = (
            f"length is {length:.4g} m, shorter than the {SHORTEST * 1e3:g} mm of any whisker: "
            "these look like metres given as millimetres, or converted once too often; lengths are "
            "given in m"
        )
    return [f"{fault}. If a rod of this length is meant, say so: {CONFIRMATION}"]


def radius_profile(length: float, **stated: Unpack[Section]) -> Profile:
    """Radius over arc length, from any of its specifications, of plausible size."""
    section = _stated_profile(length, **stated)
    thickest = float(section(np.linspace(0.0, length, 101)).max())
    if thickest > _STOUT * length:
        raise ValueError(
            f"the radius is up to {thickest:.4g} m at a length of {length:.4g} m, more than a "
            "tenth of it: these look like millimetres given as metres; multiply by 1e-3"
        )
    if thickest < _THIN * length:
        raise ValueError(
            f"the radius is at most {thickest:.4g} m at a length of {length:.4g} m, less than "
            f"{_THIN:.0e} of it: these look like millimetres given as micrometres, or converted "
            "once too often; multiply by 1e3"
        )
    return section


def _stated_profile(
    length: float,
    base_radius: float | None = None,
    tip_radius: float | None = None,
    radius: Callable[..., object] | ArrayLike | None = None,
    breaks: Sequence[float] = (),
    rat: str | None = None,
) -> Profile:
    """Radius over arc length, from any of its specifications."""
    if rat is not None:
        if not all(other is None for other in (radius, tip_radius, base_radius)):
            raise ValueError("rat and a radius were both given; give one of them")
        return linear(*published_radii(rat, length), length)
    if radius is None:
        bad = [
            f"{what} is {value!r} m; it must be positive"
            for what, value in (("base_radius", base_radius), ("tip_radius", tip_radius))
            if value is not None and not (np.isfinite(value) and value > 0.0)
        ]
        if bad:
            raise ValueError("; ".join(bad))
        base = BASE_RADIUS if base_radius is None else base_radius
        return linear(
            float(base), float(base / TAPER if tip_radius is None else tip_radius), length
        )
    if not (tip_radius is None and base_radius is None):
        raise ValueError("radius and a radius of base or tip were both given; give one of them")
    if callable(radius):
        function = array_function(radius, (), "radius")
        profile = approximate(function, np.unique([0.0, *breaks, length]))
    else:
        profile = _profile_of_samples(length, np.asarray(radius, dtype=np.float64))
    _require_positive(profile, length)
    return profile


def _as_samples(length: float, samples: Array) -> tuple[Array, Array]:
    """Arc lengths and radii of samples given as (n,) or (n, 2)."""
    if samples.ndim == 1 and samples.size >= 2:
        return np.linspace(0.0, length, samples.size), samples
    if samples.ndim == 2 and samples.shape[1] == 2 and len(samples) >= 2:
        return samples[:, 0], samples[:, 1]
    raise ValueError(
        f"radius has shape {samples.shape}; a function of arc length, at least 2 radii (n,) "
        "equally spaced from base to tip, or at least 2 pairs (n, 2) of arc length and radius "
        "are allowed"
    )


def _profile_of_samples(length: float, samples: Array) -> Profile:
    """Profile through radius samples, (n,) or (n, 2)."""
    s, r = _as_samples(length, samples)
    steps = np.diff(s)
    twice = np.flatnonzero(steps == 0.0)
    if not (np.isfinite(samples).all() and (steps >= 0.0).all()):
        raise ValueError("radius samples must be finite, at increasing arc lengths")
    if (np.diff(twice) == 1).any() or np.isin(twice, (0, steps.size - 1)).any():
        raise ValueError(
            "radius samples may state two radii at an arc length where the radius jumps, but not "
            "three, nor at base or tip"
        )
    if s[0] > COVERAGE * length or s[-1] < (1.0 - COVERAGE) * length:
        raise ValueError(
            f"radius samples reach from {s[0]:.4g} to {s[-1]:.4g} m; they must cover the whisker "
            f"from 0 to {length:.4g} m"
        )
    if s[-1] > _BEYOND * length:
        raise ValueError(
            f"radius samples reach to {s[-1]:.4g} m, on a whisker of {length:.4g} m: arc lengths "
            "are in m, not in mm or shares of the length"
        )
    if not (r > 0.0).all():
        raise ValueError(f"radius is {r.min():.4g} m at sample {r.argmin()}; it must be positive")
    return sampled_radius(length, s, r)


def _require_positive(profile: Profile, length: float) -> None:
    """Raise a ValueError if the radius is not positive everywhere."""
    fine = np.concatenate([np.linspace(0.0, length, 2001), profile.knots])
    values = profile(fine)
    if not (values > 0.0).all():
        worst = int(values.argmin())
        raise ValueError(
            f"radius is {values[worst]:.4g} m at arc length {fine[worst]:.4g} m; it must be "
            "positive from base to tip"
        )

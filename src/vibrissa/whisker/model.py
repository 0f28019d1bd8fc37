"""The whisker: a thin rod with an intrinsic curvature, a radius and a material.

    R' = R [u₀(s)]ₓ,    r' = R e₁,    B(s) = diag(GJ, EI, EI),    I = π r(s)⁴ / 4

u₀ = (twist, curvature about d1, curvature about d2), with R' e₁ = R (0, u_z, −u_y): u_z > 0 bends
toward +y, u_y > 0 toward −z. All data are numbers: piecewise polynomials over arc length, so that
any whisker can be pickled, stored and sent to another machine.

The whisker frame has its origin at the base and x along the base tangent; the proximal 70 % of the
whisker lies as close as possible to the x–y plane and bends toward +y.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import xr
from vibrissa.numerics import Array, numbers
from vibrissa.quantities import quantity
from vibrissa.sketch import BENT, Mark, card, shown, views
from vibrissa.whisker.dataset import Stored, check_centerline, whisker_dataset, whisker_fields
from vibrissa.whisker.digitise import digitize
from vibrissa.whisker.pose import Pose, least_turn, roll
from vibrissa.whisker.profile import (
    UNRESOLVED,
    Path,
    Profile,
    Side,
    approximate,
    array_function,
    constant,
    parabola_curvature,
    proximal_roll,
)
from vibrissa.whisker.section import (
    ASSUMED,
    POISSON_RATIO,
    YOUNGS_MODULUS,
    Properties,
    assumptions,
    doubtful_units,
    kept_notes,
    length_faults,
    material_faults,
    parse_properties,
    radius_notes,
    radius_profile,
    renewed_notes,
    split,
)

ROUNDING = 1e-9
"""Largest distance, over the length, of an arc length outside the whisker that is clipped."""

_SLIGHT = 2.5e-3  # coefficient of a parabola times length below which it may be per mm
STRAIGHT = 1e-9  # curvature times length below which a whisker counts as straight

PROXIMAL = 0.7
"""Proximal share of the whisker that defines the direction of y."""

STRAIGHT_NOTE = (
    "straight: its curvature does not define a roll about its axis, so the roll is the one that "
    "turns its source frame least"
)


@dataclass(frozen=True, eq=False, repr=False)
class Whisker:
    """A whisker, or any slender clamped rod, at rest.

    Create one with `from_points`, `parabola`, `straight` or `from_curvature`. These all accept the
    keywords listed under Other Parameters.

    Parameters
    ----------
    length : float
        Arc length from base to tip, m.
    intrinsic_curvature : Profile
        u₀(s), values (3,): twist, curvature about d1, curvature about d2, 1/m.
    section_radius : Profile
        Radius r(s), m.
    youngs_modulus : float
        E, Pa.
    poisson_ratio : float
        ν, in (−1, 0.5].
    density : float, optional
        Density of the material, kg/m³, for its weight; None if unknown.
    base_stiffness : tuple of float, optional
        Rotational stiffness of the base (bending, twist), N·m/rad; None is a rigid clamp.
    pose : Pose
        Pose of the whisker frame in its source frame.
    breaks : tuple of float
        Arc lengths inside the whisker, m, at which curvature or radius has a kink or a jump.
    name : str
        Name for messages and figures.
    notes : tuple of str
        Remarks for the user on how the whisker was created.

    Other Parameters
    ----------------
    base_radius, tip_radius : float
        Radii at base (default 100 µm) and tip (default: a fifteenth of the base's), m; linear in
        between.
    radius : callable or array
        Any other radius: r(s), radii (n,) equally spaced from base to tip, or pairs (n, 2) of arc
        length and radius, m; two pairs at one arc length state a jump. It replaces base_radius.
    rat : str
        Row and column of a rat's whisker, such as ``"C2"``, or ``"any"`` where only its length is
        known: radii by published regressions (Belli et al. 2017), instead of all other radii.
    any_length : bool
        Whether to accept a length below 0.5 mm or above 0.5 m, as of rods of robots; by default it
        is rejected as a likely error of units. A slight curvature is not questioned then either.
    breaks : sequence of float
        Arc lengths, m, at which curvature or radius has a kink or a jump. Those of sampled radii
        and, as far as they exceed the noise, of functions are detected.

    Examples
    --------
    >>> Whisker.straight(length=40e-3)
    Whisker 'straight': 40.00 mm long, radius 100.0 µm at the base and 6.7 µm at the tip, straight
    """

    length: float
    intrinsic_curvature: Profile
    section_radius: Profile
    youngs_modulus: float = YOUNGS_MODULUS
    poisson_ratio: float = POISSON_RATIO
    density: float | None = None
    base_stiffness: tuple[float, float] | None = None
    pose: Pose = field(default_factory=Pose)
    breaks: tuple[float, ...] = ()
    name: str = "whisker"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        faults = length_faults(self.length, any_length=True)
        faults += material_faults(
            self.youngs_modulus, self.poisson_ratio, self.base_stiffness, self.density
        )
        faults += _break_faults(self.breaks, self.length)
        for what, profile, shape in (
            ("intrinsic_curvature", self.intrinsic_curvature, (3,)),
            ("section_radius", self.section_radius, ()),
        ):
            if profile.shape != shape:
                faults.append(f"{what} has values of shape {profile.shape}; {shape} is needed")
            elif profile.knots[0] != 0.0 or profile.knots[-1] < self.length * (1.0 - ROUNDING):
                faults.append(f"{what} does not reach from 0 to {self.length!r} m")
        if faults:
            raise ValueError("no whisker: " + "; ".join(faults))
        if (stiffness := self.base_stiffness) is not None:
            object.__setattr__(self, "base_stiffness", tuple(float(value) for value in stiffness))
        if self.density is not None:
            object.__setattr__(self, "density", float(self.density))
        for what in ("length", "youngs_modulus", "poisson_ratio"):
            object.__setattr__(self, what, float(getattr(self, what)))
        object.__setattr__(self, "breaks", tuple(sorted(float(s) for s in self.breaks)))
        object.__setattr__(self, "notes", tuple(self.notes))

    # Constructors.

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        *,
        noise: float | None = None,
        base: str | ArrayLike | None = None,
        **properties: Unpack[Properties],
    ) -> Whisker:
        """Create a whisker from a digitised centreline.

        Parameters
        ----------
        points : array (n, 3) or (n, 2)
            At least 4 points in order along the whisker, m, in any frame and at any spacing; two
            columns mean z = 0.
        noise : float, optional
            Standard deviation of a coordinate, m; 0 for interpolation. By default it is
            estimated by cross-validation.
        base : {"first", "last"} or array (3,) or (2,), optional
            End that is the base: by name, or a point near it. By default the first.
        **properties
            Radius and material; see `Whisker`.

        Returns
        -------
        Whisker
            Whisker in its own frame; its pose maps it to the points' frame.

        Raises
        ------
        ValueError
            If the points are not a centreline, with a list of all faults.
        """
        shape = digitize(points, noise, base, properties.get("any_length", False))
        notes: tuple[str, ...] = ()
        if noise is None:
            notes += (
                f"the noise of its points was estimated at {shape.noise * 1e3:.2g} mm (standard "
                "deviation per coordinate) by cross-validation",
            )
        whisker = _assemble(shape.length, shape.curvature, shape.pose, properties, notes)
        assumed = assumptions(whisker.length, whisker.section_radius, properties)
        return replace(whisker, notes=whisker.notes + assumed).aligned()

    @classmethod
    def parabola(
        cls, length: float, coefficient: float, **properties: Unpack[Properties]
    ) -> Whisker:
        """Create a planar whisker on the parabola y = A x².

        Parameters
        ----------
        length : float
            Arc length, m.
        coefficient : float
            A, 1/m. With a negative one the whisker bends to −y of the source frame; the whisker
            frame is then rotated by 180° about x, as the pose records, and it bends to +y.
        **properties
            Radius and material; see `Whisker`.

        Returns
        -------
        Whisker

        Warns
        -----
        UserWarning
            If the curve is so slight that the coefficient may be in 1/mm.
        """
        faults = length_faults(length, properties.get("any_length"))
        if not np.isfinite(coefficient):
            faults.append(f"coefficient is {coefficient!r}; it must be a finite number, in 1/m")
        if faults:
            raise ValueError("no parabola: " + "; ".join(faults))
        if 0.0 < abs(coefficient) * length < _SLIGHT:
            warnings.warn(
                f"the coefficient of the parabola is {coefficient:g} per m, which bends a whisker "
                f"of {1e3 * length:.4g} mm by {np.degrees(2.0 * abs(coefficient) * length):.2g}°: "
                "is it per mm, as in the literature (multiply by 1000)?",
                stacklevel=2,
            )
        curvature = parabola_curvature(length, abs(float(coefficient)))
        pose = Pose(np.diag([1.0, -1.0, -1.0])) if coefficient < 0.0 else Pose()
        properties.setdefault("name", "parabola")
        return _assemble(length, curvature, pose, properties)

    @classmethod
    def straight(cls, length: float, **properties: Unpack[Properties]) -> Whisker:
        """Create a straight whisker.

        Parameters
        ----------
        length : float
            Length, m.
        **properties
            Radius and material; see `Whisker`.

        Returns
        -------
        Whisker
        """
        if faults := length_faults(length, properties.get("any_length")):
            raise ValueError("no straight whisker: " + "; ".join(faults))
        properties.setdefault("name", "straight")
        return _assemble(length, constant(np.zeros(3), length), Pose(), properties)

    @classmethod
    def from_curvature(
        cls, length: float, curvature: Callable[..., object], **properties: Unpack[Properties]
    ) -> Whisker:
        """Create a whisker from its intrinsic curvature.

        Parameters
        ----------
        length : float
            Arc length, m.
        curvature : callable
            Function of arc lengths, m (an array, or one at a time), that returns (..., 3): twist,
            curvature about d1, curvature about d2, 1/m.
        **properties
            Radius, material and breaks; see `Whisker`.

        Returns
        -------
        Whisker
            Whisker in the frame in which the curvature is given, whichever way it bends; `aligned`
            rolls it so that it bends to +y.
        """
        faults = length_faults(length, properties.get("any_length"))
        if not callable(curvature):
            got = type(curvature).__name__
            faults.append(f"curvature is of type {got}; a function of arc length is needed")
        breaks = properties.get("breaks", ())
        if faults := faults or _break_faults(breaks, length):
            raise ValueError("no whisker from curvature: " + "; ".join(faults))
        joints = np.unique([0.0, *breaks, length])
        profile = approximate(array_function(curvature, (3,), "curvature"), joints)
        notes: tuple[str, ...] = ()
        if profile.error > UNRESOLVED:
            notes += (
                f"the curvature is approximated to {profile.error:.1e} of its largest value only; "
                "it has kinks or jumps that should be stated as breaks",
            )
        whisker = _assemble(length, profile, Pose(), properties, notes)
        most = np.abs(whisker.curvature(np.linspace(0.0, length, 101))).max()
        if STRAIGHT < most * length < 2.0 * _SLIGHT and not properties.get("any_length"):
            warnings.warn(
                f"the curvature is {most:.3g} per m at most, which bends a whisker of "
                f"{1e3 * length:.4g} mm by less than {np.degrees(most * length):.2g}°: is it per "
                "mm (multiply by 1000)?",
                stacklevel=2,
            )
        if not whisker.is_straight and abs(whisker._proximal_roll()) > np.pi / 2:
            note = "its proximal part bends toward −y in the frame its curvature was stated in"
            whisker = replace(whisker, notes=(*whisker.notes, note))
        return whisker

    # Properties and geometry.

    @property
    def base_radius(self) -> float:
        """Radius at the base, m."""
        return float(self.section_radius(0.0))

    @property
    def tip_radius(self) -> float:
        """Radius at the tip, m."""
        return float(self.section_radius(self.length, "left"))

    @property
    def base_bending_stiffness(self) -> float:
        """E π r⁴ / 4 at the base, N·m²."""
        return self.youngs_modulus * np.pi * self.base_radius**4 / 4.0

    @property
    def mass(self) -> float:
        """Mass, kg; NaN where the density is not known."""
        knots = np.unique(np.clip(self.section_radius.knots, 0.0, self.length))
        middle, half = 0.5 * (knots[1:] + knots[:-1]), 0.5 * np.diff(knots)
        at, weight = np.polynomial.legendre.leggauss(8)
        area = np.pi * self.radius(middle[:, None] + half[:, None] * at) ** 2
        density = np.nan if self.density is None else self.density
        return float(density * (half * (area @ weight)).sum())

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of the properties that are assumed, such as ``radius``; see the notes."""
        return tuple(note.split(ASSUMED)[0] for note in self.notes if ASSUMED in note)

    @cached_property
    def is_straight(self) -> bool:
        """Whether its bending curvature is zero everywhere."""
        bending = np.abs(self.intrinsic_curvature.coefficients[..., 1:]).max()
        return bool(bending * self.length < STRAIGHT)

    def curvature(self, s: ArrayLike, side: Side = "right") -> Array:
        """Intrinsic curvature u₀ at arc lengths.

        Parameters
        ----------
        s : array (...)
            Arc lengths from the base, m.
        side : {"right", "left"}
            Side from which the value is taken where the curvature jumps.

        Returns
        -------
        array (..., 3)
            Twist, curvature about d1, curvature about d2, 1/m.
        """
        return self.intrinsic_curvature(self._inside(s), side)

    def radius(self, s: ArrayLike, side: Side = "right") -> Array:
        """Radius of the section at arc lengths.

        Parameters
        ----------
        s : array (...)
            Arc lengths from the base, m; NaN gives NaN.
        side : {"right", "left"}
            Side from which the value is taken where the radius jumps.

        Returns
        -------
        array (...)
            Radii, m.
        """
        return self.section_radius(self._inside(s), side)

    def position(self, s: ArrayLike) -> Array:
        """Points of the resting whisker at arc lengths.

        Parameters
        ----------
        s : array (...)
            Arc lengths from the base, m; NaN gives NaN.

        Returns
        -------
        array (..., 3)
            Points, m, whisker frame.
        """
        return self._rest.at(self._inside(s))[1]

    def frame(self, s: ArrayLike) -> Array:
        """Material frames of the resting whisker at arc lengths.

        Parameters
        ----------
        s : array (...)
            Arc lengths from the base, m; NaN gives NaN.

        Returns
        -------
        array (..., 3, 3)
            Columns are tangent, d1 and d2 in the whisker frame.
        """
        return self._rest.at(self._inside(s))[0]

    def centerline(self, n: int = 101) -> Array:
        """Points of the resting whisker, equally spaced in arc length.

        Parameters
        ----------
        n : int
            Number of points, base and tip included.

        Returns
        -------
        array (n, 3)
            Points, m, whisker frame.
        """
        if n < 2:
            raise ValueError(f"a centreline of {n} points was asked for; at least 2 are needed")
        return self.position(np.linspace(0.0, self.length, n))

    @cached_property
    def _rest(self) -> Path:
        """Integrated resting shape."""
        knots = self.intrinsic_curvature.knots
        joints = np.append(knots[knots < self.length * (1.0 - ROUNDING)], self.length)
        return Path.integrate(self.intrinsic_curvature, joints, (1.0, 0.0, 0.0))

    def _inside(self, s: ArrayLike) -> Array:
        """Arc lengths clipped to the whisker; raise a ValueError if they are outside it."""
        s = numbers("arc_length", s)
        slack = ROUNDING * self.length
        if (s < -slack).any() or (s > self.length + slack).any():
            raise ValueError(
                f"arc lengths from {np.nanmin(s):.6g} to {np.nanmax(s):.6g} m were asked for; the "
                f"whisker reaches from 0 to {self.length:.6g} m"
            )
        return np.asarray(np.clip(s, 0.0, self.length))

    def _proximal_roll(self) -> float:
        """Roll that aligns the proximal part with the x–y plane."""
        count = 256
        s = (np.arange(count) + 0.5) * (PROXIMAL * self.length / count)
        return proximal_roll(self.position(s), np.full(count, PROXIMAL * self.length / count))

    # Modified whiskers.

    def aligned(self) -> Whisker:
        """Roll the frame so that the proximal 70 % lies in the x–y plane and bends toward +y.

        Returns
        -------
        Whisker
            The same rod; its pose gets the opposite roll, so that it is unchanged in the source
            frame. The axes of a straight whisker are rotated as close as possible to those of the
            source frame.
        """
        if self.is_straight:
            nearest = least_turn(self.pose.rotation[:, 0])
            turn = self.pose.rotation.T @ nearest
            notes = self.notes if STRAIGHT_NOTE in self.notes else (*self.notes, STRAIGHT_NOTE)
        else:
            turn, notes = roll(self._proximal_roll()), self.notes
        return replace(
            self,
            intrinsic_curvature=self.intrinsic_curvature.transformed(turn.T),
            pose=Pose(self.pose.rotation @ turn, self.pose.origin),
            notes=notes,
        )

    def with_properties(self, **properties: Unpack[Properties]) -> Whisker:
        """Return a whisker of the same shape with other radius, material, base stiffness or name.

        Parameters
        ----------
        **properties
            Properties to change; see `Whisker`. Others are kept.

        Returns
        -------
        Whisker
        """
        stated, holding = split(properties)
        whisker = self
        if stated:
            if stated.get("radius") is None and stated.get("rat") is None:
                stated.setdefault("base_radius", self.base_radius)
            own = set(self.section_radius.breaks()) - set(self.intrinsic_curvature.breaks())
            kept = {s for s in self.breaks if s not in own} | {*stated.get("breaks", ())}
            stated["breaks"] = sorted(kept)
            section = radius_profile(self.length, **stated)
            breaks = _merge_breaks(kept, section.breaks(), self.length)
            notes = renewed_notes(kept_notes(self.notes, properties), self.length, section)
            notes += radius_notes(self.length, section, stated)
            whisker = replace(whisker, section_radius=section, breaks=breaks, notes=notes)
        whisker = replace(whisker, notes=kept_notes(whisker.notes, holding), **holding)
        return whisker._questioned(holding, stacklevel=3)

    def _questioned(self, stated: Container[str], stacklevel: int) -> Whisker:
        """Return this whisker after a warning of properties that seem to be in other units.

        A radius of curvature below that of the section is impossible.
        """
        s = np.linspace(0.0, self.length, 101)
        sharp = np.linalg.norm(self.curvature(s)[:, 1:], axis=1) * self.radius(s)
        if sharp[at := int(sharp.argmax())] > 1.0:
            warnings.warn(
                f"at {1e3 * s[at]:.3g} mm the radius of curvature is {1.0 / sharp[at]:.2g} of the "
                "whisker's radius, which no rod has: are curvature and radius in SI units?",
                stacklevel=stacklevel,
            )
        bending = self.base_bending_stiffness / self.length
        properties = self.youngs_modulus, self.poisson_ratio, self.base_stiffness
        for doubt in doubtful_units(stated, *properties, bending):
            warnings.warn(doubt, stacklevel=stacklevel)
        return self

    def trimmed(self, length: float) -> Whisker:
        """Cut off the tip, without a change of shape or radius of the rest.

        Parameters
        ----------
        length : float
            Arc length to keep, m.

        Returns
        -------
        Whisker
        """
        if not 0.0 < length <= self.length:
            raise ValueError(
                f"length to keep is {length!r} m; it must be positive and at most {self.length!r} m"
            )
        section = self.section_radius.trimmed(length)
        return replace(
            self,
            length=length,
            intrinsic_curvature=self.intrinsic_curvature.trimmed(length),
            section_radius=section,
            notes=renewed_notes(self.notes, length, section),
            breaks=tuple(s for s in self.breaks if s < length),
        )

    def scaled(self, length_factor: float = 1.0, radius_factor: float = 1.0) -> Whisker:
        """Scale the shape, the radius, or both.

        Parameters
        ----------
        length_factor : float
            Factor of all lengths of the centreline; curvature is divided by it.
        radius_factor : float
            Factor of the radius.

        Returns
        -------
        Whisker
            Scaled whisker of the same material, base stiffness and pose.
        """
        for what, value in (("length_factor", length_factor), ("radius_factor", radius_factor)):
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{what} is {value!r}; it must be positive")
        section = self.section_radius.scaled(length_factor, radius_factor)
        return replace(
            self,
            length=self.length * length_factor,
            intrinsic_curvature=self.intrinsic_curvature.scaled(length_factor, 1 / length_factor),
            section_radius=section,
            notes=renewed_notes(self.notes, self.length * length_factor, section),
            breaks=tuple(s * length_factor for s in self.breaks),
        )

    # Conversion.

    def to_dataset(self) -> xr.Dataset:
        """Convert the whisker to a dataset, without loss.

        Returns
        -------
        xarray.Dataset
            Every variable has the attributes `units` and `long_name`.
        """
        return whisker_dataset(self)

    @classmethod
    def from_dataset(cls, dataset: Stored) -> Whisker:
        """Restore a whisker from its dataset.

        Parameters
        ----------
        dataset : xarray.Dataset
            Dataset from `to_dataset`, or an object with its ``variables`` and ``attrs``.

        Returns
        -------
        Whisker

        Raises
        ------
        ValueError
            If a part is missing, or has been modified so that parts contradict each other.
        """
        whisker = cls(**whisker_fields(dataset))
        check_centerline(dataset, whisker)
        return whisker

    def __repr__(self) -> str:
        base = "" if self.base_stiffness is None else ", on a compliant base"
        thicker = " (thicker than the base)" if self.tip_radius > self.base_radius else ""
        bend = "straight"
        if not self.is_straight:
            tangent = self.frame(self.length)[:, 0]
            turned = np.degrees(np.arctan2(np.hypot(*tangent[1:]), tangent[0]))
            bend = f"tip tangent turned by {turned:.0f}°"
        return (
            f"Whisker {self.name!r}: {self.length * 1e3:.2f} mm long, radius "
            f"{self.base_radius * 1e6:.1f} µm at the base and {self.tip_radius * 1e6:.1f} µm at "
            f"the tip{thicker}, {bend}{base}"
        )

    def _repr_html_(self) -> str:
        """Picture of the shape, with size and material."""
        names = ["length", "base_radius", "tip_radius", "youngs_modulus", "poisson_ratio"]
        names += [] if self.density is None else ["density"]
        rows = [(quantity(name).long_name, shown(name, getattr(self, name))) for name in names]
        rows += [("note", note) for note in self.notes]
        picture = views([Mark(self.centerline(81), BENT, width=2.0)])
        return card(f"Whisker: {self.name}", rows, picture)


def _break_faults(breaks: Sequence[float], length: float) -> list[str]:
    """List breaks that are outside the whisker as a fault."""
    outside = [s for s in breaks if not 0.0 < s < length]
    if not outside:
        return []
    return [f"breaks {outside} m; they must lie inside the whisker, between 0 and {length!r} m"]


def _merge_breaks(
    stated: Iterable[float], found: Iterable[float], length: float
) -> tuple[float, ...]:
    """Combine the stated breaks with those detected that are not among them."""
    breaks = [float(s) for s in stated]
    for s in found:
        if all(abs(s - other) > ROUNDING * length for other in breaks):
            breaks.append(float(s))
    return tuple(sorted(breaks))


def _assemble(
    length: float,
    curvature: Profile,
    pose: Pose,
    properties: Properties,
    notes: tuple[str, ...] = (),
) -> Whisker:
    """Create a whisker from a shape, with radius and material from the keywords."""
    stated = properties.get("breaks", ())
    if faults := _break_faults(stated, length):
        raise ValueError("no whisker: " + "; ".join(faults))
    section, holding, remarks = parse_properties(length, properties)
    breaks = _merge_breaks(stated, [*curvature.breaks(), *section.breaks()], length)
    whisker = Whisker(
        length, curvature, section, pose=pose, breaks=breaks, notes=notes + remarks, **holding
    )
    return whisker._questioned(holding, stacklevel=4)

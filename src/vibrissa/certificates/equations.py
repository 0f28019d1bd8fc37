"""The rod's equations as tables of products, and whiskers as exact polynomials.

Non-dimensional (lengths over L, forces over EI/L², EI at the base), backwards from the contact,
t = s_c - s. With b = r/r_base, g = 1/b (a state: ġ = -ḃ g²) and the compliance c = g⁴:

- in space: ṅ = u × n, ṁ = u × m - n × e₁, q̇ = u × q + e₁, u = κ + c∘m (twist: (1 + ν) c m₁),
  from n = (0, f_y, f_z), m = 0 at the contact to F = n, M = m at the base;
- in the plane of a straight whisker, scaled so that rest is regular: F = f², n = f (-fρ, ν),
  m = fμ: ρ̇ = νw, ν̇ = -Fρw, μ̇ = ν, w = cμ, from (0, 1, 0); and q = (x, fη): ẋ = 1 - Fwη, η̇ = wx.

q, which gives the contact point p = q at the base, is needed for the fold only.

Every right-hand side is a sum of products of two variables, so that Taylor coefficients follow by
convolution, and derivatives by an unknown are further such products. A variable is *given* (known
coefficients), *algebraic* (a sum of products of its own order) or a *state* (its derivative is a
sum of products).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

GIVEN, ALGEBRAIC, STATE = range(3)
#: Given variables common to all sets of equations, in this order.
KNOWN = ("k1", "k2", "k3", "b", "db", "one", "twist")
_POLYNOMIALS = 4
# Radius (relative to the largest) of the interval that each coefficient of a rod represents, so
# that a theorem on a whisker holds for the stored one as well as for its textbook values.
_SLACK = Fraction(1, 2**49)


class Program(NamedTuple):
    """Equations in the form used by the kernels: variables as signed sums of products.

    ``constant`` variables have no higher Taylor coefficients; the products of variable v are those
    from first[v] to first[v + 1]; ``groups`` are the states of the values, then of each derivative.
    """

    kind: IntArray
    constant: IntArray
    first: IntArray
    sign: Array
    left: IntArray
    right: IntArray
    groups: IntArray


class ExactRod(NamedTuple):
    """A whisker as polynomials with exact coefficients, each a centre and a radius.

    edges: ends of the n pieces over L, exact rationals rounded to double precision; local: slope
    and offset (n, 4, 2, 2) that map arc length to the polynomials' local variable; coefficients
    (n, 4, d, 2) of the curvatures times L (twist, about d1, about d2) and of the radius over that
    at the base; twist (2,): compliance in twist over that in bending.
    """

    edges: Array
    local: Array
    coefficients: Array
    twist: Array


@dataclass
class Equations:
    """Variables, each with its kind and products, from which a `Program` is built in this order."""

    names: list[str] = field(default_factory=list)
    kinds: list[int] = field(default_factory=list)
    products: dict[str, list[tuple[float, str, str]]] = field(default_factory=dict)

    def add(self, kind: int, name: str, *terms: str) -> None:
        """Add a variable with terms such as ``"u2 n3"``, ``"-u3 n2"`` or ``"c"``."""
        self.names.append(name)
        self.kinds.append(kind)
        parsed = []
        for term in terms:
            left, right = [*term.removeprefix("-").split(), "one"][:2]
            parsed.append((-1.0 if term.startswith("-") else 1.0, left, right))
        self.products[name] = parsed

    def given(self, *names: str) -> None:
        """Add given variables."""
        self.names += names
        self.kinds += [GIVEN] * len(names)

    def differentiate(self, by: str, known: dict[str, str]) -> None:
        """Add derivatives by an unknown of all variables that depend on it."""
        derivative = dict(known)
        fixed = {*KNOWN, "g", "g2", "c", "c1"}
        original = [n for n in self.names if n not in fixed and "_" not in n]
        derivative |= {n: f"{n}_{by}" for n in original if self.kinds[self.names.index(n)] != GIVEN}
        for name in original:
            if name not in self.products:
                continue
            terms = []
            for sign, left, right in self.products[name]:
                mark = "-" if sign < 0.0 else ""
                if left in derivative:
                    terms.append(f"{mark}{derivative[left]} {right}")
                if right in derivative:
                    terms.append(f"{mark}{left} {derivative[right]}")
            self.add(self.kinds[self.names.index(name)], derivative[name], *terms)

    def program(self, states: tuple[str, ...] = (), unknowns: tuple[str, ...] = ()) -> Program:
        """Build the tables; states are differentiated by the unknowns."""
        number = {name: i for i, name in enumerate(self.names)}
        first, flat = [0], []
        for name in self.names:
            flat += self.products.get(name, [])
            first.append(len(flat))
        groups = [[number[n + end] for n in states] for end in ("", *(f"_{u}" for u in unknowns))]
        constant = [
            k == GIVEN and n not in ("k1", "k2", "k3", "b", "db")
            for n, k in zip(self.names, self.kinds, strict=True)
        ]
        return Program(
            np.array(self.kinds, dtype=np.int64),
            np.array(constant, dtype=np.int64),
            np.array(first, dtype=np.int64),
            np.array([sign for sign, _, _ in flat]),
            np.array([number[left] for _, left, _ in flat], dtype=np.int64),
            np.array([number[right] for _, _, right in flat], dtype=np.int64),
            np.array(groups, dtype=np.int64),
        )


def _compliance(out: Equations) -> None:
    """Add the compliance c = b⁻⁴."""
    out.add(STATE, "g", "-db g2")
    out.add(ALGEBRAIC, "g2", "g g")
    out.add(ALGEBRAIC, "c", "g2 g2")


def planar_equations(point: bool) -> Program:
    """Equations of a straight whisker in its plane, with derivatives by s_c and F = f²."""
    out = Equations()
    out.given(*KNOWN)
    out.given("F")
    _compliance(out)
    out.add(ALGEBRAIC, "w", "c m")
    out.add(ALGEBRAIC, "z", "r w")
    out.add(STATE, "r", "n w")
    out.add(STATE, "n", "-F z")
    out.add(STATE, "m", "n")
    if point:
        out.add(ALGEBRAIC, "v", "F w")
        out.add(STATE, "x", "one", "-v e")
        out.add(STATE, "e", "w x")
    out.differentiate("s", {})
    out.differentiate("F", {"F": "one"})
    return out.program(("r", "n", "m", *(("x", "e") if point else ())), ("s", "F"))


def spatial_equations(point: bool) -> Program:
    """Equations of any whisker in space, with derivatives by s_c, f_y and f_z."""
    out = Equations()
    out.given(*KNOWN)
    _compliance(out)
    out.add(ALGEBRAIC, "c1", "c twist")
    for i, compliance in enumerate(("c1", "c", "c"), start=1):
        out.add(ALGEBRAIC, f"u{i}", f"{compliance} m{i}", f"k{i}")
    vectors = {"n": ("", "", ""), "m": ("", "-n3", "n2"), "x": ("one", "", "")}
    if not point:
        del vectors["x"]
    for vector, rest in vectors.items():
        for i, (j, k) in enumerate(((2, 3), (3, 1), (1, 2)), start=1):
            turned = (f"u{j} {vector}{k}", f"-u{k} {vector}{j}")
            out.add(STATE, f"{vector}{i}", *turned, *filter(None, [rest[i - 1]]))
    for unknown in ("s", "y", "z"):
        out.differentiate(unknown, {})
    return out.program(tuple(f"{v}{i}" for v in vectors for i in (1, 2, 3)), ("s", "y", "z"))


def enclose_rational(value: Fraction, slack: Fraction = Fraction(0)) -> tuple[float, float]:
    """Centre and radius in double precision of all numbers within ``slack`` of a rational one."""
    centre = float(value)
    radius = float(abs(value - Fraction(centre)) + slack)
    return centre, float(np.nextafter(radius, np.inf)) if radius else 0.0


def exact_rod(whisker: Whisker) -> ExactRod:
    """Polynomials of a whisker as stored, in units of its length and base radius."""
    if whisker.base_stiffness is not None:
        raise ValueError("certificates are for whiskers on a rigid base; this one's is compliant")
    length, radius = Fraction(whisker.length), Fraction(whisker.base_radius)
    curvature, section = whisker.intrinsic_curvature, whisker.section_radius
    inner = np.unique(np.concatenate([curvature.knots, section.knots]))
    inner = inner[(inner > 0.0) & (inner < whisker.length)]
    knots = [Fraction(0), *map(Fraction, inner.tolist()), length]
    sources = [(curvature, (i,), length) for i in range(3)] + [(section, (), 1 / radius)]
    degree = max(len(curvature.coefficients), len(section.coefficients))
    local = np.zeros((len(knots) - 1, _POLYNOMIALS, 2, 2))
    coefficients = np.zeros((len(knots) - 1, _POLYNOMIALS, degree, 2))
    for p, start in enumerate(knots[:-1]):
        for i, (profile, which, scale) in enumerate(sources):
            j = int(np.searchsorted(profile.knots, float(start), side="right")) - 1
            j = min(max(j, 0), len(profile.knots) - 2)
            low, high = (Fraction(float(x)) for x in profile.knots[j : j + 2])
            local[p, i] = [
                enclose_rational(2 * length / (high - low)),
                enclose_rational(-(low + high) / (high - low)),
            ]
            row = [
                Fraction(float(a)) * scale for a in profile.coefficients[(slice(None), j, *which)]
            ]
            slack = _SLACK * max(map(abs, row))
            coefficients[p, i, : len(row)] = [
                enclose_rational(a, slack if a else Fraction(0)) for a in row
            ]
    return ExactRod(
        np.array([float(one / length) for one in knots]),
        local,
        coefficients,
        np.array(enclose_rational(1 + Fraction(whisker.poisson_ratio))),
    )

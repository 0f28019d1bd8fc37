"""Sign conditions of a certificate, and their enclosure over boxes of contacts.

Boxes are in (s, ℓ) for a straight whisker, with F = f² = ℓ f_max(s)², and in (s, φ, ℓ) for any
other, with f = f_min(s) + (f_max(s, φ) - f_min(s)) ℓ, or f = f_min(s) ℓ for contacts near rest.
With q = 1/s - α and polynomials P_i(s)

    f_min = q² P₀,    f_max = q² (P₁ + P₂ cos φ + P₃ sin φ + P₄ cos² φ).

The proof requires a sign of every condition on each box; conditions are written such that all must
be positive. Quantities computed from the unknowns, and from the states at the base, are tables of
products like the rod's equations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.certificates.equations import (
    ALGEBRAIC,
    Equations,
    ExactRod,
    Program,
    planar_equations,
    spatial_equations,
)
from vibrissa.certificates.flow import enclose, first_piece, set_number
from vibrissa.certificates.forms import (
    COLUMNS_2,
    COLUMNS_3,
    LANES,
    PURE_2,
    PURE_3,
    ROUNDING,
    TINY,
    UP,
    add_product,
    clear,
    close,
    coefficients,
    copy_row,
    reciprocal,
)
from vibrissa.numerics import Array, IntArray, inlined_rigorous, rigorous

#: Conditions for a straight whisker: f_max > 0; μ > 0; ∂ ln M/∂s < 0; ∂(M, R)/∂(s, f) < 0;
#: ∂R/∂f > 0, which is required on the faces only.
PLANAR = ("load", "moment", "moment along s", "determinant", "ratio along the load")
#: Conditions for any whisker: f_min > 0; f_ℓ > 0; ∂g₁/∂s < 0; ∂(g₁, g₂)/∂(s, φ) < 0; the sign of
#: the determinant; ∂g₂/∂φ > 0; the sign of ∂(g₂, g₃)/∂(φ, ℓ). The last two apply to the faces.
SPATIAL = (
    "least load",
    "load",
    "moment along s",
    "moments",
    "determinant",
    "direction",
    "direction and force",
)
# Number of coefficients of each polynomial P.
DEGREES = 6
_GIVEN_VARIABLES = ("one", "s", "level", "cos", "sin", "inverse", "alpha")
_POLYNOMIALS = 5
_ROUNDED = 1e-13  # largest distance of a box beyond the ends of its piece, from outward rounding


class Conditions(NamedTuple):
    """Conditions as tables for the kernel.

    The rod's equations, and a table of sums of products that are computed before and (from the
    variable ``middle`` on) after the equations are solved. Indices of its variables: the states at
    the contact (``start``, -1 for zero), the load in the equations (-1 if they have none), the
    first state at the base, and the ``conditions`` that must be positive.
    """

    equations: Program
    table: Program
    middle: int
    start: IntArray
    load: int
    base: int
    conditions: IntArray
    unknowns: int


def _polynomial(out: Equations, i: int) -> None:
    """Add P_i(s) and q² P_i with their derivatives, named p, dp, b and db."""
    out.add(ALGEBRAIC, f"p{i}_{DEGREES - 1}", f"a{i}_{DEGREES - 1}")
    for k in range(DEGREES - 2, -1, -1):
        out.add(ALGEBRAIC, f"p{i}_{k}", f"p{i}_{k + 1} s", f"a{i}_{k}")
        before = [f"d{i}_{k + 1} s"] if k < DEGREES - 2 else []
        out.add(ALGEBRAIC, f"d{i}_{k}", *before, f"p{i}_{k + 1}")
    out.add(ALGEBRAIC, f"b{i}", f"q2 p{i}_0")
    out.add(ALGEBRAIC, f"db{i}", f"q2 d{i}_0", *2 * [f"-qi2 p{i}_0"])


def _force_bounds(polynomials: tuple[int, ...]) -> Equations:
    """Start a table with the unknowns and the bounds on the force."""
    out = Equations()
    factors = (f"a{i}_{k}" for i in range(_POLYNOMIALS) for k in range(DEGREES))
    out.given(*_GIVEN_VARIABLES, *factors, "room")
    out.add(ALGEBRAIC, "i2", "inverse inverse")
    out.add(ALGEBRAIC, "q", "inverse", "-alpha")
    out.add(ALGEBRAIC, "q2", "q q")
    out.add(ALGEBRAIC, "qi2", "q i2")  # q' = -1/s²
    for i in polynomials:
        _polynomial(out, i)
    return out


def _assemble(
    out: Equations,
    equations: Program,
    middle: int,
    start: dict[int, str],
    base: str,
    conditions: tuple[str, ...],
    unknowns: int,
) -> Conditions:
    """Complete a table with the indices of its inputs and outputs."""
    at = out.names.index
    first = np.full(equations.groups.size, -1)
    for i, name in start.items():
        first[i] = at(name)
    load = at("F") if unknowns == 2 else -1
    rows = np.array([at(name) for name in conditions])
    return Conditions(equations, out.program(), middle, first, load, at(base), rows, unknowns)


def planar_conditions(fold: bool = False) -> Conditions:
    """Conditions `PLANAR` of a straight whisker, or with ``fold`` those beyond the fold.

    These are x_s(η + 2Fη_F) - 2F x_F η_s < 0, the determinant of the contact point in the plane,
    and η > 0, with which it is also that in space.
    """
    out = _force_bounds((1,))
    out.add(ALGEBRAIC, "limit", "b1 b1")
    out.add(ALGEBRAIC, "F", "limit level")
    middle = len(out.names)
    states = ("r", "n", "m", "x", "e") if fold else ("r", "n", "m")
    out.given(*(f"{state}{by}" for by in ("", "s", "F") for state in states))
    out.add(ALGEBRAIC, "FmF", "F mF")
    out.add(ALGEBRAIC, "Fms", "F ms")
    out.add(ALGEBRAIC, "along", "m", *2 * ["FmF"])
    out.add(ALGEBRAIC, "ratio", "rF m", *2 * ["-r mF"])
    out.add(ALGEBRAIC, "steady", "rs m", *2 * ["-r ms"])
    out.add(ALGEBRAIC, "fall", "-b1 ms", "-db1 along")
    out.add(ALGEBRAIC, "det", "along steady", *2 * ["-Fms ratio"])
    wanted: tuple[str, ...] = ("b1", "m", "fall", "det", "ratio")
    if fold:
        out.add(ALGEBRAIC, "FeF", "F eF")
        out.add(ALGEBRAIC, "FxF", "F xF")
        out.add(ALGEBRAIC, "rise", "e", *2 * ["FeF"])
        out.add(ALGEBRAIC, "beyond", "-xs rise", *2 * ["FxF es"])
        wanted = ("beyond", "e")
    return _assemble(out, planar_equations(fold), middle, {1: "one"}, "r", wanted, 2)


def _spatial_load(rest: bool) -> Equations:
    """Start a table in space with the force and its derivatives by s, φ and ℓ."""
    out = _force_bounds((0,) if rest else tuple(range(_POLYNOMIALS)))
    if rest:
        out.add(ALGEBRAIC, "f", "b0 level")
    else:
        out.add(ALGEBRAIC, "cos2", "cos cos")
        out.add(ALGEBRAIC, "cossin", "cos sin")
        for d in ("", "d"):
            out.add(ALGEBRAIC, f"{d}most", f"{d}b1", f"{d}b2 cos", f"{d}b3 sin", f"{d}b4 cos2")
            out.add(ALGEBRAIC, f"{d}extent", f"{d}most", f"-{d}b0")
            out.add(ALGEBRAIC, f"{d}f", f"{d}b0", f"{d}extent level")
        out.add(ALGEBRAIC, "swing", "-b2 sin", "b3 cos", *2 * ["-b4 cossin"])
        out.add(ALGEBRAIC, "fphi", "swing level")
    out.add(ALGEBRAIC, "fy", "f cos")
    out.add(ALGEBRAIC, "fz", "f sin")
    return out


def spatial_conditions(sign: float) -> Conditions:
    """Conditions `SPATIAL` of any whisker, followed by M_y and M_z.

    ``sign`` is that of det ∂(M_y, M_z, F_x)/∂(s, f_y, f_z).
    """
    out = _spatial_load(rest=False)
    middle = len(out.names)
    states = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    out.given(*(f"{state}{by}" for by in ("", "_s", "_y", "_z") for state in states))
    # Derivatives along the force (r) and across it (a), then by s, φ and ℓ.
    for name in ("My", "Mz", "Fx"):
        out.add(ALGEBRAIC, f"{name}r", f"cos {name}_y", f"sin {name}_z")
        out.add(ALGEBRAIC, f"{name}a", f"cos {name}_z", f"-sin {name}_y")
        out.add(ALGEBRAIC, f"{name}s", f"{name}_s", f"df {name}r")
        out.add(ALGEBRAIC, f"{name}p", f"fphi {name}r", f"f {name}a")
        out.add(ALGEBRAIC, f"{name}l", f"extent {name}r")
    out.add(ALGEBRAIC, "fall", "-My Mys", "-Mz Mzs")
    out.add(ALGEBRAIC, "moments", "-Mys Mzp", "Mzs Myp")
    mark, other = ("", "-") if sign > 0.0 else ("-", "")
    for i, (a, b) in enumerate((("My", "Mz"), ("Mz", "Fx"), ("Fx", "My"))):
        out.add(ALGEBRAIC, f"minor{i}", f"{a}_y {b}_z", f"-{b}_y {a}_z")
    out.add(ALGEBRAIC, "det", *(f"{mark}{n}_s minor{i}" for i, n in enumerate(("Fx", "My", "Mz"))))
    # ω = M_y dM_z - M_z dM_y, δ = M_y dM_y + M_z dM_z, ζ = M_B² dF_x - F_x δ, by φ and by ℓ.
    out.add(ALGEBRAIC, "square", "My My", "Mz Mz")
    for by in ("p", "l"):
        out.add(ALGEBRAIC, f"turn{by}", f"My Mz{by}", f"-Mz My{by}")
        out.add(ALGEBRAIC, f"grow{by}", f"My My{by}", f"Mz Mz{by}")
        out.add(ALGEBRAIC, f"zeta{by}", f"square Fx{by}", f"-Fx grow{by}")
    out.add(ALGEBRAIC, "both", f"{mark}turnp zetal", f"{other}turnl zetap")
    wanted = ("b0", "extent", "fall", "moments", "det", "turnp", "both", "My", "Mz")
    start = {1: "fy", 2: "fz", 13: "one", 20: "one"}
    return _assemble(out, spatial_equations(False), middle, start, "Fx", wanted, 3)


def spatial_point_conditions(kind: str) -> Conditions:
    """Conditions of any whisker near rest (``"rest"``) or beyond the fold (``"fold"``).

    Near rest f_min |∂p/∂f| < ``room`` · s, so that less force leaves the contact in the cone;
    beyond the fold det ∂p/∂(s, f_y, f_z) < 0.

    For a ``"contact"``, with the force as near rest: det ∂p/∂(s, f_y, f_z), which is positive if
    the contact is stable; then F, M and p, and the derivatives of each by s, φ and ℓ.
    """
    out = _spatial_load(kind != "fold")
    middle = len(out.names)
    states = ("Fx", "Fy", "Fz", "Mx", "My", "Mz", "px", "py", "pz")
    out.given(*(f"{state}{by}" for by in ("", "_s", "_y", "_z") for state in states))
    wanted: tuple[str, ...] = ("beyond",)
    if kind == "rest":
        for x in "xyz":
            out.add(ALGEBRAIC, f"along{x}", f"cos p{x}_y", f"sin p{x}_z")
            out.add(ALGEBRAIC, f"moved{x}", f"b0 along{x}")
        out.add(ALGEBRAIC, "allowed", "room s")
        wanted = ("inside",)
        out.add(ALGEBRAIC, "inside", "allowed allowed", *(f"-moved{x} moved{x}" for x in "xyz"))
    else:
        for i, (a, b) in enumerate((("py", "pz"), ("pz", "px"), ("px", "py"))):
            out.add(ALGEBRAIC, f"area{i}", f"{a}_y {b}_z", f"-{b}_y {a}_z")
        sign = "-" if kind == "fold" else ""
        terms = (f"{sign}{n}_s area{i}" for i, n in enumerate(("px", "py", "pz")))
        out.add(ALGEBRAIC, "beyond", *terms)
    if kind == "contact":
        out.add(ALGEBRAIC, "df", "db0 level")
        wanted += states
        for name in states:
            out.add(ALGEBRAIC, f"{name}r", f"cos {name}_y", f"sin {name}_z")
            out.add(ALGEBRAIC, f"{name}s", f"{name}_s", f"df {name}r")
            out.add(ALGEBRAIC, f"{name}p", f"fy {name}_z", f"-fz {name}_y")
            out.add(ALGEBRAIC, f"{name}l", f"b0 {name}r")
            wanted += (f"{name}s", f"{name}p", f"{name}l")
    start = {1: "fy", 2: "fz", 19: "one", 29: "one"}
    return _assemble(out, spatial_equations(True), middle, start, "Fx", wanted, 3)


@inlined_rigorous
def compute(table: Program, z: Array, first: int, end: int) -> None:
    """Compute the sums of products of a table, row by row."""
    for v in range(first, end):
        if table.kind[v] == 1:
            clear(z, v)
            for o in range(table.first[v], table.first[v + 1]):
                add_product(table.sign[o], z, table.left[o], z, table.right[o], z, v)
            close(z, v, 1.0)


@inlined_rigorous
def set_unknown(low: float, high: float, column: int, z: Array, k: int, lane: int) -> None:
    """Set a lane to the interval between two numbers; the form must be closed afterwards."""
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low) * UP + 4e-16 * (abs(low) + abs(high))
    z[k, 0, lane], z[k, column, lane], z[k, z.shape[1] - 1, lane] = middle, half, abs(middle)


@inlined_rigorous
def set_angle(low: float, high: float, pure: IntArray, z: Array, k: int, lane: int) -> None:
    """Set cosine (row k) and sine (row k + 1) of an angle within ±3.2, in one lane, to be closed.

    They are computed by their series at the middle of the interval, and a series about it; ``pure``
    are the columns of the powers of the unknown.
    """
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low) * UP + 4e-16 * (abs(low) + abs(high))
    cos, sin, term = 0.0, 0.0, 1.0
    for n in range(40):
        sign = 1.0 if n % 4 < 2 else -1.0
        if n % 2:
            sin += sign * term
        else:
            cos += sign * term
        term *= middle / (n + 1)
    power = 1.0
    for n in range(pure.size):
        z[k, pure[n], lane], z[k + 1, pure[n], lane] = cos * power, sin * power
        cos, sin = -sin, cos
        power *= half / (n + 1) * UP
    # The error of the series at the middle, and of its derivatives, is 80 u cosh 3.2 < 1.2e-13.
    for row in (k, k + 1):
        z[row, coefficients(z), lane] = power + 1.2e-13 * (1.0 + half) ** 3 * UP
        z[row, z.shape[1] - 1, lane] = (1.0 + half) ** 3


@inlined_rigorous
def report(z: Array, row: int, lane: int, unknowns: int, out: Array) -> None:
    """Write a form as its centre, contributions of unknowns and products, and remainder."""
    n = coefficients(z)
    out[0], out[unknowns + 1] = z[row, 0, lane], 0.0
    for a in range(1, n):
        if a <= unknowns:
            out[a] = abs(z[row, a, lane])
        else:
            out[unknowns + 1] += abs(z[row, a, lane])
    out[unknowns + 1] *= UP
    out[unknowns + 2] = (z[row, n, lane] + ROUNDING * z[row, z.shape[1] - 1, lane]) * UP


@inlined_rigorous
def relative_widths(state: Array, states: int, lane: int, out: Array) -> None:
    """Sum over states' vectors of the change by each unknown, relative to the vector's size."""
    last = state.shape[1] - 1
    for a in range(out.size):
        out[a] = TINY
        first = 2 * states
        while first < state.shape[0]:
            end = min(first + 3, (first // states + 1) * states)
            change, size = 0.0, TINY
            for i in range(first, end):
                change += abs(state[i, a + 1, lane])
                size += state[i, last, lane]
            out[a] += change / size
            first = end


@rigorous
def conditions_on(
    conditions: Conditions,
    rod: ExactRod,
    bound: Array,
    boxes: Array,
    order: int,
    tolerance: float,
    found: Array,
    widths: Array,
    first: int,
    end: int,
) -> None:
    """Enclose the conditions over boxes (n, unknowns, 2), rows from ``first`` to ``end``.

    ``bound`` is the taper α, the coefficients of P₀ … P₄, and ``room``; neighbouring boxes share
    the lanes of a batch. ``found`` (n, c, unknowns + 3) are conditions, each a centre, the
    contribution of each unknown and of their products, and the remainder of all else; NaN where the
    states cannot be enclosed. ``widths`` (n, unknowns) are relative widths of the states.
    """
    groups, states = conditions.equations.groups.shape
    unknowns, table = conditions.unknowns, conditions.table
    pure = PURE_3 if unknowns == 3 else PURE_2
    width = COLUMNS_3 if unknowns == 3 else COLUMNS_2
    z, work = np.zeros((table.kind.size, width, LANES)), np.zeros((3, width, LANES))
    state, load = np.zeros((groups * states, width, LANES)), np.zeros((1, width, LANES))
    set_number(1.0, 0.0, z, 0)
    for k in range(bound.size):
        set_number(bound[k], 0.0, z, 6 + k)
    row = first
    while row < end:
        piece = first_piece(rod, 0.5 * (boxes[row, 0, 0] + boxes[row, 0, 1]))
        number = 1
        while number < LANES and row + number < end:
            s = 0.5 * (boxes[row + number, 0, 0] + boxes[row + number, 0, 1])
            if first_piece(rod, s) != piece:
                break
            number += 1
        for i in range(1, 5):
            clear(z, i)
        for lane in range(LANES):
            box = boxes[row + min(lane, number - 1)]
            set_unknown(box[0, 0], box[0, 1], 1, z, 1, lane)
            level = unknowns - 1
            set_unknown(box[level, 0], box[level, 1], unknowns, z, 2, lane)
            if unknowns == 3:
                set_angle(box[1, 0], box[1, 1], pure[1], z, 3, lane)
        for i in range(1, 5):
            close(z, i, 1.0)
        reciprocal(z, 1, z, 5, work)
        compute(table, z, 0, conditions.middle)
        if conditions.load >= 0:
            copy_row(z, conditions.load, load, 0)
        for i in range(groups * states):
            clear(state, i)
            if conditions.start[i] >= 0:
                copy_row(z, conditions.start[i], state, i)
        enclose(conditions.equations, rod, piece, z[1:2], load, state, order, tolerance)
        for i in range(groups * states):
            copy_row(state, i, z, conditions.base + i)
        compute(table, z, conditions.middle, table.kind.size)
        for lane in range(number):
            # A box that extends over the end of a piece would need different equations.
            box = boxes[row + lane, 0]
            apart = max(rod.edges[piece] - box[0], box[1] - rod.edges[piece + 1]) > _ROUNDED
            for c in range(conditions.conditions.size):
                report(z, conditions.conditions[c], lane, unknowns, found[row + lane, c])
            if apart:
                found[row + lane] = np.nan
            relative_widths(state, states, lane, widths[row + lane])
            if unknowns == 3:  # the force turns with φ even where the rod does not
                widths[row + lane, 1] += 0.5 * (boxes[row + lane, 1, 1] - boxes[row + lane, 1, 0])
        row += number

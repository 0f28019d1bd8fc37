"""Integration of the rod equations with weight, from the tip to the base, four contacts at a time.

Weight acts along a unit vector ĝ fixed in the base frame; g = Rᵀĝ is the same vector in the
material frame, and W(s) the known weight distal to s. The whisker carries the force n = φ + W g,
where φ is due to the contact, and the moment m = q × φ + μ, where μ is the moment of the weight
distal to s about r(s)::

    φ' = φ × u,   q' = q × u - e₁,   g' = g × u,   μ' = μ × u + W g × e₁,
    u = u₀(s) + c(s) ∘ (q × φ + μ)

Distal to the contact φ and q are zero, but weight bends the whisker there too. At the tip μ = 0,
and the direction g(L) is unknown: two numbers, determined by g(0) = ĝ. At the base φ = F, q = p,
and the base carries the force F + W(0) ĝ and the moment p × F + μ.

The two unknowns are eliminated by Newton's method, with the derivatives δ₁ and δ₂ by them
integrated alongside: with a = -[δ₁ δ₂]⁺ (g(0) - ĝ) the base values are y + a₁ δ₁ y + a₂ δ₂ y, and
the derivatives by any other unknown of the contact get the same correction. (F, p) are thus again
smooth functions of (s_c, f) alone, and the solvers for a rod without weight apply to one with
weight. A lane starts from the direction at which it last ended; along a path, or in the rounds of
an outer Newton's method, that is close to the solution. A base that accelerates by a₀ is equivalent
to gravity g - a₀.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, Vector, inlined, kernel, shared
from vibrissa.rod.discretization import Rod, Weight
from vibrissa.rod.kernels import (
    ARC,
    BUFFER_SIZE,
    FORCE,
    LANES,
    LEAN,
    TANGENT,
    TIP,
    Pair,
    Piece,
    Six,
    add,
    cross,
    get,
    normal_plane,
    piece_of,
    put,
    runge_kutta_step,
    section,
    set_all_lanes,
    turning,
)

# A stage stores φ, q, g, μ, u (3 each), two compliances, W.
_STAGE = 18 * LANES
_TURN, _SOFT, _WEIGHT = 12 * LANES, 15 * LANES, 17 * LANES
_SIX = 6 * LANES
_STATE = 7 * _STAGE  # φ, q, g, μ
# Derivatives of the state by the two unknowns at the tip, and up to three more.
_SLOPES = _STATE + 2 * _SIX
_MOVING = _SLOPES + 10 * _SIX  # derivative during its step
_H = _MOVING + 2 * _SIX
# Copies of the contacts' arc lengths and kinds: the loop over so few lanes is vectorised only if it
# uses one array.
_ARC = _H + LANES
_TIP = _ARC + LANES
#: Size of a buffer for :func:`solve_lanes`.
WEIGHT_BUFFER = _TIP + LANES
#: Size of a solved state: (F, p), ĝ and μ at the base.
STATES = 12

_ROUNDS = 8  # rounds of Newton's method for the direction at the tip
_SHARES = 8  # number of increments of the force, from rest, if they do not converge
# Error of g(0) up to which no further round is needed, and up to which a correction to first order
# suffices: it leaves the square of the error.
_SMALL, _NEAR = 1e-6, 1e-3

Load = tuple[float, float, float, float, float, float, float, float]


@inlined
def _load_of(weight: Weight, k: int) -> Load:
    w = weight.beyond
    return (w[k, 0], w[k, 1], w[k, 2], w[k, 3], w[k, 4], w[k, 5], w[k, 6], w[k, 7])


@inlined
def _beyond(w: Load, t: float) -> float:
    """Weight distal to the fraction t of a step."""
    high = w[4] + t * (w[5] + t * (w[6] + t * w[7]))
    return w[0] + t * (w[1] + t * (w[2] + t * (w[3] + t * high)))


@inlined
def _first_three(x: Six) -> Vector:
    return (x[0], x[1], x[2])


@inlined
def _last_three(x: Six) -> Vector:
    return (x[3], x[4], x[5])


@inlined
def _join(a: Vector, b: Vector) -> Six:
    return (a[0], a[1], a[2], b[0], b[1], b[2])


@inlined
def _get_six(b: Array, row: int, i: int) -> Six:
    return _join(get(b, row, i), get(b, row + 3 * LANES, i))


@inlined
def _put_six(b: Array, row: int, i: int, x: Six) -> None:
    put(b, row, i, _first_three(x))
    put(b, row + 3 * LANES, i, _last_three(x))


@inlined
def _store_stage(b: Array, row: int, i: int, u: Vector, c: Vector, w: float) -> None:
    """Store curvature, compliance and weight of a stage."""
    put(b, row + _TURN, i, u)
    b[row + _SOFT + i] = c[0]
    b[row + _SOFT + LANES + i] = c[1]
    b[row + _WEIGHT + i] = w


@inlined
def _free_rates(
    data: tuple[Array, Piece, Load, float, float],
    stage: int,
    left: float,
    i: int,
    g: Vector,
    m: Vector,
) -> Pair:
    """Derivatives of (g, μ) distal to the contact."""
    b, piece, load, low, span = data
    t = low + span * left
    u0, c = section(piece, t)
    u = turning(u0, c, m)
    w = piece[3] * _beyond(load, t)
    row = stage * _STAGE
    put(b, row + _SIX, i, g)
    put(b, row + _SIX + 3 * LANES, i, m)
    _store_stage(b, row, i, u, c, w)
    return cross(g, u), add(cross(m, u), (0.0, w * g[2], -w * g[1]))


@inlined
def _free_slope_rates(
    data: tuple[Array], stage: int, left: float, i: int, dg: Vector, dm: Vector
) -> Pair:
    """Derivatives of a tangent of (g, μ) distal to the contact."""
    b, row = data[0], stage * _STAGE
    g, m = get(b, row + _SIX, i), get(b, row + _SIX + 3 * LANES, i)
    u, w = get(b, row + _TURN, i), b[row + _WEIGHT + i]
    c0, c1 = b[row + _SOFT + i], b[row + _SOFT + LANES + i]
    du = (c0 * dm[0], c1 * dm[1], c1 * dm[2])
    moment = add(add(cross(dm, u), cross(m, du)), (0.0, w * dg[2], -w * dg[1]))
    return add(cross(dg, u), cross(g, du)), moment


@inlined
def _held_rates(
    data: tuple[Array, Piece, Load, float, float], stage: int, left: float, i: int, x: Six, y: Six
) -> tuple[Six, Six]:
    """Derivatives of (φ, q) and (g, μ) between contact and base."""
    b, piece, load, low, span = data
    t = low + span * left
    f, q, g, m = _first_three(x), _last_three(x), _first_three(y), _last_three(y)
    u0, c = section(piece, t)
    u = turning(u0, c, add(cross(q, f), m))
    w = piece[3] * _beyond(load, t)
    row = stage * _STAGE
    _put_six(b, row, i, x)
    _put_six(b, row + _SIX, i, y)
    _store_stage(b, row, i, u, c, w)
    lever = add(cross(q, u), (-piece[3], 0.0, 0.0))
    moment = add(cross(m, u), (0.0, w * g[2], -w * g[1]))
    return _join(cross(f, u), lever), _join(cross(g, u), moment)


@inlined
def _held_slope_rates(
    data: tuple[Array], stage: int, left: float, i: int, dx: Six, dy: Six
) -> tuple[Six, Six]:
    """Derivatives of a tangent of (φ, q) and (g, μ) between contact and base."""
    b, row = data[0], stage * _STAGE
    x, y = _get_six(b, row, i), _get_six(b, row + _SIX, i)
    f, q, g, m = _first_three(x), _last_three(x), _first_three(y), _last_three(y)
    df, dq, dg, dm = _first_three(dx), _last_three(dx), _first_three(dy), _last_three(dy)
    u, w = get(b, row + _TURN, i), b[row + _WEIGHT + i]
    c0, c1 = b[row + _SOFT + i], b[row + _SOFT + LANES + i]
    more = add(add(cross(dq, f), cross(q, df)), dm)
    du = (c0 * more[0], c1 * more[1], c1 * more[2])
    moment = add(add(cross(dm, u), cross(m, du)), (0.0, w * dg[2], -w * dg[1]))
    return (
        _join(add(cross(df, u), cross(f, du)), add(cross(dq, u), cross(q, du))),
        _join(add(cross(dg, u), cross(g, du)), moment),
    )


@inlined
def _free_step(rod: Rod, weight: Weight, h: Array, k: int) -> None:
    """Take step k distal to the contacts, with the derivatives by the unknowns at the tip."""
    start, width, piece, load = rod.start[k], rod.width[k], piece_of(rod, k), _load_of(weight, k)
    for i in range(LANES):
        low = min(max(h[_ARC + i] - start, 0.0), width)
        step = width - low
        data = (h, piece, load, low / width, step / width)
        y = _get_six(h, _STATE + _SIX, i)
        g, m = runge_kutta_step(_free_rates, data, i, -step, _first_three(y), _last_three(y))
        _put_six(h, _STATE + _SIX, i, _join(g, m))
        h[_H + i] = -step
    for j in range(2):
        row = _SLOPES + (2 * j + 1) * _SIX
        for i in range(_SIX):
            h[_MOVING + i] = h[row + i]
        for i in range(LANES):
            y = _get_six(h, _MOVING, i)
            g, m = runge_kutta_step(
                _free_slope_rates, (h,), i, h[_H + i], _first_three(y), _last_three(y)
            )
            _put_six(h, _MOVING, i, _join(g, m))
        for i in range(_SIX):
            h[row + i] = h[_MOVING + i]


@inlined
def _held_step(rod: Rod, weight: Weight, h: Array, k: int, slopes: int) -> None:
    """Take step k between contacts and base, with the first ``slopes`` derivatives."""
    start, width, piece, load = rod.start[k], rod.width[k], piece_of(rod, k), _load_of(weight, k)
    for i in range(LANES):
        s = h[_ARC + i]
        step = min(max(s - start, 0.0), width)
        data = (h, piece, load, 0.0, step / width)
        x0, y0 = _get_six(h, _STATE, i), _get_six(h, _STATE + _SIX, i)
        x, y = runge_kutta_step(_held_rates, data, i, -step, x0, y0)
        _put_six(h, _STATE, i, x)
        _put_six(h, _STATE + _SIX, i, y)
        h[_H + i] = -step
        # The lane's contact is in this step: its derivative by s starts here.
        if slopes > 2 and s > start and s <= start + width and h[_TIP + i] == 0.0:
            u = get(h, _TURN, i)
            turned = cross(u, _first_three(x0))
            put(h, _SLOPES + 4 * _SIX, i, turned)
            put(h, _SLOPES + 4 * _SIX + 3 * LANES, i, (piece[3], 0.0, 0.0))
    for j in range(slopes):
        row = _SLOPES + 2 * j * _SIX
        for i in range(2 * _SIX):
            h[_MOVING + i] = h[row + i]
        for i in range(LANES):
            x, y = _get_six(h, _MOVING, i), _get_six(h, _MOVING + _SIX, i)
            x, y = runge_kutta_step(_held_slope_rates, (h,), i, h[_H + i], x, y)
            _put_six(h, _MOVING, i, x)
            _put_six(h, _MOVING + _SIX, i, y)
        for i in range(2 * _SIX):
            h[row + i] = h[_MOVING + i]


@inlined
def _load_at_tip(weight: Weight, b: Array, h: Array, more: int, share: float) -> None:
    """Load all lanes at the tip from the buffer of contacts, with a share of their force."""
    for i in range(_STATE, _MOVING):
        h[i] = 0.0
    for i in range(LANES):
        h[_ARC + i], h[_TIP + i] = b[ARC + i], b[TIP + i]
        g = get(b, LEAN, i)
        if not abs(g[0] * g[0] + g[1] * g[1] + g[2] * g[2] - 1.0) < 1e-9:
            g = (weight.at_tip[0], weight.at_tip[1], weight.at_tip[2])
            put(b, LEAN, i, g)
        f = get(b, FORCE, i)
        put(h, _STATE, i, (share * f[0], share * f[1], share * f[2]))
        put(h, _STATE + _SIX, i, g)
        first, second = normal_plane(g)
        put(h, _SLOPES + _SIX, i, first)
        put(h, _SLOPES + 3 * _SIX, i, second)
        for j in range(more):
            x = _get_six(b, TANGENT + j * _SIX, i)
            _put_six(h, _SLOPES + (4 + 2 * j) * _SIX, i, x)


@inlined
def _shares(h: Array, i: int, v: Vector) -> tuple[float, float]:
    """Coefficients of δ₁ g(0) and δ₂ g(0) whose sum is closest to v."""
    first, second = get(h, _SLOPES + _SIX, i), get(h, _SLOPES + 3 * _SIX, i)
    aa = ab = bb = av = bv = 0.0
    for j in range(3):
        aa += first[j] * first[j]
        ab += first[j] * second[j]
        bb += second[j] * second[j]
        av += first[j] * v[j]
        bv += second[j] * v[j]
    det = aa * bb - ab * ab
    return (bb * av - ab * bv) / det, (aa * bv - ab * av) / det


@inlined
def _subtract_shares(h: Array, row: int, i: int, a: float, c: float) -> None:
    """Subtract multiples of δ₁ and δ₂ from the 12 numbers of a lane at ``row``."""
    for j in range(0, 2 * _SIX, LANES):
        h[row + j + i] -= a * h[_SLOPES + j + i] + c * h[_SLOPES + 2 * _SIX + j + i]


@inlined
def _correct_leans(weight: Weight, b: Array, h: Array) -> float:
    """Correct all lanes' directions at the tip; return the largest error at the base."""
    worst = 0.0
    for i in range(LANES):
        base = get(h, _STATE + _SIX, i)
        toward = weight.toward
        off = (base[0] - toward[0], base[1] - toward[1], base[2] - toward[2])
        error = np.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
        worst = max(worst, error) if error < np.inf else worst
        # The rotation of g(0) into ĝ also rotates g(L); it is exact if the shape does not change.
        along = base[0] * toward[0] + base[1] * toward[1] + base[2] * toward[2]
        across = (
            toward[0] - along * base[0],
            toward[1] - along * base[1],
            toward[2] - along * base[2],
        )
        a, c = _shares(h, i, across)
        g = get(b, LEAN, i)
        first, second = normal_plane(g)
        g = (
            along * g[0] + a * first[0] + c * second[0],
            along * g[1] + a * first[1] + c * second[1],
            along * g[2] + a * first[2] + c * second[2],
        )
        size = 1.0 / np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        put(b, LEAN, i, (g[0] * size, g[1] * size, g[2] * size))
    return float(worst)


@kernel
def _integrate_lanes(rod: Rod, weight: Weight, b: Array, h: Array, more: int, share: float) -> None:
    """Integrate all lanes from the tip to the base, from their present directions at the tip."""
    _load_at_tip(weight, b, h, more, share)
    nearest = farthest = b[ARC]
    for i in range(1, LANES):
        nearest, farthest = min(nearest, b[ARC + i]), max(farthest, b[ARC + i])
    for k in range(rod.start.shape[0] - 1, -1, -1):
        if nearest < rod.start[k] + rod.width[k]:
            _free_step(rod, weight, h, k)
        if rod.start[k] < farthest:
            _held_step(rod, weight, h, k, 2 + more)


@kernel
def _solve_leans(
    rod: Rod, weight: Weight, b: Array, h: Array, share: float, enough: float
) -> float:
    """Solve for all lanes' directions at the tip by Newton's method; return the largest error."""
    error = np.inf
    for _ in range(_ROUNDS):
        _integrate_lanes(rod, weight, b, h, 0, share)
        error = _correct_leans(weight, b, h)
        if error < enough:
            break
    return float(error)


@kernel
def solve_lanes(rod: Rod, weight: Weight, b: Array, h: Array, more: int) -> bool:
    """Solve the contacts in the buffer ``b``, with their first ``more`` derivatives, into ``h``."""
    enough = _SMALL if more == 0 else _NEAR
    error = _solve_leans(rod, weight, b, h, 1.0, enough)
    if not error < enough:  # increase the force from rest in steps
        for i in range(LANES):
            put(b, LEAN, i, (0.0, 0.0, 0.0))
        for n in range(1, _SHARES + 1):
            error = _solve_leans(rod, weight, b, h, n / _SHARES, enough)
    if more > 0:
        for _ in range(3):
            _integrate_lanes(rod, weight, b, h, more, 1.0)
            error = _correct_leans(weight, b, h)
            if error < _SMALL:
                break
    for i in range(LANES):
        base, toward = get(h, _STATE + _SIX, i), weight.toward
        off = (base[0] - toward[0], base[1] - toward[1], base[2] - toward[2])
        a, c = _shares(h, i, off)
        lost = not abs(off[0]) + abs(off[1]) + abs(off[2]) < 4.0 * _SMALL
        if lost:
            put(b, LEAN, i, (0.0, 0.0, 0.0))
        _subtract_shares(h, _STATE, i, np.nan if lost else a, c)
        for j in range(more):
            row = _SLOPES + (4 + 2 * j) * _SIX
            a, c = _shares(h, i, get(h, row + _SIX, i))
            _subtract_shares(h, row, i, np.nan if lost else a, c)
    return error < _SMALL


@inlined
def integrate_weighted(rod: Rod, weight: Weight, b: Array, tangents: int) -> None:
    """Integrate every lane of a rod with weight; see :func:`vibrissa.rod.integrate`."""
    h = np.empty(WEIGHT_BUFFER)
    solve_lanes(rod, weight, b, h, tangents)
    for i in range(_SIX):
        b[FORCE + i] = h[_STATE + i]
    for j in range(tangents):
        for i in range(_SIX):
            b[TANGENT + j * _SIX + i] = h[_SLOPES + (4 + 2 * j) * _SIX + i]


@inlined
def _stability(weight: Weight, h: Array) -> float:
    """Determinant of ∂g(0)/∂g(L): positive until the whisker topples under its weight."""
    turned = cross(get(h, _SLOPES + _SIX, 0), get(h, _SLOPES + 3 * _SIX, 0))
    toward = weight.toward
    return float(toward[0] * turned[0] + toward[1] * turned[1] + toward[2] * turned[2])


@shared
def evaluate_weighted(
    rod: Rod,
    weight: Weight,
    contacts: Array,
    leans: Array,
    states: Array,
    tangents: Array,
    directions: Array,
    first: int,
    last: int,
) -> None:
    """Compute base values (F, p, ĝ, μ) and stability (13 in all) of contacts (s, f).

    ``leans`` (n, 3) are the directions of weight at the tip: on entry where to start, NaN for that
    of the resting whisker; on return the solution. ``tangents`` (n, 12, 4) are derivatives by
    (s, f_x, f_y, f_z), ``directions`` (n, 12, 3) by the direction of weight ĝ; they are not
    computed if the arrays have no rows.
    """
    b, h = np.zeros(BUFFER_SIZE), np.empty(WEIGHT_BUFFER)
    wanted = tangents.shape[0] > 0
    for row in range(first, last):
        c = contacts[row]
        set_all_lanes(b, c[0], c[1], c[2], c[3])
        for i in range(LANES):
            put(b, LEAN, i, (leans[row, 0], leans[row, 1], leans[row, 2]))
        solve_lanes(rod, weight, b, h, 1 if wanted else 0)
        for a in range(STATES):
            states[row, a] = h[_STATE + a * LANES]
        states[row, STATES] = _stability(weight, h)
        for a in range(3):
            leans[row, a] = b[LEAN + a * LANES]
        if not wanted:
            continue
        for a in range(STATES):
            for i in range(LANES):
                tangents[row, a, i] = h[_SLOPES + 4 * _SIX + a * LANES + i]
        for axis in range(3):
            one, two = _shares(
                h,
                0,
                (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0),
            )
            for a in range(STATES):
                at = _SLOPES + a * LANES
                directions[row, a, axis] = one * h[at] + two * h[at + 2 * _SIX]


@inlined
def _carried_rates(
    data: tuple[Array, float], stage: int, left: float, i: int, v: Vector, w: Vector
) -> Pair:
    """Derivatives of a vector fixed in space, and of the vector to the tip (with the extent)."""
    h, extent = data
    u = get(h, stage * _STAGE + _TURN, i)
    return cross(v, u), add(cross(w, u), (-extent, 0.0, 0.0))


@inlined
def _record(axes: Array, ends: Array, moments: Array, m: int, x: Six, y: Six, mu: Vector) -> None:
    """Store axes, vector to the tip and moment at one arc length."""
    for a in range(3):
        axes[m, 0, a], axes[m, 1, a] = x[a], x[3 + a]
        axes[m, 2, a], ends[m, a] = y[a], y[3 + a]
        moments[m, a] = mu[a]


@kernel
def trace_weighted(
    rod: Rod,
    weight: Weight,
    contact: Array,
    lean: Array,
    s: Array,
    axes: Array,
    ends: Array,
    moments: Array,
) -> None:
    """Compute the shape of one solved whisker, from the tip to the base.

    Fills, at increasing arc lengths s (m,) and last at the base: ``axes`` (m + 1, 3, 3), the three
    axes fixed in space, in rows; ``ends`` (m + 1, 3), the vector to the tip; and the moments μ; all
    in the material frame there.
    """
    h = np.zeros(WEIGHT_BUFFER)
    x = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    y = (lean[0], lean[1], lean[2], 0.0, 0.0, 0.0)
    v, w = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    wanted, held = s.shape[0] - 1, False
    for k in range(rod.start.shape[0] - 1, -1, -1):
        start, width, extent = rod.start[k], rod.width[k], rod.extent[k]
        piece, load, here = piece_of(rod, k), _load_of(weight, k), rod.start[k] + rod.width[k]
        while True:
            if not held and contact[0] >= here - 1e-15:
                x, held = (contact[1], contact[2], contact[3], 0.0, 0.0, 0.0), True
            while wanted >= 0 and s[wanted] >= here - 1e-12 and extent > 0.0:
                _record(axes, ends, moments, wanted, v, w, _last_three(y))
                wanted -= 1
            if here <= start + 1e-15:
                break
            to = start
            if wanted >= 0 and extent > 0.0:
                to = max(to, s[wanted])
            if not held:
                to = max(to, contact[0])
            data = (h, piece, load, (to - start) / width, (here - to) / width)
            if held:
                x, y = runge_kutta_step(_held_rates, data, 0, to - here, x, y)
            else:
                g, m = runge_kutta_step(
                    _free_rates, data, 0, to - here, _first_three(y), _last_three(y)
                )
                y = _join(g, m)
            carried = (h, 0.0)
            one, two = runge_kutta_step(
                _carried_rates, carried, 0, to - here, _first_three(v), _last_three(v)
            )
            three, end = runge_kutta_step(
                _carried_rates, (h, extent), 0, to - here, _first_three(w), _last_three(w)
            )
            v, w = _join(one, two), _join(three, end)
            here = to
    while wanted >= 0:
        _record(axes, ends, moments, wanted, v, w, _last_three(y))
        wanted -= 1
    _record(axes, ends, moments, s.shape[0], v, w, _last_three(y))

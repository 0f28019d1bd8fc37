"""Enclosures over boxes against the rod's equations in Arb, at 120 bits: never a miss."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.certificates.certificate import enclose_conditions
from vibrissa.certificates.conditions import DEGREES, spatial_point_conditions
from vibrissa.certificates.domain import Bounds
from vibrissa.certificates.equations import exact_rod

flint = pytest.importorskip("flint")

ORDER, STEPS = 16, 10  # at 120 bits: what this leaves out is far below double precision


def known(rod, s, i):
    """Taylor coefficients in t, at s - t, of one polynomial of the rod."""
    piece = max(k for k in range(len(rod.edges) - 1) if k == 0 or rod.edges[k] < float(s))
    slope, offset = (flint.arb(float(x)) for x in rod.local[piece, i, :, 0])
    local = flint.arb_series([slope * s + offset, -slope], prec=ORDER)
    out = flint.arb_series([0], prec=ORDER)
    for factor in rod.coefficients[piece, i, ::-1, 0]:
        out = out * local + flint.arb(float(factor))
    return out


def coefficients(series):
    return [series[k] for k in range(ORDER)]


def cross(a, b, k):
    """Coefficient k of the cross product of two vectors of series."""

    def term(i, j):
        return sum(
            (a[i][r] * b[j][k - r] - a[j][r] * b[i][k - r] for r in range(k + 1)), flint.arb(0)
        )

    return [term(1, 2), term(2, 0), term(0, 1)]


def at_base(rod, s, fy, fz):
    """Force, moment and contact point at the base, by Taylor series from the contact."""
    zero = flint.arb(0)
    n, m, q = [zero, fy, fz], [zero] * 3, [zero] * 3
    ends = sorted({float(e) for e in rod.edges if e < float(s)} | {0.0})
    while ends:
        end = flint.arb(ends.pop())
        h = (s - end) / STEPS
        for _ in range(STEPS):
            kappa = [coefficients(known(rod, s, i)) for i in range(3)]
            soft = coefficients((1 / known(rod, s, 3)) ** 4)
            twist = flint.arb(float(rod.twist[0]))
            x = [[[value] for value in vector] for vector in (n, m, q)]
            u = [[], [], []]
            for k in range(ORDER - 1):
                for i in range(3):
                    bend = sum((soft[r] * x[1][i][k - r] for r in range(k + 1)), zero)
                    u[i].append(kappa[i][k] + (twist * bend if i == 0 else bend))
                rate = [cross(u, vector, k) for vector in x]
                rate[1] = [rate[1][0], rate[1][1] - x[0][2][k], rate[1][2] + x[0][1][k]]
                rate[2] = [rate[2][0] + (1 if k == 0 else 0), *rate[2][1:]]
                for vector, by_t in zip(x, rate, strict=True):
                    for i in range(3):
                        vector[i].append(by_t[i] / (k + 1))
            n, m, q = (
                [sum((c * h**k for k, c in enumerate(one)), zero) for one in vector] for vector in x
            )
            s = s - h
        s = end
    return [*n, *m, *q]


def contact(rod, alpha, s, phi, level):
    force = (1 / s - alpha) ** 2 * level
    return at_base(rod, s, force * phi.cos(), force * phi.sin())


@pytest.mark.parametrize(
    "half",
    [pytest.param(1e-12, marks=pytest.mark.slow), 2e-3, pytest.param(1e-2, marks=pytest.mark.slow)],
)
def test_enclosures_hold_what_arb_computes(half):
    flint.ctx.prec = 120
    whisker = vb.Whisker.parabola(length=39.4e-3, coefficient=10.0)
    rod, alpha, rng = exact_rod(whisker), 1.0 - whisker.tip_radius / whisker.base_radius, None
    rng = np.random.default_rng(1)
    factors = np.zeros((5, DEGREES))
    factors[0, 0] = 1.0
    middle = np.array([[0.34, 1.0, 6.0], [0.7, 2.5, 2.0]])
    size = half * np.stack(
        [1.0 - alpha * middle[:, 0], 2.0 + 0 * middle[:, 0], middle[:, 2]], axis=1
    )
    boxes = np.stack([middle - size, middle + size], axis=-1)
    tables = spatial_point_conditions("contact")
    found = enclose_conditions(tables, rod, Bounds(alpha, factors, 0.0), boxes, 1e-10)[0][:, 1:]
    for box, enclosure in zip(boxes, found, strict=True):
        at = [flint.arb(float(x)) for x in rng.uniform(*box.T)]
        step = flint.arb(2) ** -40
        true = contact(rod, flint.arb(alpha), *at)
        slopes = []
        for i in range(3):
            ends = [
                contact(
                    rod, flint.arb(alpha), *(x + sign * step * (j == i) for j, x in enumerate(at))
                )
                for sign in (1, -1)
            ]
            slopes.append([(a - b) / (2 * step) for a, b in zip(*ends, strict=True)])
        everything = [*true, *(slopes[i][k] for k in range(9) for i in range(3))]
        exact = np.array([float(x.mid()) for x in everything])
        miss = np.abs(exact - enclosure[:, 0]) - enclosure[:, 1:].sum(axis=1)
        assert (miss <= 1e-15 * np.abs(exact) + 1e-16).all()
        # Where a box is a point the enclosure is narrow.
        assert half > 1e-9 or (enclosure[:, 1:].sum(axis=1) < 1e-7 * np.abs(exact).max()).all()

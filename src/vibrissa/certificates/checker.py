"""Independent verification of a certificate's file.

It shares nothing with the search but the file and the lemma, and subdivides the boxes as often as
necessary. Curved whiskers are verified by :mod:`vibrissa.certificates.curved_checker`. For straight
ones this module uses another formulation (arc length in units of the contact's, so that the contact
is at τ = 0 and the base at τ = 1, with derivatives by s_c at fixed τ), and another arithmetic
(linear forms as NumPy arrays over many boxes, each operation rounded outward by itself), without
symbols for remainders.

With F = f², n = f (-fρ, ν), m = fμ, q = (x, fη), w = cμ, c = b⁻⁴, b = β₀ + β₁ s_c (1 - τ):

    ρ' = s_c ν w, ν' = -s_c F ρ w, μ' = s_c ν, x' = s_c (1 - F w η), η' = s_c w x.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.certificates.curved_checker import (
    CURVED_PARTS,
    conditions_hold as curved_conditions_hold,
    domains_match as curved_domains_match,
    is_certificate_of,
)
from vibrissa.io import read_dataset

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

# Rounding error of each operation, as a share of its operands' sizes: 64 units of rounding, of
# which a sum of nine products needs at most 26.
_LOST = 2.0**-47
_ORDER = 9
# Initial step in τ, as a share of the distance to the pole of b or of the length in which the load
# turns the rod, and its reduction with every subdivision.
_STEP, _SHORTER = 0.25, 0.75
# Largest number of subdivisions, and of parts per box, before a box is not confirmed.
_ROUNDS, _MOST = 9, 512
_BATCH = 256
_STATES = 5
PARTS = ("interior", "proximal", "distal", "fold")
# Variables and attributes of every certificate's file, besides those of its parts.
_VARIABLES = ("rod_edges", "rod_local", "rod_coefficients", "rod_twist", "factors", "stations")
_STATED = (
    *("straight", "alpha", "room", "sign", "cone", "whisker", "turns", "refuted", "seconds"),
    "evaluated",
)


@dataclass(frozen=True)
class Form:
    """Linear forms over n boxes: centre (n,), coefficients (unknowns, n) and remainder (n,)."""

    centre: Array
    slope: Array
    rest: Array

    @cached_property
    def reach(self) -> Array:
        """Largest deviation from the centre."""
        return np.asarray((np.abs(self.slope).sum(axis=0) + self.rest) * (1.0 + _LOST))

    @cached_property
    def size(self) -> Array:
        """Largest magnitude."""
        return np.asarray((np.abs(self.centre) + self.reach) * (1.0 + _LOST))

    def __add__(self, other: Form) -> Form:
        lost = _LOST * (self.size + other.size)
        return Form(
            self.centre + other.centre, self.slope + other.slope, self.rest + other.rest + lost
        )

    def __neg__(self) -> Form:
        return Form(-self.centre, -self.slope, self.rest)

    def __sub__(self, other: Form) -> Form:
        return self + (-other)

    def __mul__(self, other: Form | float) -> Form:
        if not isinstance(other, Form):
            rest = abs(other) * self.rest + _LOST * abs(other) * self.size
            return Form(other * self.centre, other * self.slope, rest)
        a, b = self.centre, other.centre
        rest = np.abs(a) * other.rest + np.abs(b) * self.rest + self.reach * other.reach
        return Form(a * b, a * other.slope + b * self.slope, rest + _LOST * self.size * other.size)

    def inverse(self) -> Form:
        """1/x; NaN where x may be zero or less."""
        least = self.centre - self.reach * (1.0 + _LOST)
        least = np.where(least > 0.0, least, np.nan)
        slope = -1.0 / self.centre**2
        rest = -slope * (self.rest + self.reach**2 / least)
        return Form(1.0 / self.centre, slope * self.slope, rest + 4.0 * _LOST / least)

    def blurred(self, by: Array) -> Form:
        """Form without unknowns: the centre and a remainder enlarged by ``by``."""
        none = np.zeros((0, self.centre.size))
        return Form(self.centre, none, (self.reach + by) * (1.0 + _LOST))


class Series:
    """Taylor coefficients of numbers over n boxes, up to an order."""

    def __init__(self, first: Form, order: int) -> None:
        self.centre = np.zeros((order + 1, *first.centre.shape))
        self.slope = np.zeros((order + 1, *first.slope.shape))
        self.rest, self.reach, self.size = (np.zeros_like(self.centre) for _ in range(3))
        self.forms: list[Form] = []
        self.append(first)

    def append(self, form: Form) -> None:
        """Append the next coefficient."""
        k = len(self.forms)
        self.centre[k], self.slope[k], self.rest[k] = form.centre, form.slope, form.rest
        self.reach[k], self.size[k] = form.reach, form.size
        self.forms.append(form)

    def __getitem__(self, k: int) -> Form:
        return self.forms[k]

    def times(self, other: Series, k: int) -> Form:
        """Coefficient k of a product."""
        a, b = self.centre[: k + 1], other.centre[k::-1]
        slope = a[:, None] * other.slope[k::-1] + b[:, None] * self.slope[: k + 1]
        rest = np.abs(a) * other.rest[k::-1] + np.abs(b) * self.rest[: k + 1]
        rest += self.reach[: k + 1] * other.reach[k::-1]
        rest += _LOST * (self.size[: k + 1] * other.size[k::-1])
        return Form((a * b).sum(axis=0), slope.sum(axis=0), rest.sum(axis=0))


class Checked(NamedTuple):
    """Result of a verification.

    Attributes
    ----------
    covers : bool
        Whether the boxes of each part fill its domain once, and the domains match the lemma.
    boxes, confirmed : int
        Numbers of boxes verified and confirmed.
    """

    covers: bool
    boxes: int
    confirmed: int


def check_certificate(
    path: str | PathLike[str],
    number: int | None = 16,
    seed: int = 0,
    parts: Sequence[str] | None = None,
    whisker: Whisker | None = None,
) -> Checked:
    """Verify a certificate independently of the search.

    Parameters
    ----------
    path : str or path
        File of the certificate.
    number : int, optional
        Number of randomly drawn boxes of each part; None for all.
    seed : int
        Seed of the draw.
    parts : sequence of str, optional
        Parts of the domain to verify; by default all.
    whisker : Whisker, optional
        Whisker to which the certificate should belong.

    Returns
    -------
    Checked
        Whether the boxes cover the domain, and how many are confirmed.

    Raises
    ------
    ValueError
        If the file is not a certificate, its numbers have been modified, it belongs to another
        whisker, or the whisker is straight and its radius is not linear.
    """
    data = read_dataset(Path(path)).load()
    if data.attrs.get("kind") != "vibrissa certificate":
        raise ValueError(f"{path} is not a certificate")
    if identity(data) != data.attrs.get("identity"):
        raise ValueError(f"{path} has been modified since it was written, or is of another version")
    refuse_incomplete(data)
    if whisker is not None and not is_certificate_of(data, whisker):
        raise ValueError(f"{path} is a certificate of another whisker")
    straight = bool(data.attrs["straight"])
    known = PARTS if straight else CURVED_PARTS
    parts = known if parts is None else parts
    if not parts or not set(parts) <= set(known):
        raise ValueError(f"parts is {parts!r}; those of this certificate are {', '.join(known)}")
    if number is not None and number < 0:
        raise ValueError(f"the number of boxes is {number}; it must be 0 or more, or None for all")
    rod = data["rod_coefficients"].values
    if straight and not rod[:, :3].any() and (len(rod) > 1 or rod[:, 3, 2:].any()):
        raise ValueError(
            f"{path}: of straight whiskers only those whose radius is linear can be verified"
        )
    rng = np.random.default_rng(seed)
    whole, tried, held = _domains_match(data) if straight else curved_domains_match(data), 0, 0
    conditions_hold = _conditions_hold if straight else curved_conditions_hold
    for part in parts:
        boxes = data[f"{part}_certified"].values.astype(np.int64)
        domain = data[f"{part}_domain"].values
        whole &= covers(boxes)
        chosen = np.arange(len(boxes))
        if number is not None and number < len(boxes):
            chosen = rng.choice(chosen, number, replace=False)
        for start in range(0, len(chosen), _BATCH):
            rows = boxes[chosen[start : start + _BATCH]]
            tried += len(rows)
            bounds = _bounds(rows, domain, data["stations"].values)
            held += int(_confirm(data, part, bounds, conditions_hold).sum())
    return Checked(whole, tried, held)


def refuse_incomplete(data: xr.Dataset) -> None:
    """Raise a ValueError for a certificate that lacks some of what it states."""
    parts = PARTS if data.attrs.get("straight") else CURVED_PARTS
    kinds = ("domain", "certified", "undecided")
    needed = [*_VARIABLES, *(f"{part}_{kind}" for part in parts for kind in kinds)]
    missing = [name for name in needed if name not in data]
    missing += [name for name in _STATED if name not in data.attrs]
    if missing:
        raise ValueError(f"not a complete certificate: it has no {', '.join(missing)}")


def identity(data: xr.Dataset) -> str:
    """Hash of all that a certificate's file states, except of the hash itself."""
    digest = hashlib.sha256()
    for name in sorted(map(str, data.variables)):
        values = np.asarray(data[name].values, dtype=np.float64)
        digest.update(f"{name} {values.shape} ".encode() + values.tobytes())
    for name, value in sorted(data.attrs.items()):
        if name != "identity":
            stated = value if isinstance(value, str) else np.ravel(value).tolist()
            digest.update(f"{name} {stated} ".encode())
    return digest.hexdigest()[:16]


def _domains_match(data: xr.Dataset) -> bool:
    """Whether the rod is a straight cone, and the parts are those of the lemma."""
    rod = data["rod_coefficients"].values
    cone = len(rod) == 1 and not rod[0, :3].any() and not rod[0, 3, 2:].any()
    near = float(data["interior_domain"].values[0, 0])
    ends = np.array([[near, 1, 0, 1], [near, near, 0, 1], [1, 1, 0, 1], [near, 1, 1, 1]])
    fits = all(
        np.array_equal(data[f"{part}_domain"].values.ravel(), end)
        for part, end in zip(PARTS, ends, strict=True)
    )
    return bool(cone and fits and np.array_equal(data["stations"], [near, 1.0]))


def covers(boxes: NDArray[np.int64]) -> bool:
    """Whether boxes, rows of (level, index) by unknown, fill the unit cube exactly once."""
    levels = boxes[..., 0].sum(axis=1).tolist()
    most = max(levels, default=0)
    if sum(1 << (most - level) for level in levels) != 1 << most:
        return False
    number, unknowns = boxes.shape[:2]
    level, index = np.zeros((2, 1, unknowns), dtype=np.int64)
    rows, cell = np.arange(number), np.zeros(number, dtype=np.int64)
    while len(level):
        finer = boxes[rows, :, 0] > level[cell]
        filled = np.zeros(len(level), dtype=bool)
        filled[cell[~finer.any(axis=1)]] = True
        kept = ~filled[cell]
        rows, finer, cell = rows[kept], finer[kept], cell[kept]
        split = np.flatnonzero(~filled)
        if len(np.unique(cell)) < len(split):
            return False
        renumbered = np.cumsum(~filled) - 1
        cell, level, index = renumbered[cell], level[split], index[split]
        wanted = np.stack([np.bincount(cell, one, len(split)) for one in finer.T], axis=1)
        axis = wanted.argmax(axis=1)
        at = np.arange(len(split)), axis
        level[at] += 1
        index[at] *= 2
        own = boxes[rows, axis[cell]]
        shift = own[:, 0] - level[at][cell]
        parts = []
        for half in (0, 1):
            inside = (shift < 0) | (own[:, 1] >> np.maximum(shift, 0) == index[at][cell] + half)
            parts.append((rows[inside], 2 * cell[inside] + half))
        rows, cell = (np.concatenate(one) for one in zip(*parts, strict=True))
        level, index = level.repeat(2, axis=0), index.repeat(2, axis=0)
        index[np.arange(1, len(index), 2), axis] += 1
    return True


def _bounds(boxes: NDArray[np.int64], domain: Array, stations: Array) -> Array:
    """Bounds (n, unknowns, 2), slightly widened; arc lengths are interpolated between stations."""
    share = (boxes[..., 1, None] + [0, 1]) / 2.0 ** boxes[..., 0, None]
    out = domain[:, :1] + (domain[:, 1:] - domain[:, :1]) * share
    if domain[0, 0] < domain[0, 1]:
        out[:, 0] = np.interp(share[:, 0], np.linspace(0.0, 1.0, len(stations)), stations)
    blur = _LOST * np.abs(domain).max(axis=1)[:, None]
    return np.asarray(out + blur * [-1.0, 1.0])


def _confirm(
    data: xr.Dataset, part: str, bounds: Array, conditions_hold: Callable[..., NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """Whether all conditions hold on each box, subdivided as often as necessary."""
    owner, holds = np.arange(len(bounds)), np.ones(len(bounds), dtype=bool)
    for halved in range(_ROUNDS):
        step = _STEP * max(_SHORTER**halved, 0.25)
        batches = [bounds[i : i + _BATCH] for i in range(0, len(bounds), _BATCH)]
        with np.errstate(all="ignore"):  # failed enclosures overflow
            good = np.concatenate([conditions_hold(data, part, batch, step) for batch in batches])
        owner, bounds = owner[~good], bounds[~good]
        if not len(owner):
            return holds
        if len(bounds) > _MOST * len(holds):
            break
        for axis in range(bounds.shape[1]):
            if (bounds[:, axis, 1] - bounds[:, axis, 0] > 1e-12).any():
                lower, upper = bounds.copy(), bounds.copy()
                lower[:, axis, 1] = upper[:, axis, 0] = bounds[:, axis].mean(axis=1)
                bounds, owner = np.concatenate([lower, upper]), np.concatenate([owner, owner])
    holds[owner] = False
    return holds


def _conditions_hold(data: xr.Dataset, part: str, bounds: Array, step: float) -> NDArray[np.bool_]:
    """Whether all conditions of a part are proved to be positive on each box."""
    n = len(bounds)
    factors = data["factors"].values[1]

    def known(value: float, spread: float = 0.0) -> Form:
        return Form(np.full(n, value), np.zeros((2, n)), np.full(n, spread))

    def unknown(axis: int) -> Form:
        middle, half = bounds[:, axis].mean(axis=1), np.ptp(bounds[:, axis], axis=1) / 2.0
        slope = np.zeros((2, n))
        slope[axis] = half * (1.0 + _LOST) + _LOST * np.abs(middle)
        return Form(middle, slope, np.zeros(n))

    s, level = unknown(0), unknown(1)
    # b = β₀ + β₁ s, from the stored polynomial in a local variable.
    own = [known(*data["rod_coefficients"].values[0, 3, i]) for i in range(2)]
    slope, offset = (known(*one) for one in data["rod_local"].values[0, 3])
    beta = [own[0] + own[1] * offset, own[1] * slope]
    inverse = s.inverse()
    q = inverse - known(float(data.attrs["alpha"]))
    p, dp = known(0.0), known(0.0)
    for factor in factors[::-1]:
        dp = dp * s + p
        p = p * s + known(float(factor))
    limit = q * q * p
    rise = q * q * dp - q * (inverse * inverse) * p * 2.0
    load = limit * limit * level
    if (base := _integrate_to_base(s, load, beta, part == "fold", step)) is None:
        return np.zeros(n, dtype=bool)
    (r, _, m, *_), (r_s, _, m_s, x_s, e_s), (r_f, _, m_f, x_f, e_f) = base
    if part == "fold":
        eta = base[0][4]
        point = (load * x_f * e_s) * 2.0 - x_s * (eta + load * e_f * 2.0)
        wanted = [point, eta]
    elif part == "interior":
        along = m + load * m_f * 2.0
        ratio = r_f * m - r * m_f * 2.0
        determinant = along * (r_s * m - r * m_s * 2.0) - load * m_s * ratio * 2.0
        wanted = [limit, m, -(limit * m_s + rise * along), determinant]
    else:
        wanted = [r_f * m - r * m_f * 2.0]
    least = np.min([one.centre - one.reach * (1.0 + _LOST) for one in wanted], axis=0)
    return np.asarray(least > 0.0)


def _taylor_series(
    s: Form, load: Form, beta: list[Form], rest: Form, states: list[Form], order: int, fold: bool
) -> list[Series]:
    """Taylor coefficients in τ of all states, at 1 - τ = ``rest``, and of 1/b."""
    zero, one = s * 0.0, Form(s.centre * 0.0 + 1.0, s.slope * 0.0, s.rest * 0.0)
    slope = -(beta[1] * s)  # db/dτ
    x = [Series(state, order) for state in states]
    g = Series((beta[0] + beta[1] * s * rest).inverse(), order)
    (r, v, m, p, e), (r_s, v_s, m_s, p_s, e_s), (r_f, v_f, m_f, p_f, e_f) = (
        x[i * _STATES : (i + 1) * _STATES] for i in range(3)
    )
    names = ("g2", "c", "g5", "c_s", "w", "w_s", "w_f", "z", "z_s", "z_f", "y", "y_s", "y_f")
    a = {name: Series(zero, order) for name in names}
    for series in a.values():
        series.forms.clear()
    c, c_s, w, w_s, w_f = (a[name] for name in ("c", "c_s", "w", "w_s", "w_f"))
    for k in range(order):
        a["g2"].append(g.times(g, k))
        c.append(a["g2"].times(a["g2"], k))
        a["g5"].append(c.times(g, k))
        g.append(-(slope * a["g2"][k]) * (1.0 / (k + 1)))
        moved = a["g5"][k] * rest - (a["g5"][k - 1] if k else zero)
        c_s.append(beta[1] * moved * -4.0)
        w.append(c.times(m, k))
        w_s.append(c_s.times(m, k) + c.times(m_s, k))
        w_f.append(c.times(m_f, k))
        a["z"].append(r.times(w, k))
        a["z_s"].append(r_s.times(w, k) + r.times(w_s, k))
        a["z_f"].append(r_f.times(w, k) + r.times(w_f, k))
        z, z_s, z_f = (a[name][k] for name in ("z", "z_s", "z_f"))
        turned = v.times(w, k)
        rates = [zero] * len(x)
        rates[:3] = [s * turned, -(s * (load * z)), s * v[k]]
        rates[5] = turned + s * (v_s.times(w, k) + v.times(w_s, k))
        rates[6] = -(load * z) - s * (load * z_s)
        rates[7] = v[k] + s * v_s[k]
        rates[10] = s * (v_f.times(w, k) + v.times(w_f, k))
        rates[11] = -(s * (z + load * z_f))
        rates[12] = s * v_f[k]
        if fold:
            a["y"].append(w.times(e, k))
            a["y_s"].append(w_s.times(e, k) + w.times(e_s, k))
            a["y_f"].append(w_f.times(e, k) + w.times(e_f, k))
            y, y_s, y_f = (a[name][k] for name in ("y", "y_s", "y_f"))
            unit, along = (one if k == 0 else zero), w.times(p, k)
            rates[3], rates[4] = s * (unit - load * y), s * along
            rates[8] = unit - load * y - s * (load * y_s)
            rates[9] = along + s * (w_s.times(p, k) + w.times(p_s, k))
            rates[13] = -(s * (y + load * y_f))
            rates[14] = s * (w_f.times(p, k) + w.times(p_f, k))
        for series, rate in zip(x, rates, strict=True):
            series.append(rate * (1.0 / (k + 1)))
    return [*x, g]


def _integrate_to_base(
    s: Form, load: Form, beta: list[Form], fold: bool, step: float
) -> list[list[Form]] | None:
    """States at the base, and their derivatives by s_c and F; None if they cannot be enclosed."""
    zero = s * 0.0
    one = Form(zero.centre + 1.0, zero.slope, zero.rest)
    states = [zero] * (3 * _STATES)
    states[1] = one
    tau, none = 0.0, np.zeros(len(s.centre))
    while tau < 1.0:
        b = beta[0] + beta[1] * s * (1.0 - tau)
        pole = (b.centre - b.reach) / (np.abs(beta[1].centre) * s.centre + 1e-9)
        turn = b.centre**2 / (s.centre * np.sqrt(np.maximum(load.centre, 1e-9)) * 1.6)
        h = float(step * np.minimum(pole, turn).min())
        if not h > 1e-4:
            return None
        # A multiple of a power of two, so that tau is exact.
        h = min(np.floor(h * 2.0**20) / 2.0**20, 1.0 - tau)
        x = _taylor_series(s, load, beta, one * (1.0 - tau), states, _ORDER - 1, fold)
        wide = [f.blurred(none) for f in (s, load, *beta)]
        over = (one * (1.0 - tau - 0.5 * h)).blurred(none + 0.5 * h)
        guess = [a[-1].size * h ** (_ORDER - 1) + 1e-9 * a[0].size + 1e-12 for a in x]
        for _ in range(8):
            spans = [
                a[0].blurred(sum(c.size * h**k for k, c in enumerate(a.forms) if k) + e)
                for a, e in zip(x, guess, strict=True)
            ]
            y = _taylor_series(wide[0], wide[1], wide[2:], over, spans[:-1], _ORDER, fold)
            grown = [a[-1].size * h**_ORDER * (1.0 + 1e-9) for a in y]
            if all((e <= p).all() for e, p in zip(grown, guess, strict=True)):
                break
            guess = [2.0 * np.maximum(e, p) for e, p in zip(grown, guess, strict=True)]
            if not np.isfinite(guess[0]).all():
                return None
        else:
            return None
        ahead = []
        for a, e in zip(x[:-1], grown[:-1], strict=True):
            value = a[-1]
            for k in range(len(a.forms) - 2, -1, -1):
                value = value * h + a[k]
            ahead.append(Form(value.centre, value.slope, value.rest + e))
        states, tau = ahead, tau + h
    return [states[i * _STATES : (i + 1) * _STATES] for i in range(3)]

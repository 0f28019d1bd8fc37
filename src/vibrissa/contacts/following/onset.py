"""Gaussian mixture for the contact point at contact onset, from one measurement.

A light contact is poorly localised: the likelihood is a long, bent valley. It is therefore split
along the whisker by windows N(s; s_j, h²), a distance h apart, whose sum is constant. Where
likelihood and window together are largest in Ω, a Gaussian is placed with their mean and covariance
(:mod:`~vibrissa.contacts.uncertainty.moments`), and with the weight

    log w = -χ²/2 + log ∫ exp((χ² - χ²(p))/2) π(p) dp + log det W.

If the measurement determines the arc length well, the Gaussians are combined again into one.

Near slip-off, volumes of contact points nearly vanish although contacts occur there. Separate
groups of Gaussians therefore have the mean of two probabilities: with volumes, and from the highest
likelihood in each group alone, as the candidates of an estimate do
(:mod:`~vibrissa.contacts.engine.ranking`).

A contact that was not detected in the sample before has bent the whisker no farther than it has
moved since. With u, the distance of the contact point from its rest position over L, the prior is

    π = m (m² + u²)^(-3/2) / 2π,

with m the distance by which whisker and objects may have approached each other. It is a scale and
not a bound, since the distribution has a long tail; its integral over all positions is one.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import Contact
from vibrissa.contacts.engine.readout import Measurement, Named
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.fitting.fit_within import fit_rows_within
from vibrissa.contacts.fitting.least_squares import Fits, unknowns_covariance
from vibrissa.contacts.following.mixture import log_weights
from vibrissa.contacts.sensing.channels import (
    CHANNELS,
    CIRCULAR,
    FITTED,
    channel_derivatives,
    channel_gradients,
    channels_of,
    wrenches_of,
)
from vibrissa.contacts.sensing.noise import common_channels
from vibrissa.contacts.sensing.weighing import Weighing, weigh
from vibrissa.contacts.uncertainty.moments import Onset, moments_of_rows
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import LEAST_ARC, Discretization, charted_rod, solve_forces
from vibrissa.signals import within_turn

# Number of windows along the whisker; further ones beyond each end, where the sum of the others
# falls; and sectors of bearings in each, from which fits start.
_WINDOWS = 16
_BEYOND = 2
_SECTORS = 4
_WORSE = 30.0  # excess of χ² over the best component above which one is dropped
# Standard deviation of arc length, in windows, below which a candidate may remain whole; its parts
# are the Gaussians within this squared Mahalanobis distance, by the sum of both covariances.
_SHARP, _PART = 0.5, 9.0
_MOST = 24  # largest number of samples of a surface from which hypotheses start
_BETWEEN = 16  # parts into which a curve is divided between two sections of the whisker
_HELD = 1e4  # weight of the arc length (over L) of a point of a curve that is searched for
_VAGUE = 0.2  # standard deviation, over L, of what a measurement does not determine
# Smallest standard deviation of a starting hypothesis, over L, so that matrices stay regular.
_FINEST = 1e-7
# Squared Mahalanobis distance, by the sum of both covariances, below which hypotheses form one
# group without a gap.
_TOGETHER = 4.0
# Squared Mahalanobis distance, by either covariance, below which Gaussians form one group for the
# prior; a narrow one within a wide one is separate.
_SEPARATE = 9.0
# Codes of arc length and contact point among the channels.
_STATION, _POINT = FITTED.index("s"), [FITTED.index(name) for name in ("px", "py", "pz")]
# Displacement along each axis of a covariance at which its linearisation is checked, in standard
# deviations, and its largest relative error there.
_REACH, _BENT = 2.0, 0.25
_LOG_TURN = math.log(2.0 * math.pi)
_FLAT = 1e-12  # smallest variance of a contact point, relative to that in all directions


class Gaussians(NamedTuple):
    """Gaussians of contact points in the whisker's frame, over L, one about each contact.

    x (n, 4), (F, p) (n, 6), means (n, 3), covariances (n, 3, 3), effects of shared errors on p (n,
    3, e), log weights, and log densities of the measurement at the contacts (n,).
    """

    contacts: Array
    values: Array
    points: Array
    covariances: Array
    by_errors: Array
    weights: Array
    likely: Array


class Beginning:
    """Represents the information of one measurement by Gaussians."""

    def __init__(self, estimator: Estimator) -> None:
        self._readout, self._chart = estimator.readout, estimator.contact_map.chart
        how = self._readout.how
        self._names = tuple(CHANNELS[code] for code in how.codes)
        # Noise only, without the errors that all samples share.
        self._quiet = how._replace(errors=np.zeros((0, 6, 7)))
        chart = self._chart
        self._width = (1.0 - chart.proximal) / (_WINDOWS - 1)
        steps = np.arange(-_BEYOND, _WINDOWS + _BEYOND)
        self._stations = chart.proximal + steps * self._width
        charted = chart.contacts[:, 0, 0, 0]
        some = np.abs(charted - self._stations[:, None]).argmin(axis=1)
        self._nodes = chart.contacts[some]
        self._values = chart.values[some]
        self._seen = channels_of(self._values)[..., how.codes] @ how.mixing.T
        named = isinstance(self._readout, Named)
        self._circular = np.array([named and CIRCULAR[code] for code in how.codes])
        self._kinds = [CHANNELS[code][0] if named else "" for code in how.codes]
        places = np.linspace(0.0, 1.0, 101)
        at = np.zeros((101, 4))
        at[:, 0] = places
        self._rest = np.ascontiguousarray(solve_forces(chart.discretization, at)[0][:, 3:])
        self._rest_places = places

    def all_that_may_be(
        self, measurement: Measurement, located: Contact, reach: float
    ) -> Gaussians:
        """Split the likelihood over all contacts into Gaussians."""
        nodes, values, window = self._starts(measurement)
        exact, there = self.exact(located)
        nearest = np.abs(exact[:, :1] - self._stations).argmin(axis=1)
        x = np.concatenate([np.insert(nodes, 1, 0.0, axis=1), exact])
        values, window = np.concatenate([values, there]), np.concatenate([window, nearest])
        fits = self._fitted(measurement, x, values, self._stations[window], 1.0 / self._width)
        worst = fits.misfits.min(initial=np.inf) + _WORSE
        good = np.isfinite(fits.misfits) & (fits.misfits <= worst)
        rows = _distinct(fits.contacts, window, np.flatnonzero(good))
        best = Fits(*(part[rows] for part in fits))
        bent = np.zeros(len(rows), np.bool_)
        valley = self._gaussians(measurement, best, reach, bent, window[rows])
        whole, sharp = self._whole(measurement, located, reach)
        kept = np.ones(len(valley.contacts), np.bool_)
        for i in sharp.tolist():
            away = valley.points - whole.points[i]
            both = valley.covariances + whole.covariances[i]
            far = (away * np.linalg.solve(both, away[..., None])[..., 0]).sum(axis=1)
            kept &= far > _PART
        parts = zip(valley, whole, strict=True)
        return _both_priors(Gaussians(*(np.concatenate([a[kept], b[sharp]]) for a, b in parts)))

    def candidates(self, measurement: Measurement, located: Contact, reach: float) -> Gaussians:
        """Gaussians of the separate candidates of one sample, unsplit."""
        return self._whole(measurement, located, reach)[0]

    def _whole(
        self, measurement: Measurement, located: Contact, reach: float
    ) -> tuple[Gaussians, IntArray]:
        """Nearly linear candidates of one sample, and the rows of those well within a window."""
        x, values = self.exact(located)
        slope = np.insert(
            solve_forces(self._chart.discretization, x, tangents=True)[1], 1, 0.0, axis=2
        )
        w = self._weights(self._quiet, measurement, values)
        with np.errstate(over="ignore", invalid="ignore"):
            own = unknowns_covariance(self._names, values, slope, w, friction=False)
            d = self._chart.discretization
            linear = _linear(d, self._names, w, x, values, slope, own, LEAST_ARC)
            sharp = linear & (own[:, 0, 0] < (_SHARP * self._width) ** 2)
        misfits = np.array(located.candidates.chi_squared)
        fits = Fits(x, values, slope, misfits, np.ones(len(x), np.bool_))
        return self._gaussians(measurement, fits, reach, sharp), np.flatnonzero(sharp)

    def samples(self, measurement: Measurement, located: Contact, reach: float) -> Gaussians:
        """Gaussians about samples of a curve or surface of contacts, without gaps."""
        x, values = self.exact(located)
        if self._readout.rank == 2 and len(x) > 1:
            x, values = self._denser(measurement, x, values)
        elif len(x) > _MOST:
            some = np.linspace(0, len(x) - 1, _MOST).astype(int)
            x, values = x[some], values[some]
        _, slope = solve_forces(self._chart.discretization, x, tangents=True)
        w = self._weights(self._quiet, measurement, values)
        across, by_errors = self._across(w, values, slope)
        covariance = across + _gaps_between(values[:, 3:]) + _FINEST**2 * np.eye(3)
        points = values[:, 3:]
        likely = self._log_prior(x, points, reach) - 0.5 * located.chi_squared
        likely += self._log_determinants(w)
        weights = likely + 0.5 * np.linalg.slogdet(covariance)[1] + 1.5 * _LOG_TURN
        return Gaussians(x, values, points, covariance, by_errors, weights, likely)

    def _denser(self, measurement: Measurement, x: Array, values: Array) -> tuple[Array, Array]:
        """Samples of a curve, and points of it between those that are nearest to each other.

        A curve is far more precise across than along it. A Gaussian as long as the distance of the
        sections departs from it by many standard deviations, and where it intersects the curve of
        the next sample states nothing of the contact.
        """
        section = np.unique(np.round(x[:, 0], 6), return_inverse=True)[1]
        far = np.linalg.norm(values[:, None, 3:] - values[None, :, 3:], axis=2)
        far[section[:, None] + 1 != section] = np.inf
        after = far.argmin(axis=1)
        mutual = (far.argmin(axis=0)[after] == np.arange(len(x))) & np.isfinite(far.min(axis=1))
        share = np.arange(1, _BETWEEN)[:, None] / _BETWEEN
        ends = zip(x[mutual], x[after[mutual]], strict=True)
        new = np.array([(1.0 - share) * a + share * b for a, b in ends]).reshape(-1, 4)
        there, _ = solve_forces(self._chart.discretization, new)
        fits = self._fitted(measurement, new, there, new[:, 0], _HELD)
        good = fits.misfits < 1.0
        return np.append(x, fits.contacts[good], axis=0), np.append(
            values, fits.values[good], axis=0
        )

    def _across(self, w: Array, values: Array, slope: Array) -> tuple[Array, Array]:
        """Covariances across a curve or surface, and the effects of shared errors."""
        force = np.linalg.norm(values[:, :3], axis=1)
        unit = slope * np.stack([np.ones_like(force), force, force], axis=1)[:, None]
        back = np.linalg.pinv(w @ channel_derivatives(values, unit, self._names), rcond=1e-9)
        root = unit[:, 3:] @ back
        return root @ np.swapaxes(root, 1, 2), root @ w @ self._wrong(values)

    def _wrong(self, values: Array) -> Array:
        """Effects of shared errors on channels, (n, k, e)."""
        g = channel_gradients(values, self._names)
        return common_channels(self._readout.how.errors, g, wrenches_of(values))

    def exact(self, located: Contact) -> tuple[Array, Array]:
        """Candidates of one sample as x (n, 4) and (F, p) (n, 6), non-dimensional."""
        d, n, found = self._chart.discretization, located.n_candidates, located.candidates
        x, values = np.empty((n, 4)), np.empty((n, 6))
        x[:, 0], x[:, 1:] = found.arc_length / d.length, found.contact_force / d.force
        values[:, :3], values[:, 3:] = found.force / d.force, found.point / d.length
        return x, values

    def _starts(self, measurement: Measurement) -> tuple[Array, Array, IntArray]:
        """Nearest nodes ξ (n, 3) of the chart, with (F, p), and the window of each."""
        how = self._readout.how
        wanted = how.mixing @ measurement.target
        away = self._seen - wanted
        turns = self._circular[: len(wanted)]
        if turns.any():
            away[..., turns] = np.pi - (np.pi - away[..., turns]) % (2.0 * np.pi)
        for kind in ("F", "M"):
            same = [i for i, k in enumerate(self._kinds) if k == kind and not self._circular[i]]
            if same:
                size = float(np.linalg.norm(wanted[same]))
                away[..., same] /= size if size > 0.0 else 1.0
        far = (away * away).sum(axis=-1)
        n, m, k = far.shape
        edges = np.linspace(0, m, _SECTORS + 1).astype(int)
        place = []
        for first, last in pairwise(edges.tolist()):
            least = far[:, first:last].reshape(n, -1).argmin(axis=1)
            place.append((np.arange(n), first + least // k, least % k))
        i, j, load = (np.concatenate(part) for part in zip(*place, strict=True))
        return self._nodes[i, j, load], self._values[i, j, load], i

    def _log_determinants(self, weights: Array) -> Array:
        """Half the log determinants (n,) of the weights (n, k, k) of what is measured."""
        q = len(self._readout.how.mixing)
        return np.array([log_weights(one, q) for one in weights])

    def _weights(self, how: Weighing, measurement: Measurement, values: Array) -> Array:
        k = len(self._names)
        out = np.zeros((len(values), k, k))
        for value, one in zip(values, out, strict=True):
            if not weigh(how, value, measurement.measured, one):
                one[:] = 0.0
        return out

    def _fitted(
        self, measurement: Measurement, x: Array, values: Array, stations: AnyArray, held: float
    ) -> Fits:
        """Contacts in Ω of minimum χ² of a measurement and stations (n,), of weight ``held``."""
        chart, how, k = self._chart, self._readout.how, len(self._names)
        n = len(x)
        fits = Fits(
            np.array(x), np.array(values), np.zeros((n, 6, 4)), np.zeros(n), np.zeros(n, np.bool_)
        )
        targets = np.tile(np.append(measurement.target, 0.0), (n, 1))
        targets[:, k] = stations
        weights = np.zeros((n, k + 1, k + 1))
        weights[:, k, k] = held
        rod, measured = charted_rod(chart), measurement.measured
        codes, before = np.append(how.codes, _STATION), fits.contacts.copy()
        for _ in range(self._readout.passes):
            before[:] = fits.contacts
            weights[:, :k, :k] = self._weights(how, measurement, fits.values)
            fit_rows_within(rod, chart.proximal, how, codes, targets, measured, weights, fits)
            if np.allclose(before, fits.contacts, rtol=1e-5, atol=1e-9):
                break
        known = np.isfinite(fits.misfits) & np.isfinite(fits.values).all(axis=1)
        return fits._replace(misfits=np.where(known, fits.misfits, np.inf))

    def _gaussians(
        self,
        measurement: Measurement,
        fits: Fits,
        reach: float,
        linear: AnyArray,
        windows: IntArray | None = None,
    ) -> Gaussians:
        """Means, covariances and weights of contacts, from their χ² and windows, if any."""
        n, k = len(fits.contacts), len(self._names)
        chart, x = self._chart, fits.contacts
        w = self._weights(self._quiet, measurement, fits.values)
        codes = np.concatenate([self._readout.how.codes, [_STATION], _POINT])
        targets, weights = np.empty((n, k + 4)), np.zeros((n, k + 4, k + 4))
        targets[:, :k], targets[:, k + 1 :] = measurement.target, fits.values[:, 3:]
        targets[:, k] = x[:, 0] if windows is None else self._stations[windows]
        weights[:, :k, :k] = w
        weights[:, k, k] = 0.0 if windows is None else 1.0 / self._width
        weights[:, [k + 1, k + 2, k + 3], [k + 1, k + 2, k + 3]] = 1.0 / _VAGUE
        shift, covariance = np.zeros((n, 3)), np.full((n, 3, 3), np.nan)
        by_channels, mass = np.zeros((n, 3, k + 4)), np.empty(n)
        rod, onset = charted_rod(chart), Onset(self._rest, reach)
        out = shift, covariance, by_channels, mass
        moments_of_rows(rod, chart.proximal, onset, codes, targets, weights, fits, linear, *out)
        known = mass > 0.0
        covariance[~known] = _VAGUE**2 * np.eye(3)
        covariance += _FINEST**2 * np.eye(3)
        by_errors = by_channels[:, :, :k] @ w @ self._wrong(fits.values)
        likely = self._log_determinants(w) - 0.5 * fits.misfits
        likely += self._log_prior(x, fits.values[:, 3:], reach)
        total = likely + np.log(np.where(known, mass, 1.0)) + 1.5 * _LOG_TURN
        if windows is not None:
            total -= 0.5 * _LOG_TURN
        total[~known] = -np.inf
        points = fits.values[:, 3:] + shift
        return Gaussians(x, fits.values, points, covariance, by_errors, total, likely)

    def _log_prior(self, x: Array, points: Array, reach: float) -> Array:
        rest = np.stack(
            [np.interp(x[:, 0], self._rest_places, column) for column in self._rest.T], axis=1
        )
        u2 = ((points - rest) ** 2).sum(axis=1)
        return np.asarray(math.log(reach / (2.0 * math.pi)) - 1.5 * np.log(reach**2 + u2))

    def moved(self, turn: Array, base: Array, before: tuple[Array, Array]) -> float:
        """Largest displacement of the resting whisker, over L, since another pose of its base."""
        now = self._rest @ turn.T + base
        then = self._rest @ before[0].T + before[1]
        return float(np.sqrt(((now - then) ** 2).sum(axis=1).max()))


def _both_priors(found: Gaussians) -> Gaussians:
    """Average the probabilities of separate groups with volumes and from likelihoods alone.

    Near slip-off volumes nearly vanish, although contacts occur there.
    """
    known = np.isfinite(found.weights)
    found = Gaussians(*(part[known] for part in found))
    spreads = _whole_covariances(found.covariances, found.by_errors)
    far = _squared_distances(found.points, spreads[:, None])
    group = _connected(np.maximum(far, far.T) < _SEPARATE)
    if not group.any():
        return found
    volumes, fits = np.full((2, group.max() + 1), -np.inf)
    np.logaddexp.at(volumes, group, found.weights)
    np.maximum.at(fits, group, found.likely)
    shares = [np.exp(log - np.logaddexp.reduce(log)) for log in (volumes, fits)]
    change = np.log(0.5 * (shares[0] + shares[1])) - volumes
    return found._replace(weights=found.weights + change[group])


def groups(points: Array, covariances: Array, by_errors: Array) -> IntArray:
    """Index (n,) of the group of each Gaussian: Gaussians without a gap between them."""
    spreads = _whole_covariances(covariances, by_errors)
    return _connected(_squared_distances(points, spreads[:, None] + spreads) < _TOGETHER)


def _whole_covariances(covariances: Array, by_errors: Array) -> Array:
    """Covariances that include the effects of shared errors."""
    return np.asarray(covariances + by_errors @ np.swapaxes(by_errors, 1, 2))


def _squared_distances(points: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances (n, n) of all points (n, 3) from each other."""
    apart = points[:, None] - points
    return np.asarray((apart * np.linalg.solve(covariances, apart[..., None])[..., 0]).sum(axis=-1))


def _connected(near: AnyArray) -> IntArray:
    """Index (n,) of the connected part of a symmetric graph (n, n) to which each node belongs."""
    reached, before = near, ~near
    while (reached != before).any():
        before, reached = reached, reached @ reached
    return np.unique(reached.argmax(axis=1), return_inverse=True)[1]


def _gaps_between(points: Array) -> Array:
    """Covariances (n, 3, 3) by which samples fill half of the gaps to their two nearest others."""
    if len(points) < 2:
        return np.zeros((len(points), 3, 3))
    apart = points[None] - points[:, None]
    order = np.argsort((apart**2).sum(axis=2), axis=1)[:, 1:3]
    near = np.take_along_axis(apart, order[:, :, None], axis=1)
    return np.asarray(0.25 * np.einsum("nki,nkj->nij", near, near) / near.shape[1])


def _distinct(x: Array, window: IntArray, rows: IntArray) -> list[int]:
    """Rows that do not repeat the contact and window of an earlier one."""
    kept: list[int] = []
    for row in rows.tolist():
        others = [other for other in kept if window[other] == window[row]]
        force = math.hypot(x[row, 2], x[row, 3])
        same = np.abs(x[others, 0] - x[row, 0]) < 1e-3
        same &= np.abs(x[others, 2:] - x[row, 2:]).sum(axis=1) < 1e-2 * force
        if not same.any():
            kept.append(row)
    return kept


def _linear(
    discretization: Discretization,
    names: tuple[str, ...],
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    covariance: Array,
    least: float,
) -> AnyArray:
    """Whether a covariance describes the scatter of the contact point, tested on the rod.

    The rod is solved two standard deviations to both sides of the contact along each principal axis
    of the covariance of x. There, channels and contact point must agree with the derivatives to a
    quarter of the displacement, in standard deviations, and the contact must be on the whisker.
    Near slip-off the derivatives leave the contact point one direction in which it cannot move,
    and its true displacement there is many standard deviations long.
    """
    finite = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(values).all(axis=1)
    good: AnyArray = np.asarray(finite)
    rows = np.flatnonzero(good)
    if not rows.size:
        return good
    x, value, slope, w = contacts[rows], values[rows], tangents[rows], weights[rows]
    axes = _principal_axes(covariance[rows], x)
    if not covariance[rows, 1, 1].any():
        axes = axes[:, :, 1:]  # without friction the first axis has no length
    steps = _REACH * np.concatenate([axes, -axes], axis=2)  # (n, 4, 2 axes)
    places = x[:, None, :] + np.swapaxes(steps, 1, 2)
    on = (places[..., 0] >= least) & (places[..., 0] <= 1.0)
    places[..., 0] = np.clip(places[..., 0], least, 1.0)
    moved, _ = solve_forces(discretization, places.reshape(-1, 4))
    moved = moved.reshape(*places.shape[:2], 6)
    which = [CHANNELS.index(name) for name in names]
    away = (channels_of(moved) - channels_of(value)[:, None])[..., which]
    away = within_turn(away, [CIRCULAR[w] for w in which])
    predicted = np.swapaxes(channel_derivatives(value, slope, names) @ steps, 1, 2)
    bent = np.linalg.norm(np.einsum("nij,nmj->nmi", w, away - predicted), axis=2)
    point_predicted = np.swapaxes(slope[:, 3:] @ steps, 1, 2)
    off = moved[..., 3:] - value[:, None, 3:] - point_predicted
    spread = np.einsum("nij,njk,nlk->nil", slope[:, 3:], covariance[rows], slope[:, 3:])
    size = np.trace(spread, axis1=1, axis2=2)[:, None, None]
    spread += (_FINEST**2 + _FLAT * size) * np.eye(3)
    off = (off[..., None, :] @ np.linalg.solve(spread[:, None], off[..., None]))[..., 0, 0]
    bent = np.maximum(bent, np.sqrt(off))
    still = (steps == 0.0).all(axis=1)
    good[rows] = (on & (bent <= _BENT * _REACH) | still).all(axis=1)
    return good


def _principal_axes(covariance: Array, x: Array) -> Array:
    """Square roots of covariances along their principal axes (in columns), scaled by x."""
    force = np.linalg.norm(x[:, 1:], axis=1)
    size = np.stack([np.ones_like(force), force, force, force], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.nan_to_num(covariance / (size[:, :, None] * size[:, None, :]))
    values, vectors = np.linalg.eigh(scaled)
    values = np.where(values > 1e-14 * values[:, -1:], values, 0.0)
    return np.asarray(size[:, :, None] * vectors * np.sqrt(values)[:, None, :])

"""The paper's network, trained to compute a contact point from three signals.

A perceptron of three layers of rectifiers is trained on random contacts of Ω outside the cone of 2°
about rest. Its inputs are cube roots of magnitudes, which span orders of magnitude, and cosine and
sine of directions, all standardised. Where two contacts have the same signals no function can
return both; a large error on contacts not used in training is therefore evidence (weak, because
insufficient training causes it too) that the triplet is not unique.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from vibrissa.contacts import ContactMap, Prior, within_paper_bounds
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import contacts_at, solve_forces, with_normal_force
from vibrissa.signals import CIRCULAR, SIGNALS, cone_angle, selection, signals_of, within_cone

#: Quantiles of a network's errors that are stored as evidence on a triplet.
QUANTILES = (0.5, 0.95)
# Largest share of the force at slip-off, which the chart approximates to about 1e-4.
_SHARE_OF_FOLD = 0.999
_LAYERS = (64, 64, 64)
_BATCH = 256
_EPOCHS = 60
_PATIENCE = 10
# Distance from training signals, over the largest of held-out ones, above which the result is NaN.
_MARGIN = 2.0


@dataclass(frozen=True, eq=False)
class DrawnContacts:
    """Random stable contacts, SI units except ξ."""

    contacts: Array  # (n, 3), ξ
    point: Array
    force: Array
    moment: Array

    @cached_property
    def signals(self) -> Array:
        """All six signals (n, 6), SI units."""
        return signals_of(self.force, self.moment)


def draw_contacts(
    contact_map: ContactMap, number: int, seed: int, *, near_rest: bool = False
) -> DrawnContacts:
    """Draw stable contacts, uniform in arc length, bearing and share of the fold force."""
    rng, kept, missing = np.random.default_rng(seed), [], number
    d, fold = contact_map.chart.discretization, contact_map.chart.fold
    while missing > 0:
        share = rng.uniform(size=(number, 3))
        share[:, 1] = np.pi * (2.0 * share[:, 1] - 1.0)
        share[:, 2] = np.sqrt(_SHARE_OF_FOLD * share[:, 2])
        xi = contacts_at(fold, share)
        values, _ = solve_forces(d, with_normal_force(xi))
        wanted = near_rest | ~within_cone(contact_map.whisker, values[:, 3:] * d.length)
        kept.append(np.concatenate([xi, values], axis=1)[wanted][:missing])
        missing -= len(kept[-1])
    rows = np.concatenate(kept) if kept else np.empty((0, 9))
    force, point = rows[:, 3:6] * d.force, rows[:, 6:] * d.length
    return DrawnContacts(rows[:, :3], point, force, np.cross(point, force))


@dataclass(frozen=True, eq=False)
class NetworkSolver:
    """A trained network; created by :func:`train_network`.

    Attributes
    ----------
    names : tuple of str
        Names of the three signals.
    held_out : DrawnContacts
        Contacts not used in training.
    errors : (n,) array
        Distances of the predictions for those contacts, m.
    """

    names: tuple[str, ...]
    held_out: DrawnContacts
    errors: Array
    _predict: _Prediction

    def __call__(self, signals: Array) -> Array:
        """Predict contact points (n, 3) from signals (n, 3)."""
        return self._predict(signals)

    def error_quantiles(
        self, shares: ArrayLike = (0.5, 0.95), keep: AnyArray | None = None
    ) -> Array:
        """Quantiles of the errors on held-out contacts.

        Parameters
        ----------
        shares : array_like
            Quantiles, as shares of the contacts.
        keep : (n,) bool array, optional
            Held-out contacts to include, such as those in a region; by default all.

        Returns
        -------
        array
            Errors, m, of the shape of ``shares``; NaN if no contact is kept.
        """
        errors = self.errors if keep is None else self.errors[keep]
        shares = np.asarray(shares, dtype=np.float64)
        if errors.size == 0:
            return np.full(shares.shape, np.nan)
        return np.asarray(np.quantile(errors, shares))


@dataclass(frozen=True, eq=False)
class _Prediction:
    """The network with standardisation of its inputs and outputs."""

    circular: AnyArray
    mean: Array
    deviation: Array
    centre: Array
    size: Array
    network: Any
    known: cKDTree
    reach: float

    def __call__(self, signals: Array) -> Array:
        out = np.full((len(signals), 3), np.nan)
        rows = np.flatnonzero(np.isfinite(signals).all(axis=1))
        if rows.size:
            features = (_features(signals[rows], self.circular) - self.mean) / self.deviation
            near = np.asarray(self.known.query(features)[0]) <= self.reach
            if near.any():
                out[rows[near]] = self.centre + self.size * self.network.predict(features[near])
        return out


def train_network(
    contact_map: ContactMap,
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    samples: int = 30_000,
    held_out: int = 5_000,
    seed: int = 0,
) -> NetworkSolver:
    """Train a network to predict contact points from three signals, and test it.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    triplet : str or tuple of str
        Names of the three signals.
    samples : int
        Number of training contacts, a tenth of which is used for early stopping. Training takes
        about ten seconds for 30,000.
    held_out : int
        Number of test contacts.
    seed : int
        Seed of the contacts and of the network's initial weights.

    Returns
    -------
    NetworkSolver
        Network with held-out contacts and errors.

    Raises
    ------
    ValueError
        If there are not three signals, fewer than 100 training contacts, or no test contact.
    """
    if samples < 100 or held_out < 1:
        raise ValueError(
            f"needs samples ≥ 100 and held_out ≥ 1; got {samples} and {held_out} contacts"
        )
    names = selection(triplet, exactly=3)
    which = [SIGNALS.index(name) for name in names]
    circular = np.array([CIRCULAR[w] for w in which])
    # Two independent draws from one seed.
    first, second = np.random.SeedSequence(seed).generate_state(2)
    trained = draw_contacts(contact_map, samples, int(first))
    tested = draw_contacts(contact_map, held_out, int(second))
    features = _features(trained.signals[:, which], circular)
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    # A signal that is zero everywhere remains zero.
    deviation = np.where(deviation > 1e-6 * np.abs(features).max(), deviation, 1.0)
    features = (features - mean) / deviation
    centre, size = trained.point.mean(axis=0), trained.point.std(axis=0)
    network = _fit_network(features, (trained.point - centre) / size, seed)
    known = cKDTree(features)
    test = (_features(tested.signals[:, which], circular) - mean) / deviation
    reach = _MARGIN * float(np.max(known.query(test)[0]))
    predict = _Prediction(circular, mean, deviation, centre, size, network, known, reach)
    errors = np.linalg.norm(predict(tested.signals[:, which]) - tested.point, axis=1)
    return NetworkSolver(names, tested, errors, predict)


def with_network_errors(
    contact_map: ContactMap,
    verdicts: xr.Dataset,
    *,
    samples: int = 30_000,
    held_out: int = 5_000,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Add to verdicts the errors of a network trained for each triplet, as in the paper.

    Parameters
    ----------
    contact_map : ContactMap
        Map to which the verdicts belong.
    verdicts : Dataset
        Verdicts from :func:`vibrissa.uniqueness`.
    samples : int
        Number of training contacts of each network; about ten seconds for 30,000.
    held_out : int
        Number of test contacts.
    progress : callable, optional
        Function called as ``progress(done, total)`` after each triplet.

    Returns
    -------
    Dataset
        Verdicts with ``network_error`` (triplet, region, quantile), m: median and 95 % quantile of
        the errors on held-out contacts of each region outside the cone. A large error is evidence
        that the triplet is not unique.
    """
    whisker, d = contact_map.whisker, contact_map.chart.discretization
    errors = []
    for triplet in verdicts["triplet"].to_numpy().tolist():
        solver = train_network(
            contact_map,
            triplet,
            samples=samples,
            held_out=held_out,
            seed=int(verdicts.attrs["seed"]),
        )
        drawn = solver.held_out
        inside = cone_angle(whisker, drawn.point) > verdicts.attrs["cone"]
        if verdicts.attrs["domain"] == "paper":
            inside &= within_paper_bounds(whisker, drawn.point)
        force = d.force * np.insert(drawn.contacts[:, 1:], 0, 0.0, axis=1)
        places = drawn.point, d.length * drawn.contacts[:, 0], force
        errors.append(
            [
                solver.error_quantiles(QUANTILES, inside & Prior(region).allows(whisker, *places))
                for region in verdicts["region"].to_numpy().tolist()
            ]
        )
        if progress is not None:
            progress(len(errors), verdicts.sizes["triplet"])
    about = {"units": "m", "long_name": "error of a network on contacts that it was not trained on"}
    return verdicts.assign_coords(quantile=list(QUANTILES)).assign(
        network_error=(("triplet", "region", "quantile"), errors, about)
    )


def _features(signals: Array, circular: AnyArray) -> Array:
    """Inputs of the network (n, k) from signals (n, 3)."""
    columns = []
    for column, turned in zip(signals.T, circular, strict=True):
        columns += [np.cos(column), np.sin(column)] if turned else [np.cbrt(column)]
    return np.stack(columns, axis=1)


def _fit_network(features: Array, targets: Array, seed: int) -> Any:
    """Fit a network to standardised features and targets."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.neural_network import MLPRegressor
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    network = MLPRegressor(
        hidden_layer_sizes=_LAYERS,
        batch_size=min(_BATCH, len(features) // 2),
        max_iter=_EPOCHS,
        early_stopping=True,
        n_iter_no_change=_PATIENCE,
        tol=1e-5,
        alpha=0.0,
        random_state=seed,
    )
    # On matrices this small several threads spend more time waiting than computing.
    with warnings.catch_warnings(), threadpool_limits(limits=1):
        # Reaching the last epoch is an acceptable end of training.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return network.fit(features, targets)

"""Contacts with a known object, in one or several points or along an arc, from the wrench.

Shape and orientation of the object are known, its position up to a shift d with a prior N(0, σ²).
Each d has one equilibrium (:mod:`vibrissa.rod.around`), hence one force and moment w(d) at the base
and one set of contacts. The shift that minimises

    χ²(d) = |W (w(d) - measured)|² + |d|² / σ²

is found by the Levenberg-Marquardt method, each equilibrium starting from the last one; derivatives
are finite differences at fixed nodes. Six components with three unknowns leave three degrees of
freedom to test whether the object explains the measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.sensing.channels import WRENCH
from vibrissa.contacts.sensing.noise import Noise, SensorNoise, explained
from vibrissa.contacts.wrench import wrench_on, wrench_weights
from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, numbers, rotation_matrices, without_blas_threads
from vibrissa.objects import Placement, Surface
from vibrissa.quantities import attributes
from vibrissa.rod import Equilibrium, NearObjects, discretize
from vibrissa.signals import Coordinates
from vibrissa.status import Status, flag_attributes
from vibrissa.whisker import Whisker

# Iterations, longest step (over L), and step of the finite differences.
_ROUNDS, _LONGEST, _STEP = 30, 0.05, 3e-4
_DONE = 1e-2  # step, in standard deviations, below which it is the last
# Elements in the last iterations, fine enough that nodes do not shift contacts beyond their error.
_FINE = 96
# Tolerance, over L, within which the whisker follows the object between nodes, where an arc may
# begin.
_BETWEEN = 5e-5


@without_blas_threads
def estimate_around(
    whisker: Whisker,
    force: ArrayLike | xr.DataArray,
    moment: ArrayLike | xr.DataArray,
    objects: Surface | Sequence[Surface],
    *,
    noise: Noise,
    position_sigma: float,
    base_rotation: ArrayLike | None = None,
    base_position: ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Locate the contacts with a known object, whether in one point, in several or along an arc.

    Without friction. One to three seconds a measurement.

    Parameters
    ----------
    whisker : Whisker
        Whisker, without weight.
    force, moment : array_like or DataArray
        Force and moment at the base, whisker frame, N and N·m, shape (..., 3); NaN: missing.
    objects : Peg, Sphere, Plane, Box, Mesh or a sequence of them
        Rigid objects in the laboratory, where they are thought to be.
    noise : mapping or (6, 6) array_like
        Standard deviations of ``Fx``, ``Fy``, ``Fz``, ``Mx``, ``My`` and ``Mz``, or the covariance
        of (F, M), SI units.
    position_sigma : float
        Standard deviation of the objects' position along each axis, m; all are shifted alike.
    base_rotation, base_position : array_like, optional
        Pose of the base, shapes (..., 3, 3) and (..., 3), m; by default the whisker's frame is the
        laboratory's.
    progress : callable, optional
        Function called before each measurement with the numbers of those done and of all.

    Returns
    -------
    Dataset
        ``object_shift``, laboratory frame, m, with its ``object_shift_covariance``;
        ``contact_point_whisker``, the contact nearest to the base, with its ``covariance``, and
        ``arc_length`` there; ``last_arc_length``, where the whisker is touched last; ``contacts``,
        how many nodes touch (more than two next to each other are an arc, whose ends are known to
        the distance of nodes, a hundredth of the length); ``chi_squared`` and ``status``:
        `Status.NOT_FRICTIONLESS` where it is above 16.3, by chance in 0.1 %.

    Raises
    ------
    ValueError
        If shapes do not match, ``position_sigma`` is not positive, or an object is not rigid.
    """
    if not 0.0 < position_sigma < np.inf:
        raise ValueError(f"position_sigma is positive, m; got {position_sigma!r}")
    f, m, dims, coords = wrench_on(whisker, force, moment)
    shape = f.shape[:-1]
    near = NearObjects(whisker, objects), NearObjects(whisker, objects, _FINE)
    turn = np.eye(3) if base_rotation is None else rotation_matrices("base_rotation", base_rotation)
    move = np.zeros(3) if base_position is None else numbers("base_position", base_position)
    try:
        turns = np.broadcast_to(turn, (*shape, 3, 3)).reshape(-1, 3, 3)
        moves = np.broadcast_to(move, (*shape, 3)).reshape(-1, 3)
    except ValueError as error:
        raise ValueError(
            f"force has shape {f.shape}, so base_rotation needs {(*shape, 3, 3)} and base_position "
            f"{(*shape, 3)}; got {turn.shape} and {move.shape}"
        ) from error
    wrench = np.concatenate([f, m], axis=-1).reshape(-1, 6)
    n, d = len(wrench), discretize(whisker)
    flat = wrench / np.repeat([d.force, d.moment], 3)
    sensor = SensorNoise.of(noise, WRENCH, whisker=whisker)
    out = {
        "object_shift": np.full((n, 3), np.nan),
        "object_shift_covariance": np.full((n, 3, 3), np.nan),
        "contact_point_whisker": np.full((n, 3), np.nan),
        "covariance": np.full((n, 3, 3), np.nan),
        "arc_length": np.full(n, np.nan),
        "last_arc_length": np.full(n, np.nan),
        "contacts": np.zeros(n, np.int64),
        "chi_squared": np.full(n, np.nan),
        "status": np.full(n, int(Status.MISSING)),
    }
    rows = np.flatnonzero(np.isfinite(wrench).all(axis=1))
    for done, i in enumerate(rows):
        if progress is not None:
            progress(done, rows.size)
        weights = wrench_weights(sensor, d, flat[i : i + 1])[0]
        place = Placement(turns[i], moves[i])
        fitted = _fitted(near, place, flat[i], weights, position_sigma / d.length)
        out["status"][i] = int(Status.NOT_CONVERGED)
        if fitted is None:
            continue
        found, shift, slopes, chi_squared = fitted
        covariance = np.asarray(np.linalg.inv(slopes.T @ slopes), dtype=np.float64)
        arc, point, apart = found.first_contact()
        spread = _spread(near[1], place, found, shift, covariance) + np.outer(apart, apart)
        out["object_shift"][i], out["object_shift_covariance"][i] = (
            shift * d.length,
            covariance * d.length**2,
        )
        out["contact_point_whisker"][i] = point * d.length
        out["covariance"][i] = spread * d.length**2
        s = found.contacts()[0]
        out["arc_length"][i], out["last_arc_length"][i] = arc * d.length, s[-1] * d.length
        out["contacts"][i], out["chi_squared"][i] = s.size, chi_squared
        out["status"][i] = int(
            Status.OK if chi_squared <= explained(3) else Status.NOT_FRICTIONLESS
        )
    return _labelled(out, shape, dims, coords)


_Fit = tuple[Equilibrium, Array, Array, float]


def _fitted(
    grids: tuple[NearObjects, NearObjects],
    place: Placement,
    measured: Array,
    weights: Array,
    sigma: float,
) -> _Fit | None:
    """Equilibrium and shift (3,) of minimum χ², derivatives (9, 3) of its residuals, and χ²."""
    coarse, fine = grids
    best: _Fit | None = None
    for begun in _starts(coarse, place, measured):
        fit = _descended(coarse, place, measured, weights, sigma, *begun)
        nodes = fit and fine.refined(place, fit[1], fit[0])
        fit = fit and nodes and _descended(fine, place, measured, weights, sigma, nodes, fit[1])
        if fit and (best is None or fit[3] < best[3]):
            best = fit
        if best and best[3] <= explained(3):
            break
    return best


def _starts(
    near: NearObjects, place: Placement, measured: Array
) -> Iterator[tuple[Equilibrium, Array]]:
    """Equilibria and shifts from which a fit may begin, the likeliest first."""
    if (found := near.under_wrench(place, measured)) is not None:
        yield found
    # The resting whisker may be on the other side of an object that it was swept past.
    shift = near.reaching(place)
    if (resting := near.from_outside(place, shift)) is not None:
        yield resting, shift


def _descended(
    near: NearObjects,
    place: Placement,
    measured: Array,
    weights: Array,
    sigma: float,
    found: Equilibrium,
    shift: Array,
) -> _Fit | None:
    """Fit starting from an equilibrium, with its nodes."""

    def residual(one: Equilibrium, at: Array) -> Array:
        return np.concatenate([weights @ (one.wrench() - measured), at / sigma])

    left, damping = residual(found, shift), 1e-3
    for _ in range(_ROUNDS):
        slopes = np.empty((9, 3))
        for k, step in enumerate(_STEP * np.eye(3)):
            if (moved := near.moved(place, shift + step, found)) is None:
                return None
            slopes[:, k] = (residual(moved, shift + step) - left) / _STEP
        normal = slopes.T @ slopes
        while damping < 1e6:
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slopes.T @ left)
            size = float(np.linalg.norm(step))
            step *= min(1.0, _LONGEST / max(size, 1e-300))
            if (moved := near.moved(place, shift + step, found)) is not None:
                after = residual(moved, shift + step)
                if after @ after <= left @ left:
                    break
            damping *= 10.0
        else:
            return found, shift, slopes, float(left @ left)
        found, shift, left, damping = moved, shift + step, after, max(0.1 * damping, 1e-6)
        if step @ normal @ step < _DONE**2:
            return found, shift, slopes, float(left @ left)
    return None


def _spread(
    near: NearObjects, place: Placement, found: Equilibrium, shift: Array, covariance: Array
) -> Array:
    """Second moment of the first contact about its estimate, from shifts of √3 deviations."""
    out, point = _BETWEEN**2 * np.eye(3), found.first_contact()[1]
    size, axes = np.linalg.eigh(covariance)
    for step in (np.sqrt(3.0 * size) * axes).T:
        for way in (step, -step):
            if (moved := near.moved(place, shift + way, found)) is None:
                return np.full((3, 3), np.nan)
            away = moved.first_contact()[1] - point
            out += np.outer(away, away) / 6.0
    return out


def _labelled(
    found: dict[str, AnyArray], shape: tuple[int, ...], dims: tuple[str, ...], coords: Coordinates
) -> xr.Dataset:
    """Results with names and units."""
    about = {
        "object_shift": {"units": "m", "long_name": "shift of the objects"},
        "object_shift_covariance": {"units": "m^2", "long_name": "covariance of the shift"},
        "contacts": {"units": "1", "long_name": "nodes that touch"},
        "status": attributes("status") | flag_attributes(),
    }
    data = {}
    for name, values in found.items():
        inner = ("space", "space_")[: values.ndim - 1]
        whole = values.reshape((*shape, *values.shape[1:]))
        data[name] = ((*dims, *inner), whole, about.get(name) or attributes(name))
    return xr.Dataset(data, {**coords, "space": list("xyz")})

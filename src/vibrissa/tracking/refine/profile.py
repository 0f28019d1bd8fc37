"""Covariances of a fit whose cost is not quadratic in where along the whisker the contact is.

A whisker that is bent behind an object, or by little, looks nearly the same for contacts along
millimetres of it: the cost is flat there, or has several minima, and its curvature at one of them
does not show how uncertain the contact is. While a contact lasts, its arc lengths are tied
together, so what is uncertain is one number: the arc length s at one frame of the contact, the one
at which it is best known. The profile

    c(s) = min over all other unknowns of the cost, at this arc length,

is computed at steps to both sides of its minimum; the posterior of s is exp(−c/2). With x_i(s) the
unknowns of frame i at that minimum, the covariance of the frame is

    C_i = C_i|s + ∫ (x_i(s) − x_i)(x_i(s) − x_i)ᵀ exp(−c/2) ds / ∫ exp(−c/2) ds,

where C_i|s, that for a known s, is taken from the linearised equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array
from vibrissa.tracking.refine.problem import Linear, Problem
from vibrissa.tracking.refine.rods import LIMITS, State

# First step of a profile to each side, in standard deviations of the linearised equations; share by
# which its rise there differs from a parabola's from which it is computed; its steps then.
_FIRST, _ALIKE = 2.0, 0.5
_STEPS = (1.0, 2.0, 3.0, 4.5, 7.0, 11.0, 17.0, 26.0)
_ENOUGH = 12.0  # rise of the cost up to which the profile is computed
_LOWER = 0.5  # decrease of the cost that shows another, lower minimum
_MARGIN = 3  # number of frames before and after a contact that are fitted with it
_ROUNDS = 3  # number of Gauss-Newton steps at each step of a profile
_FINE = 801  # number of values between which the profile is integrated


@dataclass(frozen=True, eq=False)
class _Contact:
    """A contact that lasts, by rows of the problem, and how it responds in linearised equations."""

    rows: NDArray[np.intp]
    best: int  # the row at which its arc length is best known
    response: Array  # (time, unknown), to a pull of that arc length

    @property
    def sigma(self) -> float:
        """Standard deviation of that arc length."""
        return float(np.sqrt(self.response[self.best, 6]))

    @property
    def slope(self) -> Array:
        """Change of all unknowns (time, unknown) with that arc length."""
        return np.asarray(self.response / self.response[self.best, 6])


class _Profile(NamedTuple):
    """Costs of a contact at several of its arc lengths, in ascending order, and its states."""

    arcs: Array
    costs: Array
    states: list[State]

    def spread(self, state: State) -> Array:
        """Second moments (time, unknown, unknown) about a state."""
        steps = np.array([state.step_to(other) for other in self.states])
        fine = np.linspace(self.arcs[0], self.arcs[-1], _FINE)
        rise = interpolate.PchipInterpolator(self.arcs, self.costs - self.costs.min())(fine)
        weight = np.exp(-0.5 * rise)
        share = np.array([np.interp(fine, self.arcs, one) for one in np.eye(len(self.arcs))])
        moments = (share * weight / weight.sum()) @ share.T
        return np.asarray(np.einsum("jl,jti,ltk->tik", moments, steps, steps))


def profiled(problem: Problem, state: State, fit: Linear) -> tuple[State, Linear, Array]:
    """Find the state of least cost, its equations, and covariances (time, unknown, unknown)."""
    for last in (False, True):
        covariance, lower = fit.smoother.covariances(), state
        for contact in _contacts(problem, fit, covariance):
            profile = _profile(problem, state, contact)
            if profile is None:
                continue
            rows, lowest = contact.rows, int(profile.costs.argmin())
            if profile.costs[lowest] < -_LOWER and not last:
                lower = lower.put(rows, profile.states[lowest])
            linear = contact.response[rows]
            known = linear[:, :, None] * linear[:, None] / contact.sigma**2
            covariance[rows] += profile.spread(state.rows(rows)) - known
        if lower is state:
            break
        state, fit = replace(problem, begun=lower).solved()
    uneven = problem.blurred(state, fit, covariance)
    return state, fit, covariance + uneven[:, :, None] * uneven[:, None]


def _contacts(problem: Problem, fit: Linear, covariance: Array) -> list[_Contact]:
    """Contacts that last: frames in contact that follow each other."""
    touching = np.flatnonzero(problem.touching)
    if not touching.size:
        return []
    breaks = np.flatnonzero(np.diff(problem.frames[touching]) != 1) + 1
    runs = np.split(touching, breaks)
    best = [int(rows[covariance[rows, 6, 6].argmin()]) for rows in runs]
    pulls = np.zeros((len(runs), *fit.smoother.gradient.shape))
    pulls[np.arange(len(runs)), best, 6] = 1.0
    responses = fit.smoother.responses(pulls)
    return [_Contact(*each) for each in zip(runs, best, responses, strict=True)]


def _profile(problem: Problem, state: State, contact: _Contact) -> _Profile | None:
    """Costs along a contact's arc length, relative to the state's; None if it is a parabola."""
    first, last = contact.rows[0] - _MARGIN, contact.rows[-1] + _MARGIN
    near = np.arange(max(first, 0), min(last + 1, len(problem.frames)))
    part = replace(problem.rows(near, state), options=replace(problem.options, rounds=_ROUNDS))
    row, inside = contact.best - near[0], contact.rows - near[0]
    middle = float(state.contact[contact.best, 0])

    def at(arc: float, before: State) -> tuple[float, State]:
        ahead = contact.slope[near] * (arc - before.contact[row, 0])
        held = replace(part, begun=before.moved(ahead), held=((row, arc),))
        found, fit = held.solved()
        return fit.cost, found

    lowest, begun = at(middle, state.rows(near))
    found = {middle: (lowest, begun)}
    sides = (-contact.sigma, contact.sigma)
    for side in sides:
        arc = float(np.clip(middle + _FIRST * side, *LIMITS))
        found[arc] = at(arc, begun)
    rises = np.array([cost - lowest for cost, _ in found.values()][1:])
    if len(found) == 3 and (np.abs(rises / _FIRST**2 - 1.0) < _ALIKE).all():
        return None
    for side in sides:
        before = begun
        for step in _STEPS:
            arc = float(np.clip(middle + step * side, *LIMITS))
            if arc not in found:
                found[arc] = at(arc, before)
            cost, before = found[arc]
            if cost - lowest > _ENOUGH or arc in LIMITS:
                break
    arcs = sorted(arc for arc, (cost, _) in found.items() if np.isfinite(cost))
    if len(arcs) < 2 or middle not in arcs:
        return None
    costs = np.array([found[arc][0] for arc in arcs]) - lowest
    return _Profile(np.array(arcs), costs, [found[arc][1].rows(inside) for arc in arcs])

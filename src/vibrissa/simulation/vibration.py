"""Vibrations: what a whisker's mass adds to the wrench at its base, and detection of contact.

About its rest shape a free whisker that is held at a moving base vibrates in modes S_k, which
:mod:`vibrissa.simulation.chain` has: with a the acceleration of its points if it did not bend,

    q̈ + η ω² q̇ + ω² q = -Σ m S·a,    F = -Σ m (a + Σ S_k q̈_k),    M = -Σ m x × (a + Σ S_k q̈_k),

in the frame of the base, with η = 2 ζ/ω₁ for a damping of the material. Two pairs of modes are
enough. What is left of the measured wrench of a free whisker is vibration after a release or an
impact, which decays in the same modes from an unknown start. So a frame is free if some window of a
little more than a period that contains it is explained by free vibration, up to the sensor's noise
and a share of the window's own size; frames that no such window contains are in contact. A load
that changes slowly is not imitated by vibrations about zero for so long.

The last milliseconds before a whisker slips off are, as its moment goes over smoothly into the
vibration after it. But the axial force does not: in contact it is of the size of M_B/L or more, in
vibration of second order, and passes through zero within a millisecond or two of the release.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh
from scipy.ndimage import maximum_filter1d
from scipy.signal import StateSpace, lsim
from scipy.stats import chi2

from vibrissa.numerics import AnyArray, Array
from vibrissa.simulation.chain import Chain, jacobian
from vibrissa.simulation.dynamics import Dynamics, at_rest
from vibrissa.whisker import Whisker

# Modes, a pair of them for each number of nodes.
_MODES = 4
# Length of a window, in periods of the first mode.
_PERIODS = 1.2
# Share of a window at its beginning that it does not call free.
_HIDDEN = 0.15
# Scales of all frequencies that are tried, as mass and stiffness are known to 10 or 20 %.
_SCALES = (0.9, 0.95, 1.0, 1.05, 1.1)
# Share of a window's own size that linear modes do not explain, and the chance that noise alone
# makes a window of a free whisker look like a contact.
SHARE, _CHANCE = 0.1, 1e-4
# Axial force, over the largest M_B/L within a quarter of a period, that no free whisker has; and
# its share, of its largest value, that is left when a contact ends.
_AXIAL, _ENDED = 1.5, 0.2
# Least axial force that counts, in standard deviations of M_B/L.
_COUNTS = 10.0


@dataclass(frozen=True, eq=False)
class Vibration:
    """Vibration of a free whisker that is held at its base; made by :meth:`of`.

    Attributes
    ----------
    rates : (k,) array
        Angular frequencies of the modes without damping, rad/s.
    damping : float
        Time constant η of the damping, s.
    mass : (m,) array
        Masses of points of the whisker, kg.
    places : (m, 3) array
        Places of these points at rest, whisker frame, m.
    shapes : (k, m, 3) array
        Displacements of the modes, of mass one, 1/√kg.
    """

    rates: Array
    damping: float
    mass: Array
    places: Array
    shapes: Array

    @classmethod
    def of(cls, whisker: Whisker, dynamics: Dynamics | None = None) -> Vibration:
        """Find the modes of a whisker.

        Parameters
        ----------
        whisker : Whisker
            Whisker at rest.
        dynamics : Dynamics, optional
            Density and damping, known to 20 %.

        Returns
        -------
        Vibration
            Vibration in the two lowest pairs of modes.
        """
        dynamics = dynamics or Dynamics()
        chain = Chain.of(whisker, dynamics.density, dynamics.segments)
        state, n = at_rest(chain), chain.stiffness.size
        slow, turns = eigh(
            state.matrix, np.diag(chain.stiffness.ravel()), subset_by_index=[n - _MODES, n - 1]
        )
        slow, turns = slow[::-1], turns[:, ::-1] / np.sqrt(slow[::-1])
        moved = [
            jacobian(place[None], link[None], np.ones(1), state.pivots, state.turns)
            for place, link in zip(state.masses, chain.mass_link, strict=True)
        ]
        shapes = np.einsum("man,nk->kma", np.array(moved), turns)
        rates = 1.0 / np.sqrt(slow)
        damping = 2.0 * dynamics.damping_ratio / float(rates[0])
        return cls(rates, damping, chain.mass, state.masses.copy(), shapes)

    @property
    def window(self) -> float:
        """Time over which free vibration is recognised, s."""
        return float(_PERIODS * 2.0 * np.pi / self.rates[0])

    def _wrench(self, accelerations: Array) -> Array:
        """Wrench (..., 6) at the base of points that are accelerated by (..., m, 3)."""
        pull = -self.mass[:, None] * accelerations
        moment = np.cross(self.places, pull).sum(axis=-2)
        return np.concatenate([pull.sum(axis=-2), moment], axis=-1)

    def in_air(self, time: Array, rotation: Array, position: Array) -> Array:
        """Wrench of a whisker that touches nothing while its base moves.

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        rotation : (n, 3, 3) array
            Rotation of the base, from the whisker's to the laboratory frame; smooth.
        position : (n, 3) array
            Position of the base, laboratory frame, m.

        Returns
        -------
        (n, 6) array
            Force, N, and moment, N·m, whisker frame.
        """
        places = np.einsum("tij,mj->tmi", rotation, self.places) + position[:, None]
        carried = CubicSpline(time, places)(time, 2)
        carried = np.einsum("tij,tmi->tmj", rotation, carried)
        loads = -np.einsum("m,kma,tma->tk", self.mass, self.shapes, carried)
        bent = np.zeros_like(loads)
        for k, (rate, load) in enumerate(zip(self.rates, loads.T, strict=True)):
            loss = self.damping * rate**2
            a, c = [[0.0, 1.0], [-(rate**2), -loss]], [[-(rate**2), -loss]]
            still = [load[0] / rate**2, 0.0]
            mode: Any = StateSpace(a, [[0.0], [1.0]], c, [[1.0]])
            bent[:, k] = lsim(mode, load, time - time[0], still)[1]
        return self._wrench(carried + np.einsum("tk,kma->tma", bent, self.shapes))

    def free(self, step: float, moments: Array, sigma: float) -> AnyArray:
        """Frames in which nothing is touched.

        Parameters
        ----------
        step : float
            Time between frames, s.
        moments : (n, 3) array
            Measured moment minus that in air, whisker frame, N·m.
        sigma : float
            Standard deviation of the noise of M_y and M_z, N·m.

        Returns
        -------
        (n,) array
            True where free vibration explains some window.
        """
        width = max(round(self.window / step), _MODES + 1)
        if len(moments) < width:
            return np.zeros(len(moments), np.bool_)
        windows = sliding_window_view(moments[:, 1:], width, axis=0).reshape(-1, 2 * width)
        size = (windows**2).sum(axis=1)
        left = np.full(len(windows), np.inf)
        for scale in _SCALES:
            basis = np.linalg.qr(self.free_moments(scale, step, width)).Q
            left = np.minimum(left, size - ((windows @ basis) ** 2).sum(axis=1))
        spread = sigma**2 + SHARE**2 * size / (2 * width)
        passed = left < spread * chi2.isf(_CHANCE, 2 * width - 2 * _MODES)
        out = np.zeros(len(moments), np.bool_)
        # The large vibration after a release would hide the last frames of the contact before it.
        out[:width] |= passed[0]
        for i in range(round(_HIDDEN * width), width):
            out[i : i + len(passed)] |= passed
        return out

    def free_moments(self, scale: float, step: float, width: int) -> Array:
        """Moments of free vibrations.

        Parameters
        ----------
        scale : float
            Factor of all frequencies.
        step : float
            Time between frames, s.
        width : int
            Number of frames.

        Returns
        -------
        (2 width, 2 k) array
            M_y of all frames, then M_z, of two vibrations of each mode.
        """
        gains = self._wrench(self.shapes)[:, 4:]
        time = step * np.arange(width)
        columns = []
        for rate, gain in zip(scale * self.rates, gains, strict=True):
            root = np.emath.sqrt((0.5 * self.damping * rate**2) ** 2 - rate**2 + 0.0j)
            wave = np.exp((-0.5 * self.damping * rate**2 + root) * time)
            columns += [np.concatenate([g * part for g in gain]) for part in (wave.real, wave.imag)]
        return np.asarray(np.column_stack(columns), dtype=np.float64)

    def in_contact(
        self, time: Array, wrench: Array, rotation: Array, position: Array, sigma: float
    ) -> AnyArray:
        """Frames in which something is touched.

        Parameters
        ----------
        time : (n,) array
            Times, s, equally spaced.
        wrench : (n, 6) array
            Measured force and moment, whisker frame, N and N·m.
        rotation, position : (n, 3, 3) and (n, 3) arrays
            Pose of the base in the laboratory, as for `in_air`.
        sigma : float
            Standard deviation of the noise of M_y and M_z, N·m.

        Returns
        -------
        (n,) array
            True where neither the motion of the base nor free vibration explains the moment.
        """
        left = wrench - self.in_air(time, rotation, position)
        step = float(np.diff(time).mean())
        return self._until_release(step, left, sigma, ~self.free(step, left[:, 3:], sigma))

    def _until_release(
        self, step: float, left: Array, sigma: float, touching: AnyArray
    ) -> AnyArray:
        """Frames in contact, to the end that the axial force shows where it is large."""
        length = float(np.linalg.norm(self.places, axis=1).max())
        axial, bending = left[:, 0], np.hypot(left[:, 4], left[:, 5]) / length
        quarter = max(round(0.5 * np.pi / self.rates[0] / step), 1)
        usual = maximum_filter1d(bending, 2 * quarter + 1)
        pulled = np.abs(axial) > np.maximum(_AXIAL * usual, _COUNTS * sigma / length)
        out = np.asarray(touching | pulled)
        for end in np.flatnonzero(out[:-1] & ~out[1:]) + 1:
            first = max(end - 2 * quarter, 0)
            if not (pulled & out)[max(end - quarter, 0) : end].any():
                continue
            last = axial[first:end] * out[first:end]
            least = _ENDED * last[np.argmax(np.abs(last))]
            row = end
            if axial[end - 1] / least > 1.0:
                while row < len(axial) and axial[row] / least > 1.0:
                    out[row] = True
                    row += 1
            else:
                while axial[row - 1] / least <= 1.0:
                    row -= 1
                    out[row] = False
        return out

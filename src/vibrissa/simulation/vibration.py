"""Vibrations: what a whisker's mass adds to the wrench at its base, and detection of contact.

About its rest shape a free whisker that is held at a moving base vibrates in modes S_k, which
:mod:`vibrissa.simulation.chain` has: with a the acceleration of its points if it did not bend,

    q̈ + η ω² q̇ + ω² q = -Σ m S·a,    F = -Σ m (a + Σ S_k q̈_k),    M = -Σ m x × (a + Σ S_k q̈_k),

in the frame of the base, with η = 2 ζ/ω₁ for a damping of the material. Two pairs of modes are
enough. What is left of the measured wrench of a free whisker is vibration after a release or an
impact, which decays in the same modes from an unknown start; which frames are of a free whisker,
:mod:`vibrissa.simulation.switching` finds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vibrissa.deferred import interpolate, signal
from vibrissa.numerics import AnyArray, Array
from vibrissa.simulation.chain import Chain, jacobian
from vibrissa.simulation.dynamics import Dynamics, at_rest, slowest
from vibrissa.simulation.switching import Modes, contact_probability
from vibrissa.whisker import Whisker

# Modes, a pair of them for each number of nodes.
_MODES = 4
# Length of a window, in periods of the first mode.
_PERIODS = 1.2


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
        state = at_rest(chain)
        slow, turns = slowest(state, _MODES)
        turns = turns / np.sqrt(slow)
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

    def base_wrench(self, accelerations: Array) -> Array:
        """Wrench at the base of points that are accelerated.

        Parameters
        ----------
        accelerations : (..., m, 3) array
            Accelerations of the points, whisker frame, m/s².

        Returns
        -------
        (..., 6) array
            Force, N, and moment, N·m.
        """
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
        carried = interpolate.CubicSpline(time, places)(time, 2)
        carried = np.einsum("tij,tmi->tmj", rotation, carried)
        loads = -np.einsum("m,kma,tma->tk", self.mass, self.shapes, carried)
        bent = np.zeros_like(loads)
        for k, (rate, load) in enumerate(zip(self.rates, loads.T, strict=True)):
            loss = self.damping * rate**2
            a, c = [[0.0, 1.0], [-(rate**2), -loss]], [[-(rate**2), -loss]]
            still = [load[0] / rate**2, 0.0]
            mode: Any = signal.StateSpace(a, [[0.0], [1.0]], c, [[1.0]])
            bent[:, k] = signal.lsim(mode, load, time - time[0], still)[1]
        return self.base_wrench(carried + np.einsum("tk,kma->tma", bent, self.shapes))

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
        gains = self.base_wrench(self.shapes)[:, 4:]
        time = step * np.arange(width)
        columns = []
        for rate, gain in zip(scale * self.rates, gains, strict=True):
            root = np.emath.sqrt((0.5 * self.damping * rate**2) ** 2 - rate**2 + 0.0j)
            wave = np.exp((-0.5 * self.damping * rate**2 + root) * time)
            columns += [np.concatenate([g * part for g in gain]) for part in (wave.real, wave.imag)]
        return np.asarray(np.column_stack(columns), dtype=np.float64)

    def in_contact(
        self, time: Array, wrench: Array, rotation: Array, position: Array, noise: Array
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
        noise : (6, 6) array
            Covariance of the noise of force and moment, SI units.

        Returns
        -------
        (n,) array
            True where contact is more probable than free vibration and the motion of the base, by
            all frames (:mod:`vibrissa.simulation.switching`).
        """
        air = self.in_air(time, rotation, position)
        step = float(np.diff(time).mean())
        reach = np.linalg.norm(self.places, axis=1).max()
        modes = Modes(
            self.rates,
            self.damping * self.rates,
            self.base_wrench(self.shapes),
            self.shapes[:, -1] / reach,
        )
        return contact_probability(modes, step, wrench - air, air, noise) > 0.5

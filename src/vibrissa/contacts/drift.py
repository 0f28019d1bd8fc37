"""How contact points move in the laboratory, as a filter takes it beforehand.

A velocity that forgets itself (Ornstein and Uhlenbeck):

    dp = v dt,    dv = -v dt / τ + σ √(2 / τ) dW.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.numerics import Array


class Drift:
    """The law of motion of (p, v)."""

    def __init__(self, speed: float, persistence: float) -> None:
        self.speed, self._tau = speed, persistence

    def over(self, step: float) -> tuple[float, float, Array]:
        """What happens in some time."""
        tau, speed = self._tau, self.speed
        x = step / tau
        a = math.exp(-x)
        # 2x - 3 + 4a - a² loses its digits where x is small.
        walked = 2.0 * x - 3.0 + 4.0 * a - a * a if x > 0.01 else x**3 * (2.0 / 3.0 - 0.5 * x)
        grown = np.array(
            [
                (speed * tau) ** 2 * walked,
                speed**2 * tau * (1.0 - a) ** 2,
                speed**2 * (1.0 - a * a),
            ]
        )
        return tau * (1.0 - a), a, grown

"""The contact that a stream has followed so far: which candidate of the next sample goes on."""

from __future__ import annotations

import numpy as np

from vibrissa.rod.arrays import Array

# A contact moves no farther than this (over L) from one measurement to the next.
_NEAR = 0.02


class Trail:
    """The last contact and how many candidates there were.

    Attributes
    ----------
    last : tuple of (3,) and (6,) arrays, or None
        ξ and (F, p) of the contact followed, non-dimensional; None where there is none.
    number : int
        Of candidates of the last measurement.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew, as when the whisker has lost touch."""
        self.last: tuple[Array, Array] | None = None
        self.number = 0

    def near(self, values: Array) -> bool:
        """Whether one of (F, p) (n, 6) is near the contact followed so far."""
        if self.last is None:
            return False
        away = np.abs(values[:, 3:] - self.last[1][3:]).max(axis=1)
        return bool((away < _NEAR).any())

    def go_on(self, xi: Array, values: Array) -> int:
        """Choose which of the candidates goes on from the contact before, and remember it.

        Parameters
        ----------
        xi, values : (n, 3), (n, 6) arrays
            The candidates' ξ and (F, p).

        Returns
        -------
        int
            Its row; 0 where there was none before.
        """
        continuing, self.number = 0, len(xi)
        if self.last is not None and len(xi) > 1:
            away = values[:, 3:] - self.last[1][3:]
            continuing = int((away * away).sum(axis=1).argmin())
        self.last = xi[continuing], values[continuing]
        return continuing

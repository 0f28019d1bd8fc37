"""How estimates show themselves in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from vibrissa.numerics import Array, IntArray
from vibrissa.sketch import CONTACT, REST, Mark, card, shown, views
from vibrissa.status import counted, describe


class _Found(Protocol):
    """What estimates from some signals and from force and moment whole have in common."""

    @property
    def point(self) -> Array:
        """Contact points (..., 3), m."""

    @property
    def spherical(self) -> Array:
        """The same as (r, θ, φ)."""

    @property
    def covariance(self) -> Array:
        """Their covariances (..., 3, 3), m²."""

    @property
    def candidates(self) -> Array:
        """All candidates (..., k, 3), m."""

    @property
    def n_candidates(self) -> IntArray:
        """How many."""

    @property
    def status(self) -> IntArray:
        """A status each."""


def estimate_card(title: str, found: _Found, rows: Sequence[tuple[str, str]] = ()) -> str:
    """Lay out contact points about the base, with the numbers."""
    marks = [
        Mark(np.zeros((1, 3)), REST, dots=True, width=7.0, label="base"),
        Mark(found.candidates, REST, dots=True, width=3.0),
        Mark(found.point, CONTACT, dots=True, width=4.0, label="contact (candidates: grey)"),
    ]
    return card(title, estimate_rows(found, rows), views(marks))


def estimate_rows(found: _Found, rows: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """Tell contact points in numbers."""
    r, theta, phi = np.moveaxis(found.spherical, -1, 0)
    sigma = np.sqrt(np.einsum("...ii->...i", found.covariance).max(axis=-1))
    one = np.size(found.status) == 1
    return [
        ("status", next(iter(describe(found.status))) if one else counted(found.status)),
        ("r", shown("r", r)),
        ("θ", shown("theta", theta)),
        ("φ", shown("phi", phi)),
        ("largest standard deviation of x, y, z", shown("r", sigma)),
        ("candidates", shown("candidates", found.n_candidates)),
        *rows,
    ]

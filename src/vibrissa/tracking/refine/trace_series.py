"""The traces of one whisker over a trial as arrays, and the distances of curves from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import Array
from vibrissa.tracking.trace.trace import Trace, interpolated

NODES = 101
"""Number of points of a stored trace."""

_FLOOR = 0.05
"""Smallest standard deviation of a trace, pixels."""

_END = 1.0
"""Standard deviation of a trace's ends along it, pixels."""

FAR = 6.0
"""Distance, in pixels, from which the end of a trace is not the tip, and in standard deviations,
from which an error shows that something else is wrong and is weighted down."""


@dataclass(frozen=True, eq=False)
class TraceSeries:
    """Traces of one whisker, NaN where it is lost."""

    line: Array  # (time, view, NODES, 2): column and row, equally spaced from base to tip
    sigma: Array  # (time, view, NODES): standard deviation across, pixels
    seen: Array  # (time, view, NODES): 1 where the whisker is seen, 0 where it is bridged
    confidence: Array  # (time, view), between 0 and 1
    ends: Array  # (time, view, 2): 1 where the whisker is seen to begin and to end there, else 0
    glint: Array  # (time, view): difference between its flanks, as a share of its darkness

    @classmethod
    def of(cls, traces: Sequence[Sequence[Trace]]) -> TraceSeries:
        """Resample traces."""
        shape = (len(traces[0]), len(traces), NODES)
        line, sigma, seen = np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape)
        confidence, ends = np.zeros(shape[:2]), np.zeros((*shape[:2], 2))
        glint = np.zeros(shape[:2])
        for view, row in enumerate(traces):
            for i, trace in enumerate(row):
                n = len(trace.line)
                if n < 2:
                    continue
                columns = np.column_stack([trace.line, trace.sigma, trace.seen])
                even = interpolated(np.linspace(0.0, n - 1.0, NODES), np.arange(n), columns)
                line[i, view], sigma[i, view], seen[i, view] = (
                    even[:, :2],
                    even[:, 2],
                    even[:, 3] > 0.5,
                )
                confidence[i, view], glint[i, view] = trace.confidence, trace.glint
                ends[i, view] = trace.base_seen, trace.tip_seen
        return cls(line, sigma, seen, confidence, ends, glint)

    def rows(self, frames: NDArray[np.intp]) -> TraceSeries:
        """Select frames."""
        return TraceSeries(*(getattr(self, name)[frames] for name in vars(self)))

    def equations(self, view: int, pixels: Array, slopes: Array) -> tuple[Array, Array, Array]:
        """Distances of points from the traces of a view, and their derivatives."""
        line, sigma = self.line[:, view], self.sigma[:, view]
        tangent = np.gradient(line, axis=1)
        tangent /= np.linalg.norm(tangent, axis=2, keepdims=True)
        # Of a lost trace all numbers are NaN, and the first is as good as any.
        square = (line**2).sum(2)[:, None, :] - 2.0 * pixels @ np.swapaxes(line, 1, 2)
        near = np.argmin(square, axis=2)
        row = np.arange(len(line))[:, None]
        t, away = tangent[row, near], line[row, near] - pixels
        spacing = np.linalg.norm(line[:, 1] - line[:, 0], axis=1)
        along = (away * t).sum(axis=2)
        # Between two points of the trace its direction changes a little.
        other = np.clip(near - np.sign(along).astype(int), 0, NODES - 1)
        share = np.clip(np.abs(along) / spacing[:, None], 0.0, 1.0)[..., None]
        t = (1.0 - share) * t + share * tangent[row, other]
        t /= np.linalg.norm(t, axis=2, keepdims=True)
        chord = (1.0 - share) * line[row, near] + share * line[row, other] - pixels
        across = np.stack([-t[..., 1], t[..., 0]], axis=-1)
        miss = (chord * across).sum(axis=2)
        deviation = np.sqrt(sigma[row, near] ** 2 + _FLOOR**2)
        beyond = (np.abs(along) > 1.5 * spacing[:, None] + 1.0) | ~np.isfinite(miss)
        weight = np.where(beyond, 0.0, 1.0 / deviation)
        # An error far beyond what is usual shows that something else is wrong.
        scaled = np.abs(miss) * weight
        weight = weight / np.sqrt(np.maximum(scaled / FAR, 1.0))
        rows = (across[..., None, :] @ slopes)[..., 0, :] * weight[..., None]
        misses = miss * weight
        ends, gaps, shown = [], [], []
        for end in (0, -1):
            gap = ((line[:, end] - pixels[:, end]) * tangent[:, end]).sum(axis=1)
            counts = np.isfinite(gap) & (self.ends[:, view, end] > 0.5)
            counts &= (end == 0) | (np.abs(gap) < FAR)
            pull = np.einsum("ti,tij->tj", tangent[:, end], slopes[:, end]) / _END
            ends.append(np.where(counts[:, None], pull, 0.0))
            gaps.append(np.where(counts, gap / _END, 0.0))
            shown.append(np.where(counts, 1.0 / _END, 0.0))
        rows = np.concatenate([rows, np.stack(ends, axis=1)], axis=1)
        misses = np.concatenate([misses, np.stack(gaps, axis=1)], axis=1)
        weight = np.concatenate([weight, np.stack(shown, axis=1)], axis=1)
        return np.nan_to_num(rows), np.nan_to_num(misses), np.nan_to_num(weight)

"""Questions about the units of what a filter is given: times, positions and speeds.

Times in ms or positions in mm are numbers like any others. The contacts of single samples do not
depend on them, so that a filter that is given them is wrong without any status that shows it.
Intervals, speeds and uncertainties that are a thousand times too large are questioned by a warning.
"""

from __future__ import annotations

import warnings

import numpy as np

from vibrissa.numerics import Array

# Speed of a base, m/s; speed of a contact point, lengths of the whisker per second; error of the
# base's position, over L; and correlation time of a velocity, s: larger ones are implausible.
_FAST, _FAST_CONTACT, _LOOSE, _LASTING = 20.0, 50.0, 0.2, 10.0
# Interval of samples from which ms are suspected, s, and number of samples before a question.
_SLOW, _SEVERAL = 0.9, 5


def question_parameters(
    length: float, speed: float | None, persistence: float, pose_sigma: float
) -> None:
    """Warn of parameters that are implausible for a whisker of this length, m."""
    faults = []
    if speed is not None and speed > _FAST_CONTACT * length:
        faults.append(
            f"speed is {speed:g} m/s, {speed / length:.3g} lengths of the whisker per second: is "
            "it in mm/s?"
        )
    if _LASTING < persistence < np.inf:
        faults.append(f"persistence is {persistence:g} s: is it in ms?")
    if pose_sigma > _LOOSE * length:
        faults.append(
            f"pose_sigma is {pose_sigma:g} m, {pose_sigma / length:.2g} of the whisker's length: "
            "is it in mm?"
        )
    if faults:
        warnings.warn(" ".join(faults), stacklevel=3)


class Course:
    """Times and positions of the base so far; each kind of fault is questioned once."""

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._samples = self._slow = self._fast = 0

    def question(self, time: float, position: Array) -> None:
        """Take the next sample, and warn of intervals and speeds that suggest other units."""
        # Times may begin anew after a reset of the filter.
        if self._last is not None and time > self._last[0]:
            step = time - self._last[0]
            moved = float(np.linalg.norm(position - self._last[1]))
            self._samples += 1
            self._slow += step >= _SLOW
            self._fast += moved > _FAST * step
            if self._samples == self._slow == _SEVERAL:
                warnings.warn(
                    f"the first {_SEVERAL + 1} samples are about a second or more apart: are "
                    "their times in ms?",
                    stacklevel=4,
                )
            if self._fast == _SEVERAL and moved > _FAST * step:
                warnings.warn(
                    f"the base moves at {moved / step:.3g} m/s: is its position in mm?",
                    stacklevel=4,
                )
        self._last = time, position

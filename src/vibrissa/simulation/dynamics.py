"""A trial with inertia and damping: collisions, ringing, whisking that bends the whisker.

The chain of :mod:`vibrissa.simulation.chain` obeys d'Alembert's principle: for every δθ

    Σ m δx·ẍ + δθ·(K (θ - θ₀) + η K θ̇) = Σ δp·F,

x the points of mass, p the contacts, η = 2 ζ/ω₁ a damping of the material by which the first
vibration has the damping ratio ζ (higher ones have more, in proportion to their frequency). The
base is carried along its path, which is a spline through the frames. At first the whisker moves
along without bending (or rests against what is in its way, held still). Velocities and
accelerations are backward differences of second order (BDF2) of places in the laboratory; the step
is implicit, solved by Newton's method, and stable whatever the stiffness; vibrations too fast for
it die away.

Objects are touched where the distance of the smooth centreline has a minimum that is less than the
whisker's radius, with a force along the normal in proportion to how far it
is in: the object's stiffness, or one that gives way by micrometres. Sliding is held up by µ times
that force, against the velocity of the whisker's material.

What the base feels is what the objects push less what the masses take up to be accelerated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vibrissa.numerics import Array, IntArray
from vibrissa.objects.surface import Surface
from vibrissa.simulation.chain import Chain
from vibrissa.simulation.motion import Motion
from vibrissa.simulation.stepping import Moment, Walk, frequencies
from vibrissa.whisker import Whisker

Progress = Callable[[int, int], None]

DENSITY = (1220.0, 1632.0)
"""Of a rat's whisker at base and tip, kg/m³ (Yang et al. 2019)."""

DAMPING_RATIO = 0.14
"""Of the first vibration: in the middle of 0.11 to 0.17 (Hartmann et al. 2003)."""

# How long a whisker that would rest inside an object is held still at first, to settle, s.
_SETTLE = 0.06
_AT_ONCE = 4096


@dataclass(frozen=True)
class Dynamics:
    """How a whisker moves when it is not slow.

    Parameters
    ----------
    density : tuple of float
        At base and tip, kg/m³.
    damping_ratio : float
        Of the first vibration.
    segments : int
        Of the whisker.
    step : float
        Longest step in time, s.
    contact_stiffness : float
        Of objects that are rigid, N/m: high enough to give way by micrometres only.

    Raises
    ------
    ValueError
        If a number is not positive, or the damping negative.
    """

    density: tuple[float, float] = DENSITY
    damping_ratio: float = DAMPING_RATIO
    segments: int = 32
    step: float = 1e-4
    contact_stiffness: float = 200.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        numbers = {
            "density": min(self.density),
            "segments": self.segments - 3,
            "step": self.step,
            "contact_stiffness": self.contact_stiffness,
        }
        faults = [
            f"{name} is {getattr(self, name)!r}; it must be positive"
            + (", more than three" if name == "segments" else "")
            for name, value in numbers.items()
            if not (np.isfinite(value) and value > 0.0)
        ]
        if not (np.isfinite(self.damping_ratio) and self.damping_ratio >= 0.0):
            faults.append(f"damping_ratio is {self.damping_ratio!r}; it must not be negative")
        if faults:
            raise ValueError("no dynamics: " + "; ".join(faults))


def resonances(whisker: Whisker, dynamics: Dynamics | None = None, count: int = 3) -> Array:
    """Frequencies at which a free whisker vibrates, held at its base.

    Parameters
    ----------
    whisker : Whisker
        At rest.
    dynamics : Dynamics, optional
        Its density, and into how many segments it is cut.
    count : int
        How many, from the lowest.

    Returns
    -------
    array (count,)
        Hz, without damping.

    Examples
    --------
    >>> import vibrissa as vb
    >>> bool(27.0 < resonances(vb.samples.gamma())[0] < 260.0)
    True
    """
    dynamics = dynamics or Dynamics()
    return frequencies(Chain.of(whisker, dynamics.density, dynamics.segments), count)


def move_dynamically(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    motion: Motion,
    dynamics: Dynamics,
    *,
    friction: float = 0.0,
    progress: Progress | None = None,
) -> list[Moment]:
    """Move a whisker among objects."""
    if not (np.isfinite(friction) and friction >= 0.0):
        raise ValueError(f"friction is {friction!r}; a coefficient from 0 on is needed")
    chain = Chain.of(whisker, dynamics.density, dynamics.segments)
    frame = float(np.diff(motion.time).min())
    parts = int(np.ceil(frame / dynamics.step * (1.0 - 1e-9)))
    walk = Walk(
        whisker,
        chain,
        surfaces,
        dynamics.damping_ratio,
        dynamics.contact_stiffness,
        friction,
        frame / parts,
    )
    path = _Path(motion, frame / parts)
    if not walk.begin(*path.at(np.arange(4))):
        still = path.at(np.zeros(1, dtype=int))
        for _ in range(int(np.ceil(_SETTLE / path.step))):
            walk.step(still[0][0], still[1][0])
    moments: list[Moment] = []
    for first in range(0, path.count, _AT_ONCE):
        numbers = np.arange(first, min(first + _AT_ONCE, path.count))
        for number, rotation, place in zip(numbers.tolist(), *path.at(numbers), strict=True):
            moment = walk.step(rotation, place)
            if number in path.frames:
                moments.append(moment)
                if progress is not None:
                    progress(len(moments), len(motion))
    return moments


class _Path:
    """The base's placements, step by step."""

    def __init__(self, motion: Motion, step: float) -> None:
        time = motion.time - motion.time[0]
        self._turn = RotationSpline(time, Rotation.from_matrix(motion.base_rotation))
        self._shift = CubicSpline(time, motion.base_position, axis=0)
        self._last = float(time[-1])
        self.step, self.count = step, round(time[-1] / step) + 1
        self.frames = set(np.round(time / step).astype(int).tolist())

    def at(self, numbers: IntArray) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and places (n, 3) of the base at steps."""
        time = np.minimum(numbers * self.step, self._last)
        return self._turn(time).as_matrix(), self._shift(time)

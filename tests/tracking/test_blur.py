"""Uncertainty of traces due to motion blur, and what is called contact then."""

import numpy as np
import pytest

from vibrissa.tracking.space.rest_shape import Astray, rest_shape
from vibrissa.tracking.trace.blur import with_blur
from vibrissa.tracking.trace.ends import traced
from vibrissa.tracking.trace.ridge import noise_level
from vibrissa.tracking.trace.trace import TraceOptions

SIZE, BEGINS, LENGTH, TURN = (200, 240), np.array([30.0, 100.0]), 170.0, 0.5
ANGLES = TURN * np.sin(2.0 * np.pi * np.arange(60) / 60.0)  # at the ends of a swing it is slow


def photo(before, after, generator, share):
    """A tapered line from a point, which turns during a share of a frame."""
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    dark = np.zeros(SIZE)
    moments = before + share * (after - before) * np.linspace(-0.5, 0.5, 9)
    for angle in moments:
        x, y = column - BEGINS[0], row - BEGINS[1]
        along = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        width = 1.3 - 0.4 * along / LENGTH
        on = (along > 0.0) & (along < LENGTH)
        dark += on * np.exp(-0.5 * (across / width) ** 2) / len(moments)
    grey = 180.0 - 120.0 * dark + generator.normal(0.0, 1.0, SIZE)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def filmed(share):
    """Traces of the moving line, one a frame."""
    generator, row = np.random.default_rng(1), []
    ahead = np.gradient(ANGLES)
    for angle, step in zip(ANGLES, ahead, strict=True):
        frame = photo(angle, angle + step, generator, share)
        guess = BEGINS + np.outer(np.arange(2.0, LENGTH, 2.0), [np.cos(angle), np.sin(angle)])
        row.append(traced(frame, noise_level(frame), guess, TraceOptions(bright=False))[0])
    return row


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_blurred_whisker_is_uncertain(share):
    """From the images alone: sharp ones of a fast whisker are as certain as before."""
    row = filmed(share)
    (blurred,), errors = with_blur([row])
    speed = np.abs(np.gradient(ANGLES)) * 0.6 * LENGTH
    if share == 0.0:
        assert not errors.any()
        return
    assert (errors[share * speed > 4.5] > 0.05).all() or share * speed.max() < 4.5
    assert not errors[share * speed < 1.0].any()
    for before, after, error in zip(row, blurred, errors, strict=True):
        assert (after.sigma >= before.sigma).all()
        assert (after.sigma > before.sigma).any() == (error > 0.0)
        np.testing.assert_array_equal(before.line, after.line)


def test_frames_whose_traces_err_are_no_contact():
    """The same deviations are contact where the whisker is sharp, and free where it is blurred."""
    generator = np.random.default_rng(2)
    s = np.linspace(0.0, 20e-3, 60)
    line = np.stack([s, 12.0 * s**2, 0.0 * s], axis=1)
    curves = np.repeat(line[None], 40, axis=0) + generator.normal(0.0, 1e-6, (40, 60, 3))
    bent = np.zeros(40, dtype=bool)
    bent[[8, 9, 10, 25, 26, 27]] = True
    curves[bent, :, 1] += 40.0 * s**3
    blur = np.zeros(40)
    blur[25:28] = 100e-6
    sharp = rest_shape(curves)
    np.testing.assert_array_equal(sharp.free, ~bent)
    found = rest_shape(curves, astray=Astray(motion=blur))
    np.testing.assert_array_equal(np.flatnonzero(~found.free), [8, 9, 10])

"""Bent whiskers: what is drawn, at one scale, and what is refused."""

import numpy as np
import pytest
from matplotlib.text import Annotation

from vibrissa.plots import bent_views

X = np.linspace(0.0, 40e-3, 41)
REST = np.stack([X, 0.0 * X, 0.0 * X], axis=1)
BENT = REST + np.stack([0.0 * X, 0.2 * X, -0.1 * X], axis=1) * np.arange(1, 4)[:, None, None] / 3
POINTS = BENT[:, 30]
FORCES = np.array([[0.0, 1e-5, 0.0], [0.0, 2e-5, 0.0], [0.0, 4e-5, 0.0]])


def arrows(axes):
    return [text for text in axes.texts if isinstance(text, Annotation) and text.arrow_patch]


@pytest.mark.parametrize("width", ["single", "double"])
def test_both_views_have_one_scale_and_hold_everything(width):
    figure = bent_views(REST, BENT, POINTS, FORCES, width=width)
    figure.draw_without_rendering()
    scales = []
    for axes, j in zip(figure.axes, (1, 2), strict=True):
        limits = np.array([axes.get_xlim(), axes.get_ylim()])
        scales += list(axes.bbox.size / np.ptp(limits, axis=1))
        shown = 1e3 * BENT[..., [0, j]].reshape(-1, 2)
        assert (shown > limits[:, 0]).all()
        assert (shown < limits[:, 1]).all()
    assert np.ptp(scales) < 1e-9 * scales[0]


def test_arrows_end_in_the_contacts_and_are_as_long_as_the_forces():
    above = bent_views(REST, BENT, POINTS, FORCES).axes[0]
    found = arrows(above)
    np.testing.assert_allclose([arrow.xy for arrow in found], 1e3 * POINTS[:, :2])
    lengths = [arrow.xy[1] - arrow.get_position()[1] for arrow in found]
    np.testing.assert_allclose(lengths, np.array([0.25, 0.5, 1.0]) * 0.2 * 40.0)


def test_labels_are_shown_and_what_has_no_equilibrium_is_left_out():
    lines = BENT.copy()
    lines[1] = np.nan
    figure = bent_views(REST, lines, POINTS, labels=["one", "two", "three"])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "three"]
    assert not arrows(figure.axes[0])
    colours = [line.get_color() for line in figure.axes[0].lines if line.get_label() == "three"]
    assert colours == ["#009e73"]  # its own, whatever is left out
    nothing = bent_views(REST, np.full_like(BENT, np.nan))
    assert [text.get_text() for text in nothing.texts] == ["nothing bent"]


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"\(m, k, 3\)"):
        bent_views(REST, BENT[0])
    with pytest.raises(ValueError, match="forces without contact points"):
        bent_views(REST, BENT, forces=FORCES)
    with pytest.raises(ValueError, match="2 labels for 3"):
        bent_views(REST, BENT, labels=["one", "two"])

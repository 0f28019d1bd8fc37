"""The picture of what tracking takes for the whisker."""

import numpy as np
import pytest

from vibrissa.plots import start_views


@pytest.mark.parametrize("remarks", [(), ("it does not move", "others are nearly as likely")])
def test_every_view_shows_its_line_and_base(remarks):
    images = [np.full((60, 80), 180, np.uint8), np.full((60, 80), 90, np.uint8)]
    line = np.stack([np.linspace(5.0, 70.0, 30), np.full(30, 20.0)], axis=1)
    other = ([line + 3.0, np.empty((0, 2))], 0.21)
    whisker = ([line, np.empty((0, 2))], 0.75)
    figure = start_views(images, [whisker, other], ["top", "front"], remarks)
    first, second = figure.axes
    np.testing.assert_allclose(first.lines[0].get_xydata(), line)
    np.testing.assert_allclose(first.lines[1].get_xydata(), line + 3.0)
    assert [text.get_text() for text in first.texts] == ["1", "2 (0.21)"]
    np.testing.assert_allclose(first.collections[0].get_offsets(), line[:1])
    assert "0.75" in first.get_title(loc="left")
    assert "no whisker" in second.get_title(loc="left")
    assert [text.get_text() for text in figure.texts] == list(remarks)
    assert first.get_ylim() == (59.5, -0.5)  # rows go down, as in the image

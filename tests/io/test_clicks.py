"""Files of what was clicked in the images of a recording."""

import numpy as np
import pytest

from vibrissa.io import Clicks, ViewClicks, load_clicks, save_clicks

SQUARE = ((1.5, 1.5), (5.5, 1.5), (5.5, 4.5), (1.5, 4.5))


def test_what_is_saved_is_read(tmp_path):
    one = ViewClicks(((61.5, 304.25), (70.0, 310.0)), (SQUARE,), (SQUARE, SQUARE[:3]))
    clicks = Clicks((one, ViewClicks()), ('to"p.mp4', "frönt.mp4"), 58e-6)
    save_clicks(tmp_path / "t.clicks.toml", clicks)
    read = load_clicks(tmp_path / "t.clicks.toml")
    assert (read.views, read.videos) == (clicks.views, clicks.videos)
    assert read.pixel_size == pytest.approx(58e-6)


def test_masks_and_regions_are_pixels():
    masked = ViewClicks(mask=(SQUARE,)).masked((8, 6))
    assert masked.sum() == 4 * 3
    assert masked[2:5, 2:6].all()
    np.testing.assert_array_equal(ViewClicks(region=(SQUARE,)).masked((8, 6)), ~masked)
    assert ViewClicks(((1.0, 1.0),)).masked((8, 6)) is None


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("videos = []", "no \\[\\[view\\]\\]"),
        ("[[view]]\nbase = [1.0, 2.0]", "base of view 0"),
        ("[[view]]\nmask = [[[1, 2], [3, 4]]]", "at least three corners"),
        ("pixel_size = -1\n[[view]]", "pixel_size is -1"),
        ("[[view]]\npeg = 1", "peg"),
    ],
)
def test_other_files_are_refused(tmp_path, text, fault):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ValueError, match=fault):
        load_clicks(tmp_path / "c.toml")

"""Videos: what is written comes back; what is none says so."""

import numpy as np
import pytest
from scipy import ndimage

from vibrissa.io import interlaced, read_video, video_info, write_video
from vibrissa.io.video import grey_frame


def frames(count=5, shape=(48, 64)):
    generator = np.random.default_rng(0)
    smooth = np.linspace(0.0, 255.0, shape[1])[None, :] * np.ones((shape[0], 1))
    return [
        np.clip(smooth + generator.normal(0.0, 2.0, shape), 0, 255).astype(np.uint8)
        for _ in range(count)
    ]


def test_matroska_keeps_every_grey_value(tmp_path):
    sent = frames()
    assert write_video(tmp_path / "a.mkv", sent) == 5
    np.testing.assert_array_equal(list(read_video(tmp_path / "a.mkv")), sent)


def test_mp4_keeps_the_range_of_greys(tmp_path):
    sent = np.array(frames())
    write_video(tmp_path / "a.mp4", sent)
    got = np.array(list(read_video(tmp_path / "a.mp4"))).astype(float)
    assert got.shape == sent.shape
    assert np.abs(got - sent).mean() < 3.0
    np.testing.assert_allclose(got.mean(axis=(0, 1)), sent.mean(axis=(0, 1)), atol=2.0)


def test_luminances_fill_the_range_of_grey_values():
    """Video's black is 16 and its white 235, unless a frame states the full range."""
    av = pytest.importorskip("av")
    ramp = np.tile(np.arange(256, dtype=np.uint8), (4, 1))
    frame = av.VideoFrame.from_ndarray(np.concatenate([ramp, ramp[:2]]), format="yuv420p")
    grey = np.clip(np.round((ramp - 16.0) * 255.0 / 219.0), 0.0, 255.0)
    np.testing.assert_array_equal(grey_frame(frame), grey)
    frame.color_range = 2
    np.testing.assert_array_equal(grey_frame(frame), ramp)


def test_a_video_says_what_it_holds(tmp_path):
    write_video(tmp_path / "a.mkv", frames(), rate=25.0)
    info = video_info(tmp_path / "a.mkv")
    assert (info.width, info.height, info.frames, info.rate) == (64, 48, 5, 25.0)
    assert info.codec == "ffv1"


def test_what_is_no_video_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        video_info(tmp_path / "none.mp4")
    for content in (b"", b"no video at all" * 100):
        (tmp_path / "a.mp4").write_bytes(content)
        with pytest.raises(ValueError, match="not a video that can be read"):
            list(read_video(tmp_path / "a.mp4"))


def test_nothing_is_left_of_a_video_that_failed(tmp_path):
    def failing():
        yield from frames(2)
        raise RuntimeError

    with pytest.raises(RuntimeError):
        write_video(tmp_path / "a.mkv", failing())
    assert list(tmp_path.iterdir()) == []


def test_frames_must_be_of_one_kind(tmp_path):
    with pytest.raises(ValueError, match="frame 1 is"):
        write_video(tmp_path / "a.mkv", [*frames(1), *frames(1, (10, 64))])
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "a.mkv", [])
    with pytest.raises(ValueError, match=r"\.mkv, \.mp4"):
        write_video(tmp_path / "a.gif", frames())


def thin_line(moment, slope, shape=(90, 120)):
    """A line less than two rows thick that moves up and down."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    away = row - slope * (column - 60.0) - 45.0 - 20.0 * np.sin(0.8 * moment)
    return 180.0 - 120.0 * np.exp(-0.5 * (away / 0.7) ** 2)


def test_hairs_that_move_are_not_interlaced():
    """Hairs along the rows of a face that moves up and down alternate in all frames."""
    hairs = np.random.default_rng(5).normal(0.0, 30.0, (130, 120))
    hairs = 90.0 + ndimage.gaussian_filter(hairs, (0.4, 4.0)) * 3.0
    frames = [hairs[20 + k : 110 + k] for k in (0, 2, 5, 7, 6, 3, 1, -3, -6, -4)]
    assert not interlaced([np.rint(f).clip(0, 255).astype(np.uint8) for f in frames])


@pytest.mark.parametrize("slope", [0.1, 1.0])
def test_interlaced_frames_are_told_from_thin_lines_and_noise(slope):
    """Odd rows of interlaced frames show the line half a frame later than even ones."""
    generator = np.random.default_rng(3)
    whole, woven = [], []
    for moment in range(12):
        frame = thin_line(moment, slope)
        later = np.where(np.arange(90)[:, None] % 2, thin_line(moment + 0.5, slope), frame)
        grain = generator.normal(0.0, 2.0, frame.shape)
        whole.append(np.rint(frame + grain).astype(np.uint8))
        woven.append(np.rint(later + grain).astype(np.uint8))
    assert interlaced(woven)
    assert not interlaced(whole)
    assert not interlaced([frame.T for frame in whole])
    # Stripes that do not move, as those of a cloth.
    assert not interlaced(
        [frame - (40 * (np.arange(90) % 2)[:, None]).astype(np.uint8) for frame in whole]
    )
    assert not interlaced(whole[:1])

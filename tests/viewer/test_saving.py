"""What is saved from the page is what was on it."""

from types import SimpleNamespace

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.io import load_recording, read_video, save_recording, video_info
from vibrissa.viewer.save import deflection_dataset, movie, on_paper, png, written
from vibrissa.viewer.state import begin


def test_a_bent_whisker_is_a_labelled_dataset():
    bent = begin(vb.samples.gamma()).deflection
    data = deflection_dataset(bent)
    np.testing.assert_array_equal(data["force"], bent.force)
    signals = vb.base_signals(bent.force, bent.moment)
    assert float(data["MB"]) == float(signals.MB)
    assert all(v.attrs.get("units") for v in data.data_vars.values())
    assert all(v.attrs.get("long_name") for v in data.data_vars.values())


def test_a_trial_comes_back(tmp_path, recording):
    content = written("trial.nc", lambda path: save_recording(path, recording))
    (tmp_path / "trial.nc").write_bytes(content)
    back = load_recording(tmp_path / "trial.nc")
    assert set(back.children) == set(recording.children)
    np.testing.assert_array_equal(back["force"], recording["force"])


def test_a_picture_on_paper_has_a_margin_and_no_more():
    image = np.zeros((200, 300, 4), dtype=np.uint8)
    assert on_paper(image).shape == (200, 300, 3)
    image[90:100, 120:160] = (255, 0, 0, 128)
    paper = on_paper(image)
    assert paper.shape == (10 + 2 * 24, 40 + 2 * 24, 3)
    np.testing.assert_array_equal(paper[24, 24], [255, 127, 127])
    assert (paper[:24] == 255).all()


def test_a_picture_is_a_png():
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    assert png(image).startswith(b"\x89PNG")


@pytest.mark.parametrize(("fine", "height"), [(1, 120), (2, 242)])
def test_a_movie_shows_all_of_a_trial_on_white(tmp_path, fine, height):
    """Frames of odd size, of which the left is drawn as dark as far as the trial has gone."""
    frames, seen = 130, []

    def render(height, width, **_):
        image = np.zeros((height, width, 4), dtype=np.uint8)  # transparent
        image[:, :20] = [100, 100, 100, 255]
        image[:, 20 : 20 + seen[-1]] = [0, 0, 0, 255]
        return image

    client = SimpleNamespace(
        camera=SimpleNamespace(image_height=121, image_width=181), get_render=render
    )
    trial = SimpleNamespace(frames=frames)
    mode = SimpleNamespace(trial=trial, pause=lambda: None, show=seen.append)
    path = tmp_path / "trial.mp4"
    told = []
    path.write_bytes(movie(client, mode, fine, lambda *progress: told.append(progress)))
    assert told == [(done, 100) for done in range(100)]
    assert (seen[0], seen[-1], len(seen)) == (0, frames - 1, 100)
    found = video_info(path)
    # Without the empty margin at the right, and of even size.
    assert (found.width, found.height, found.rate) == (172, height, 25.0)
    grey = np.stack([frame.copy() for frame in read_video(path)]).astype(float)
    assert len(grey) == 100
    np.testing.assert_allclose(grey[:, 20:100, 170], 255.0, atol=6.0)
    np.testing.assert_allclose(grey[:, 20:100, 8], 100.0, atol=8.0)
    dark = (grey[:, 60] < 60.0).sum(axis=1)
    np.testing.assert_allclose(dark, seen, atol=2.0)

"""The main job end to end, on short trials: as good as its noise allows, and it says so."""

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

import vibrissa as vb
import vibrissa.demo as filming
from vibrissa import samples
from vibrissa.cli import figures
from vibrissa.cli.app import app
from vibrissa.demo import run_demo
from vibrissa.evaluation import (
    caution,
    distances_from_curves,
    refine_curves,
    tracking_scores,
    truth_of,
)
from vibrissa.io import load_contacts, load_recording
from vibrissa.pipeline import fit_contacts, reconstruct
from vibrissa.recording import Recording
from vibrissa.report import trial_sections
from vibrissa.report.page import shown_value

SHORT = {"duration": 0.6, "rate": 300.0, "video": False}
FILMED = {"duration": 0.4, "rate": 250.0, "seed": 2}


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def result(tmp_path_factory, told):
    folder = tmp_path_factory.mktemp("demo") / "new"
    return run_demo(output=folder, seed=2, progress=lambda *step: told.append(step), **SHORT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("filmed")


@pytest.fixture(scope="module")
def from_video(folder):
    return run_demo(output=folder, **FILMED)


@pytest.fixture(scope="module")
def sections(from_video, folder):
    """Sections of a report about each recording that the demo writes."""
    return {name: trial_sections(load_recording(folder / name)) for name in ("trial.nc", "seen.nc")}


def test_errors_are_those_that_the_noise_predicts(result):
    scores = result.sensed.scores
    assert scores.false == 0
    assert scores.detected > 0.9 * scores.touching
    assert scores.share_with_one > 0.9
    assert scores.candidates.sum() == scores.detected
    for row in scores.errors:
        median, predicted = row.measured[0], row.predicted[0]
        assert median == pytest.approx(predicted, rel=0.4)
    # The farther the whisker is bent the better the contact is known.
    medians = [row.measured[0] for row in scores.by_angle]
    assert medians == sorted(medians, reverse=True)


def test_the_peg_is_found(result):
    scores, fit = result.sensed.scores, result.sensed.fit
    assert np.linalg.norm(scores.offset) < 0.1e-3
    assert abs(scores.diameter_error) < 0.1e-3
    z = [*scores.offset[:2] / fit.origin_sigma[:2]]
    z.append(scores.diameter_error / fit.diameter_sigma)
    assert np.abs(z).max() < 5.0


def test_what_the_peg_is_known_to_counts_frames_that_err_together(from_video):
    """The sigma that is printed is that of the recording's contour."""
    for one in (from_video.sensed, from_video.seen):
        contour = one.recording["contour"].to_dataset()
        np.testing.assert_array_equal(one.fit.covariance, contour["parameter_covariance"].values)
        together = contour.attrs["frames_together"]
        alone = fit_contacts(
            one.recording["estimates"].to_dataset(), [from_video.contact_map.whisker]
        )
        expected = together * alone.covariance
        # What all frames of the film share comes on top.
        without = one.recording.copy()
        shared = ["contact_shared", "pose_shared", "wrench_shared"]
        without.dataset = one.recording.to_dataset().drop_vars(shared)
        plain = reconstruct(without)["parameter_covariance"].values
        np.testing.assert_allclose(plain, expected, rtol=1e-9)
        sigma = np.sqrt(np.diag(expected))
        more = (one.fit.covariance - expected) / np.outer(sigma, sigma)
        shared = np.linalg.eigvalsh(more)
        assert shared.min() > -1e-9 * shared.max()
        assert shared.max() > 0.01


def test_without_noise_contacts_are_exact():
    result = run_demo(noise=False, **SHORT)
    scores = result.sensed.scores
    assert scores.detected == scores.touching
    assert scores.errors[-1].measured[0] < 1e-9
    assert scores.errors[-1].measured[1] < 1e-6
    assert np.linalg.norm(scores.offset) < 1e-7
    assert abs(scores.diameter_error) < 1e-7
    assert result.files == ()


def test_what_is_written_comes_back(result):
    names = {file.name for file in result.files}
    assert names == {"trial.nc", "contacts.csv", "map.nc"}
    folder = result.files[0].parent
    assert names == {file.name for file in folder.iterdir() if not file.name.startswith(".")}
    recording = result.sensed.recording
    xr.testing.assert_identical(load_recording(folder / "trial.nc"), recording)
    contacts = load_contacts(folder / "contacts.csv")
    assert contacts.sizes["time"] == 180
    estimated = recording["estimates/contact_point_whisker"].values[:, 0]
    for i, name in enumerate("xyz"):
        np.testing.assert_array_equal(contacts[name], estimated[:, i])
    map_ = vb.ContactMap.load(folder / "map.nc")
    np.testing.assert_array_equal(
        map_.whisker.centerline(5), Recording(recording).whisker().centerline(5)
    )


def test_the_recording_keeps_what_is_known_and_what_is_true_apart(result):
    recording = result.sensed.recording
    assert (recording["force"].values != recording["truth/force"].values).any()
    estimates = recording["estimates"].to_dataset()
    felt = estimates["in_contact"].values
    assert np.isnan(estimates["contact_point"].values[~felt]).all()
    assert (estimates["status"].values[~felt] == vb.Status.NOT_FELT).all()
    for group in ("", "signals", "estimates"):
        data = recording[group or "/"].to_dataset()
        for name, variable in data.data_vars.items():
            assert {"units", "long_name"} <= set(variable.attrs), name


def test_progress_is_told_of_every_stage(result, told):
    stages = [stage for stage, done, total in told if done == total]
    assert set(stages) == {
        "how far to whisk",
        "map of all contacts",
        "whisking trial",
        "contact points",
        "files",
    }


@pytest.mark.slow
def test_seeds_repeat(result):
    again = run_demo(seed=2, **SHORT)
    np.testing.assert_array_equal(again.sensed.fit.origin, result.sensed.fit.origin)


def test_a_whisker_that_cannot_pass_the_peg_is_refused():
    with pytest.raises(ValueError, match="no room"):
        run_demo(samples.gamma().scaled(0.05))


def test_from_video_the_whisker_and_its_contact_are_tracked(from_video):
    tracking = from_video.tracking
    assert (tracking.frames, tracking.lost) == (100, 0)
    assert (tracking.trace[:, 0] < 0.15).all()
    assert tracking.contact[0] < 60e-6
    assert tracking.classified > 0.9


def test_from_video_contacts_are_as_good_as_noise_and_tracking_allow(from_video):
    # Of all contacts: single classes of deflection hold too few of this short trial.
    row, allowed = from_video.sensed.scores.errors[-1], from_video.tracking.contact[0]
    assert row.contacts >= 25
    # The median of n draws is off by about 1.25 / √n of itself; twice that may be.
    drawn = 1.0 + 2.0 * 1.25 / np.sqrt(row.contacts)
    assert row.measured[0] < drawn * row.predicted[0] + allowed
    assert from_video.seen.scores.errors[-1].measured[0] < 2.0 * allowed


def test_from_video_the_peg_is_found(from_video):
    for one in (from_video.sensed, from_video.seen):
        assert np.linalg.norm(one.scores.offset) < 0.2e-3
        assert abs(one.scores.diameter_error) < 0.2e-3


@pytest.mark.slow
def test_a_report_of_the_trial_has_the_same_errors(from_video, folder, sections):
    """Its whisker is the one that was tracked, not quite of the shape of the one that whisked."""
    for name, one in (("trial.nc", from_video.sensed), ("seen.nc", from_video.seen)):
        recording = load_recording(folder / name)
        truth, whisker = truth_of(recording)
        np.testing.assert_array_equal(
            whisker.centerline(9), Recording(from_video.simulated).whisker().centerline(9)
        )
        scores = tracking_scores(recording.to_dataset().isel(whisker=0), truth)
        for field in ("trace", "centerline", "base", "contact", "classified"):
            np.testing.assert_array_equal(
                getattr(scores, field), getattr(from_video.tracking, field)
            )
        text = " ".join(part.body for part in sections[name])
        for row in (*one.scores.errors, *one.scores.by_angle):
            for value in row.measured:
                assert f">{shown_value(row.quantity, value)}</td>" in text
        for row in one.scores.by_angle:
            assert f'{row.label}</th><td class="number">{row.contacts}</td>' in text
        for row in one.signals:
            assert f">{100 * row.force[0]:.3g} %</td>" in text
        for length in (from_video.tracking.base[0], from_video.tracking.centerline[0]):
            assert f">{shown_value('centerline', length, 3)}</td>" in text


@pytest.mark.slow
def test_what_tests_no_whisker_says_so_wherever_it_is_shown(folder, sections, tmp_path):
    """Signals that the model made agree with the model: in the report, and when reconstructed."""
    said = caution("contact point")
    for name, warned in (("trial.nc", False), ("seen.nc", True)):
        done = CliRunner().invoke(
            app, ["reconstruct", str(folder / name), "-o", str(tmp_path / name)]
        )
        assert done.exit_code == 0, done.exception
        assert (said in done.output) is warned
        assert any(said in part.body for part in sections[name]) is warned


def test_signals_are_better_known_the_more_the_whisker_is_bent(from_video):
    for one in (from_video.sensed, from_video.seen):
        for name in ("force", "moment"):
            medians = [getattr(row, name)[0] for row in one.signals if row.contacts >= 5]
            assert medians[-1] < 0.05
            assert medians[-1] < medians[0]


@pytest.mark.usefixtures("coarse")
def test_the_command_reports_every_stage_from_video(from_video, folder, monkeypatch):
    """Of a trial that is there; that it is taken up is tested below."""
    asked = {}

    def there(*arguments, **options):
        asked.update(options)
        return from_video

    monkeypatch.setattr("vibrissa.demo.run_demo", there)
    # Of all figures the one with frames of the videos: what they look like is tested with them.
    monkeypatch.setattr(figures, "drawn", lambda drawings, tell: [("trial", drawings["trial"]())])

    def run(*words):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == 0, done.exception
        return done.output

    text = run("demo", "-o", folder, "--duration", 0.4, "--rate", 250, "--seed", 2)
    for words in (
        "0 of 100 frames lost",
        "contact point",
        "px",
        "Signals, median",
        "paper's method",
    ):
        assert words in text
    assert asked.items() >= (FILMED | {"noise": True, "video": True}).items()
    written = {"top.mp4", "front.mp4", "tracked.nc", "trial.png"}
    assert written <= {file.name for file in folder.iterdir()}


@pytest.mark.slow
def test_what_was_done_is_not_done_again(from_video, folder, monkeypatch):
    names = {file.name for file in from_video.files}
    assert {"top.mp4", "front.mp4", "simulated.nc", "tracked.nc", "trial.nc", "seen.nc"} <= names

    def never(*args, **options):
        raise AssertionError("done again")

    monkeypatch.setattr("vibrissa.simulation.film", never)
    monkeypatch.setattr(filming, "trace_file", never)
    again = run_demo(output=folder, **FILMED)
    np.testing.assert_array_equal(again.sensed.fit.origin, from_video.sensed.fit.origin)
    with pytest.raises(AssertionError, match="done again"):
        run_demo(output=folder, **{**FILMED, "seed": 3})


@pytest.mark.slow
def test_stopped_while_filming_it_goes_on_with_the_next_view(tmp_path, monkeypatch):
    film, filmed = vb.simulation.film, []

    def stopping(trial, files, *args, **options):
        filmed.extend(files)
        if len(filmed) == 2:
            raise KeyboardInterrupt
        return film(trial, files, *args, **options)

    monkeypatch.setattr("vibrissa.simulation.film", stopping)
    short = {"duration": 0.1, "rate": 100.0, "output": tmp_path}
    for _ in range(2):
        with pytest.raises((KeyboardInterrupt, ValueError)):
            run_demo(**short)
    assert filmed == ["top", "front", "front"]


@pytest.mark.parametrize("name", ["top.mp4", "trial.nc", "contacts.csv", "map.nc"])
def test_files_of_others_are_left_alone(tmp_path, name):
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        run_demo(output=tmp_path, **FILMED)
    assert (tmp_path / name).read_bytes() == b"mine"
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_nothing_of_another_trial_stays(result, tmp_path):
    """What was seen of a filmed trial does not lie beside one that was not filmed."""
    filming.begin(tmp_path, result.whisker, video=True)
    (tmp_path / "seen.nc").write_bytes(b"of the first")
    filming.begin(tmp_path, result.whisker, video=True)
    assert (tmp_path / "seen.nc").exists()
    filming.begin(tmp_path, result.whisker, video=False)
    assert not (tmp_path / "seen.nc").exists()


def test_a_coarse_circle_is_a_circle():
    turn = np.linspace(0.0, 2.0, 33)
    coarse = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    hidden = np.where(turn[:, None] < 1.0, coarse, np.nan)
    circle, part = refine_curves(np.stack([coarse, hidden]))
    np.testing.assert_allclose(np.linalg.norm(circle, axis=1), 1.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(circle[::8], coarse, rtol=0, atol=1e-12)
    np.testing.assert_allclose(part[:8], np.linspace(*coarse[:2], 9)[:8], rtol=0, atol=1e-12)
    assert np.isnan(part[-1]).all()


def test_distances_from_curves():
    curve = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]])
    points = np.array([[[0.5, 0.3], [2.0, 1.0], [-3.0, 4.0], [np.nan, 0.0]]])
    np.testing.assert_allclose(distances_from_curves(points, curve), [[0.3, 1.0, 5.0, np.nan]])

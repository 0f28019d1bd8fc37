"""The main job end to end, on a short trial: as good as its noise allows, and it says so."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa import samples
from vibrissa.demo import run_demo
from vibrissa.io import load_contacts, load_recording
from vibrissa.trial import recorded_whisker

SHORT = {"duration": 0.6, "rate": 300.0}
FIGURES = ("whisker", "signal_space", "signals", "estimates", "contour")


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def result(tmp_path_factory, told):
    folder = tmp_path_factory.mktemp("demo") / "new"
    return run_demo(output=folder, seed=2, progress=lambda *step: told.append(step), **SHORT)


def test_errors_are_those_that_the_noise_predicts(result):
    scores = result.scores
    assert scores.false == 0
    assert scores.felt > 0.9 * scores.touching
    assert scores.share_with_one > 0.9
    assert scores.candidates.sum() == scores.felt
    for row in scores.errors:
        median, predicted = row.measured[0], row.predicted[0]
        assert median == pytest.approx(predicted, rel=0.4)
    # The farther the whisker is bent the better the contact is known.
    medians = [row.measured[0] for row in scores.by_angle]
    assert medians == sorted(medians, reverse=True)


def test_the_peg_is_found(result):
    scores = result.scores
    assert np.linalg.norm(scores.offset) < 0.1e-3
    assert abs(scores.diameter_error) < 0.1e-3
    z = [*scores.offset[:2] / result.fit.origin_sigma[:2]]
    z.append(scores.diameter_error / result.fit.diameter_sigma)
    assert np.abs(z).max() < 5.0


def test_without_noise_contacts_are_exact():
    result = run_demo(noise=False, **SHORT)
    scores = result.scores
    assert scores.felt == scores.touching
    assert scores.errors[-1].measured[0] < 1e-9
    assert scores.errors[-1].measured[1] < 1e-6
    assert np.linalg.norm(scores.offset) < 1e-7
    assert abs(scores.diameter_error) < 1e-7
    assert result.files == ()


def test_what_is_written_comes_back(result):
    names = {file.name for file in result.files}
    assert names == {"trial.nc", "contacts.csv", "map.nc", *(f"{f}.png" for f in FIGURES)}
    folder = result.files[0].parent
    assert names == {file.name for file in folder.iterdir()}
    xr.testing.assert_identical(load_recording(folder / "trial.nc"), result.recording)
    contacts = load_contacts(folder / "contacts.csv")
    assert contacts.sizes["time"] == 180
    estimated = result.recording["contact_point_whisker"].values[:, 0]
    for i, name in enumerate("xyz"):
        np.testing.assert_array_equal(contacts[name], estimated[:, i])
    map_ = vb.ContactMap.load(folder / "map.nc")
    np.testing.assert_array_equal(
        map_.whisker.centerline(5), recorded_whisker(result.recording).centerline(5)
    )


def test_the_recording_keeps_what_is_known_and_what_is_true_apart(result):
    recording, truth = result.recording, result.recording["truth"]
    assert (recording["force"].values != truth["force"].values).any()
    felt = recording["in_contact"].values
    assert np.isnan(recording["contact_point"].values[~felt]).all()
    assert (recording["status"].values[~felt] == vb.Status.NO_CONTACT).all()
    for name, variable in recording.data_vars.items():
        assert {"units", "long_name"} <= set(variable.attrs), name


def test_progress_is_told_of_every_stage(result, told):
    stages = [stage for stage, done, total in told if done == total]
    assert set(stages) == {
        "how far to whisk",
        "map of all contacts",
        "whisking trial",
        "contact points from signals",
        "files",
        "figures",
    }


def test_seeds_repeat(result):
    again = run_demo(seed=2, **SHORT)
    np.testing.assert_array_equal(again.fit.origin, result.fit.origin)


def test_a_whisker_that_cannot_pass_the_peg_is_refused():
    with pytest.raises(ValueError, match="no room"):
        run_demo(samples.gamma().scaled(0.05))

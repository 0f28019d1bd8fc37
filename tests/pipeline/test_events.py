"""Events of contacts in recordings, against a trial whose truth is known, and what carries them."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.io import events_in, load_contacts, save_contacts, save_predictors
from vibrissa.pipeline import TrialSummary, contact_columns, contact_events, predictors


@pytest.fixture(scope="module")
def located(trial, contact_map):
    recording = vb.pipeline.with_signals(trial, "sensor")
    return vb.pipeline.with_estimates(recording, contact_maps=[contact_map])


def test_events_are_those_of_the_truth(located):
    """At 300 Hz: onsets within 2 ms of the sample with the first true contact, losses at it."""
    truth = located["truth"].to_dataset().isel(whisker=0)
    steps, time = np.diff(truth["in_contact"].values.astype(int)), truth["time"].values[1:]
    found = list(events_in(located["estimates"].to_dataset()))
    onsets = np.array([(time, sigma) for time, _, event, sigma in found if event == "onset"])
    # The contact begins between this sample and the one before.
    np.testing.assert_allclose(onsets[:, 0], time[steps == 1] - 0.5 / 300.0, atol=2.5e-3)
    assert (onsets[:, 1] < 3e-3).all()
    losses = [time for time, _, event, _ in found if event == "loss"]
    np.testing.assert_allclose(losses, time[steps == -1], atol=4e-3)
    contacts = contact_events(located["estimates"].to_dataset())
    assert set(onsets[:, 0]) <= set(contacts["onset"].values)
    counted = TrialSummary(located).events
    assert counted["onset"] == len(onsets)
    assert counted["slip"] == contacts["slips"].sum()


def test_events_are_written(located, tmp_path):
    estimates = located["estimates"].to_dataset()
    vb.io.save_recording(tmp_path / "trial.nc", located)
    again = vb.io.load_recording(tmp_path / "trial.nc")["estimates"].to_dataset()
    wanted = list(events_in(estimates))
    np.testing.assert_equal(list(events_in(again)), wanted)
    assert again["event"].attrs["flag_meanings"] == "none onset loss slip"
    save_contacts(tmp_path / "contacts.csv", contact_columns(estimates.isel(whisker=0)))
    table = load_contacts(tmp_path / "contacts.csv").expand_dims("whisker", 1)
    table = table.assign_coords(whisker=estimates["whisker"])
    np.testing.assert_equal(list(events_in(table)), wanted)
    listed = predictors(located)
    np.testing.assert_equal(list(events_in(listed)), wanted)
    save_predictors(tmp_path / "table.csv", listed)
    assert (tmp_path / "table.csv").read_text().count(",onset,") == sum(
        event == "onset" for _, _, event, _ in wanted
    )


def test_contacts_of_another_source_are_not_dated(tracked, contact_map):
    """Of a tracked trial an onset is the first frame in contact."""
    recording = vb.pipeline.with_signals(tracked, "contact point", cutoff=None)
    recording = vb.pipeline.with_estimates(recording, contact_maps=[contact_map])
    estimates = recording["estimates"].to_dataset().isel(whisker=0)
    first = estimates["event"].values == vb.status.Event.ONSET
    assert first.any()
    np.testing.assert_array_equal(estimates["onset_time"][first], estimates["time"][first])
    assert np.isnan(estimates["onset_sigma"]).all()

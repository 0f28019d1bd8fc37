"""Onset, loss and slip of contacts sample by sample, against contacts whose onset is known."""

import numpy as np
import pytest

from vibrissa.contacts import ContactEvents, in_order
from vibrissa.contacts.following.events import dated_onset
from vibrissa.status import Event

TIME = np.arange(60) / 500.0


def ramp(onset, slope, draw):
    """Readings in standard deviations of noise that grow in two components."""
    grown = np.maximum(TIME - onset, 0.0)[:, None] * slope * np.array([0.8, 0.6, 0.0])
    return grown + np.random.default_rng(draw).normal(size=(len(TIME), 3))


def followed(readings, above=5.0):
    """Events and onsets of readings that are a contact above so many standard deviations."""
    events, found = ContactEvents(1.0), []
    for time, reading in zip(TIME, readings, strict=True):
        touching = bool(np.hypot(*reading[:2]) > above)
        found.append((events(time, touching, reading, None), events.onset))
    return [event for event, _ in found], np.array([onset for _, onset in found])


def test_onset_is_where_readings_begin_to_grow():
    """Slopes of 0.6 to 5 standard deviations a sample; of the onset's errors 95 % within 2 σ."""
    rng, away, late, rough = np.random.default_rng(0), [], [], []
    for draw in range(150):
        onset, slope = rng.uniform(0.06, 0.07), 500.0 * rng.uniform(0.6, 5.0)
        events, onsets = followed(ramp(onset, slope, draw))
        first = events.index(Event.ONSET)
        rough.append((onsets[first, 0] - onset) / onsets[first, 1])
        away.append((onsets[first + 8] - [onset, 0.0]).tolist())
        late.append(TIME[first] - onset)
    away = np.array(away)
    share = (np.abs(away[:, 0]) < 2.0 * away[:, 1]).mean()
    assert 0.9 < share < 0.99
    assert (np.abs(rough) < 2.0).mean() > 0.9
    assert np.median(np.abs(away[:, 0])) < 0.2 * np.median(late)
    assert np.quantile(np.abs(away[:, 0]), 0.95) < 2e-3


def test_onset_between_two_samples_is_their_middle():
    """Readings that jump, so that noise does not count: what is left is the interval's width."""
    reading = np.zeros((10, 2))
    reading[6:] = 1e3
    found, sigma = dated_onset(TIME[:10], reading)
    assert TIME[5] < found < TIME[6]
    assert 0.0 < sigma < 2e-3


@pytest.mark.parametrize("silent", [None, np.nan])
def test_onset_is_not_dated_without_free_samples_or_readings(silent):
    readings = ramp(0.0, 5e4, 0) if silent is None else ramp(0.05, 5e4, 0) * np.nan
    events = ContactEvents(1.0)
    for time, reading in zip(TIME, readings, strict=True):
        events(time, silent is None or time > 0.05, reading, None)
    assert events.onset[0] == (TIME[0] if silent is None else TIME[TIME > 0.05][0])
    assert np.isnan(events.onset[1])
    assert events(1.0, False, readings[0], None) == Event.LOSS
    assert np.isnan(events.onset).all()


@pytest.mark.parametrize("order", ["shuffled", "back", "still", "missing"])
def test_onsets_of_rows_out_of_order_are_not_dated(order):
    """Instead of an error, or of a date before the earlier rows."""
    time = {
        "shuffled": np.random.default_rng(1).permutation(TIME),
        "back": TIME[::-1],
        "still": 0.0 * TIME,
        "missing": np.nan * TIME,
    }[order]
    events = ContactEvents(1.0)
    for now, reading in zip(time, ramp(0.06, 300.0, 2), strict=True):
        touching = bool(np.hypot(*reading[:2]) > 5.0)
        events(now, touching, reading, None)
    assert events.onset[1] >= 0.0 or np.isnan(events.onset[1])
    if order != "shuffled":
        assert np.isnan(events.onset[1])


def test_events_in_order_are_where_contacts_began():
    readings = ramp(0.06, 300.0, 3)
    readings[50:] = 0.0
    events, onsets = followed(readings)
    codes, begun = in_order(TIME, events, onsets)
    row, detected = int((codes == Event.ONSET).argmax()), events.index(Event.ONSET)
    assert row < detected
    assert TIME[row - 1] < begun[row, 0] <= TIME[row]
    assert (begun[row:50] == onsets[49]).all()
    assert np.isnan(begun[:row]).all()
    assert np.isnan(begun[50:]).all()
    assert np.flatnonzero(codes).tolist() == [row, 50]

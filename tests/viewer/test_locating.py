"""What three signals tell, as it is shown: all candidates, their shapes, their errors."""

import numpy as np
import pytest

import vibrissa as vb
from vibrissa.viewer.locate import (
    COLOURS,
    Sensor,
    coloured,
    locate_drawing,
    located,
    of_located,
    usual_sensor,
)
from vibrissa.viewer.readout import counted, shaded
from vibrissa.viewer.state import begin, charted, moved


@pytest.fixture(scope="module")
def chart():
    return charted(vb.samples.gamma())


@pytest.fixture(scope="module")
def bend(chart):
    return moved(begin(chart.whisker), [24e-3, 3e-3, 4e-3])


def test_ghosts_feel_the_same(chart, bend):
    sensor = Sensor(("Fx", "FT", "MB"))
    found = located(chart, bend, sensor)
    others = found.others(chart.whisker.length)
    assert others.size >= 1
    ghosts = vb.deflect(chart.whisker, vb.PointContact(found.points))
    signals = vb.base_signals(ghosts.force, ghosts.moment)
    for name in sensor.triplet:
        np.testing.assert_allclose(signals[name], float(found.signals[name]), rtol=1e-6)
    # Each shape passes through its contact.
    for point, line in zip(found.points, found.lines, strict=True):
        assert np.linalg.norm(line - point, axis=1).min() < 0.3e-3
    drawn = locate_drawing(chart.whisker, found, 5.0)
    assert sum(name.startswith("ghost") for name in drawn) == others.size
    words = of_located(chart.whisker, found, bend.status)
    assert vb.Status.AMBIGUOUS.explanation in words


def test_a_unique_contact_has_no_ghost_but_an_error(chart, bend):
    quiet = located(chart, bend, Sensor())
    drawn = locate_drawing(chart.whisker, quiet, 5.0)
    assert not any(name.startswith("ghost") for name in drawn)
    # So little noise that the first order is all there is.
    small, large = (
        np.ptp(locate_drawing(chart.whisker, found, 5.0)["error 0"].vertices, axis=0)
        for found in (
            located(chart, bend, Sensor(force_noise=size, moment_noise=0.02 * size))
            for size in (1e-8, 2e-8)
        )
    )
    np.testing.assert_allclose(large, 2.0 * small, rtol=1e-9)
    silent = located(chart, bend, Sensor(force_noise=0.0))
    assert "error 0" not in locate_drawing(chart.whisker, silent, 5.0)


def test_nothing_is_located_where_nothing_touches(chart, bend):
    far = moved(bend, [10e-3, 30e-3, 0.0])
    assert located(chart, far, Sensor()) is None
    assert far.status.explanation in of_located(chart.whisker, None, far.status)


@pytest.mark.parametrize("what", COLOURS)
def test_every_contact_of_the_cloud_has_a_colour(chart, what):
    colours, legend = coloured(chart, what, Sensor())
    assert colours.shape == (len(chart.points), 3)
    assert len(np.unique(colours, axis=0)) > 1
    assert "data-legend" in legend.html()


def test_unknown_colours_are_refused(chart):
    with pytest.raises(ValueError, match="colours are one of uniqueness"):
        coloured(chart, "taste", Sensor())


def test_colours_follow_values():
    colours, _ = shaded("MD", np.array([-np.pi, np.pi]))
    assert np.abs(colours[0].astype(int) - colours[1]).max() < 6  # once around
    colours, _ = shaded("Mx", np.array([-1e-7, 0.0, 1e-7]))
    assert colours[0, 2] > colours[0, 0]
    assert colours[2, 0] > colours[2, 2]
    colours, legend = counted(np.array([1, 2, 9]))
    assert len(np.unique(colours, axis=0)) == 3
    assert "more" in legend.html()


def test_every_contact_of_the_cloud_is_found_again(chart):
    """So that a grey point means that signals determine nothing, not that a search failed."""
    for triplet in ("Fx MB MD", "Fx FT MB"):
        signals = {name: chart.signals[name] for name in triplet.split()}
        assert (chart.contact_map.estimate(signals, triplet).n_candidates > 0).all()


def test_a_sensor_suits_what_stands_on_it():
    rat, usual = usual_sensor(vb.samples.gamma()), Sensor()
    assert rat.force_noise == pytest.approx(usual.force_noise)
    assert rat.moment_noise == pytest.approx(usual.moment_noise)
    # A rod of 300 mm and 1 mm radius: EI/L² is a hundred times that of a whisker, EI/L a thousand.
    rod = vb.Whisker.straight(length=0.3, base_radius=1e-3, tip_radius=1e-3, youngs_modulus=2e9)
    assert usual_sensor(rod).force_noise == pytest.approx(1e-4)
    assert usual_sensor(rod).moment_noise == pytest.approx(2e-5)

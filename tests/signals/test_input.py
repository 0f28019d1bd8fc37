"""Arrays that users pass: hidden values, columns in another order, and wrong shapes."""

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb
from vibrissa.cameras import orthogonal_views, triangulate
from vibrissa.numerics import spherical
from vibrissa.objects import Peg
from vibrissa.signals import nearest_on_rest

WHISKER = vb.Whisker.parabola(length=30e-3, coefficient=10.0)
POINTS = np.array([[15e-3, 4e-3, 1e-3], [12e-3, 3e-3, -1e-3], [14e-3, 5e-3, 0.0]])
CAMERA = orthogonal_views()[0]
OF_POINTS = {
    "distance": Peg([15e-3, 9e-3, 0.0], [0.0, 0.0, 1.0], 1e-3).signed_distance,
    "pixels": CAMERA.project,
    "rest": lambda points: nearest_on_rest(WHISKER, points)[0],
    "signals": lambda force: vb.base_signals(force, 1e-3 * POINTS).to_array().values.T,
    "spherical": spherical,
    "wrench": lambda force: vb.estimate_from_wrench(WHISKER, force, 1e-3 * POINTS).point,
}


@pytest.mark.parametrize("name", OF_POINTS)
def test_masked_values_are_missing(name):
    hidden = np.ma.array(POINTS, mask=False)
    hidden[1, 2] = np.ma.masked
    missing = hidden.filled(np.nan)
    expected = OF_POINTS[name](missing)
    assert np.isnan(expected[1]).any()
    np.testing.assert_array_equal(OF_POINTS[name](hidden), expected)
    np.testing.assert_array_equal(OF_POINTS[name](list(hidden)), expected)


@pytest.mark.parametrize("name", OF_POINTS)
def test_vectors_have_three_components_in_order(name):
    # A kernel would write one distance for each three numbers, beyond the end of its output.
    for shape in ((3, 4), (4, 4), (6, 2)):
        with pytest.raises(ValueError, match="shape"):
            OF_POINTS[name](np.ones(shape))
    turned = xr.DataArray(POINTS[:, ::-1], dims=("time", "space"), coords={"space": list("zyx")})
    with pytest.raises(ValueError, match="z, y, x"):
        OF_POINTS[name](turned)


def test_masked_pixels_and_arc_lengths_are_missing():
    pixels = CAMERA.project(POINTS)
    masked = np.ma.array(pixels, mask=[[True, False], [False, False], [False, False]])
    found, _ = triangulate(orthogonal_views(), [masked, orthogonal_views()[1].project(POINTS)])
    assert np.isnan(found).all(axis=1).tolist() == [True, False, False]
    along = np.ma.array([5e-3, 10e-3], mask=[True, False])
    assert np.isnan(WHISKER.position(along)[:, 0]).tolist() == [True, False]


def test_components_may_be_along_any_dimension_of_labelled_arrays():
    force, moment = 1e-3 * POINTS, 1e-5 * POINTS[::-1]
    expected = vb.base_signals(force, moment)
    first, last = (("space", "time"), force.T), (("time", "axis"), force)
    for labelled in (xr.DataArray(data, dims=dims) for dims, data in (first, last)):
        for other in (moment, xr.DataArray(moment, dims=("time", "component"))):
            found = vb.base_signals(labelled, other)
            assert found.sizes == {"time": 3}
            np.testing.assert_array_equal(found.to_array(), expected.to_array())


def test_signals_may_be_chosen_by_an_array_and_not_by_nothing():
    force = vb.deflect(WHISKER, vb.PointContact(POINTS[0]))
    signals = vb.base_signals(force.force, force.moment)
    contact_map = vb.ContactMap.simulate(WHISKER, grid=False)
    found = contact_map.estimate(signals, np.array(["Fx", "MB", "MD"]))
    np.testing.assert_allclose(found.point, POINTS[0], atol=1e-9)
    with pytest.raises(ValueError, match=r"3 different signals.* got None"):
        contact_map.estimate(signals, None)

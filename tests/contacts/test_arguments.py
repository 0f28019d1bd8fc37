"""What users hand over: datasets of files, other units, swapped arguments."""

import re
from functools import partial

import numpy as np
import pytest
import xarray as xr

import vibrissa as vb


@pytest.fixture(scope="module")
def bent():
    points = [[24e-3, 13e-3, 2e-3], [26e-3, 11e-3, 1e-3]]
    return vb.deflect(vb.samples.gamma(), vb.PointContact(points))


@pytest.fixture(scope="module")
def contact_map(bent):
    return vb.ContactMap.simulate(bent.whisker, grid=False)


def test_a_table_of_signals_is_estimated_as_it_is_loaded(bent, contact_map, tmp_path):
    path = tmp_path / "signals.csv"
    rows = np.column_stack([[0.0, 0.001], bent.force, bent.moment])
    header = "time,Fx,Fy,Fz,Mx,My,Mz"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.17g")
    found = contact_map.estimate(vb.load_signals(path))
    np.testing.assert_allclose(found.candidates.point[:, 0], bent.contact_point, atol=1e-6)
    assert vb.status.names(found.status).tolist() == ["UNIQUE", "UNIQUE"]


def test_columns_of_other_rows_are_refused(bent, contact_map):
    pandas = pytest.importorskip("pandas")
    signals = vb.base_signals(bent.force, bent.moment)
    columns = {name: pandas.Series(signals[name].values) for name in ("Fx", "MB", "MD")}
    found = contact_map.estimate(columns)
    np.testing.assert_allclose(found.point, bent.contact_point, atol=1e-6)
    columns["MB"] = columns["MB"][::-1]
    with pytest.raises(ValueError, match="different indices"):
        contact_map.estimate(columns)


def test_signals_in_other_units_get_a_hint(bent, contact_map):
    force, moment = (np.tile(1e6 * part, (10, 1)) for part in (bent.force, bent.moment))
    signals = vb.base_signals(force, moment)
    with pytest.raises(ValueError, match="are these mN"):
        contact_map.estimate(signals)


def test_a_few_odd_samples_stop_no_table(bent, contact_map):
    force, moment = (np.tile(part, (15, 1)) for part in (bent.force, bent.moment))
    force[3], moment[4] = 1e6 * force[3], 1e6 * moment[4]
    found = contact_map.estimate(vb.base_signals(force, moment))
    assert (found.status == vb.Status.UNIQUE).sum() == 28


def test_swapped_arguments_get_a_hint(bent, contact_map):
    with pytest.raises(ValueError, match="whisker comes first"):
        vb.deflect(bent.load, bent.whisker)
    with pytest.raises(ValueError, match="whisker comes first"):
        vb.estimate_from_wrench(bent.force, bent.moment, bent.whisker)
    for force, moment in ((bent.moment, bent.force), (1e-3 * bent.force, 1e6 * bent.moment)):
        with pytest.raises(ValueError, match="force, N, comes before moment"):
            vb.estimate_from_wrench(bent.whisker, force, moment)
        with pytest.raises(ValueError, match="force, N, comes before moment"):
            vb.second_contact(bent.whisker, force, moment, noise=1e-12 * np.eye(6))
    certificates = vb.certificates
    for needs_a_map in (
        vb.uniqueness,
        vb.sensitivity,
        vb.Estimator,
        partial(vb.best_triplet, noise=np.eye(6)),
        certificates.certify,
        certificates.smallest_cone,
        partial(certificates.outlook, cone=0.1),
    ):
        with pytest.raises(ValueError, match=r"ContactMap.simulate\(whisker\)"):
            needs_a_map(bent.whisker)
    sensor = vb.sensors.Sensor(("My", "Mz"), noise=2e-8)
    for using, noise in ((sensor, None), ("Fx MB MD", sensor)):
        with pytest.raises(ValueError, match=r"Estimator.of_sensor\(contact_map, sensor\)"):
            vb.Estimator(contact_map, using, noise)
    with pytest.raises(ValueError, match="a Sensor is needed"):
        vb.Estimator.of_sensor(contact_map, "Fx MB MD")
    with pytest.raises(ValueError, match=r"3 different signals of .* got <Sensor"):
        contact_map.estimate(vb.base_signals(bent.force, bent.moment), sensor)
    with pytest.raises(ValueError, match="needs an Estimator"):
        vb.ContactFilter(bent.whisker)
    with pytest.raises(ValueError, match=r"objects are .* got <?Whisker"):
        vb.deflect_around(bent.whisker, bent.whisker)
    for other in ("whisker.toml", bent.contact_point):
        with pytest.raises(ValueError, match=f"a Whisker is needed; got {type(other).__name__}"):
            vb.deflect(other, bent.load)
        with pytest.raises(ValueError, match=f"a Whisker is needed; got {type(other).__name__}"):
            vb.ContactMap.simulate(other)


def test_millimetres_in_arrays_get_a_hint(bent):
    with pytest.raises(ValueError, match="millimetres given as metres"):
        vb.deflect(bent.whisker, vb.PointContact(1e3 * bent.contact_point))
    mixed = vb.deflect(bent.whisker, vb.PointContact([[24.0, 13.0, 2.0], [24e-3, 13e-3, 2e-3]]))
    assert vb.status.names(mixed.status).tolist() == ["BEYOND_TIP", "OK"]


def test_pegs_and_objects_in_millimetres_get_a_hint(bent):
    upright = [0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match=r"all pegs are .* millimetres given as metres"):
        vb.deflect(bent.whisker, vb.PegContact([24.0, 13.0, 0.0], upright))
    with pytest.raises(ValueError, match=r"all objects are .* millimetres given as metres"):
        vb.deflect_around(bent.whisker, vb.objects.Peg([24.0, 13.0, 0.0], upright, 1.35))


def test_masked_samples_are_missing(bent, contact_map):
    force = np.ma.masked_array(bent.force, mask=[[True] * 3, [False] * 3])
    signals = vb.base_signals(bent.force, bent.moment)
    axial = np.ma.masked_array(signals.Fx.values, mask=[True, False])
    named = {"Fx": axial, "MB": signals.MB.values, "MD": signals.MD.values}
    for found in (
        contact_map.estimate(named),
        vb.estimate_from_wrench(bent.whisker, force, bent.moment),
    ):
        assert vb.status.names(found.status).tolist() == ["MISSING", "UNIQUE"]
    one = vb.Estimator(contact_map)(np.ma.masked_array([1e-6, 1e-8, 0.1], mask=[1, 0, 0]))
    assert one.status == vb.Status.MISSING


def test_columns_in_another_order_are_refused(bent, contact_map):
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(bent.contact_point[:, ::-1], columns=list("zyx"))
    with pytest.raises(ValueError, match="columns z, y, x; x, y, z are needed in this order"):
        vb.deflect(bent.whisker, vb.PointContact(table))
    vb.deflect(bent.whisker, vb.PointContact(table[["x", "y", "z"]]))
    row = pandas.Series([0.1, 1e-8, 1e-6], index=["MD", "MB", "Fx"])
    with pytest.raises(ValueError, match="columns MD, MB, Fx; Fx, MB, MD are needed"):
        vb.Estimator(contact_map)(row)


@pytest.mark.parametrize("turn", [np.diag([1.0, 1.0, -1.0]), np.ones((3, 3)), 2.0 * np.eye(3)])
def test_a_rotation_is_one_or_refused(bent, contact_map, turn):
    """A reflected pose gave another contact point, called UNIQUE with a valid covariance."""
    peg = vb.objects.Peg([24e-3, 13e-3, 0.0], [0.0, 0.0, 1.0], 1e-3)
    heavy = vb.sensors.Sensor(mass=1e-3)
    estimator = vb.Estimator(contact_map)
    for call in (
        lambda: vb.deflect_around(bent.whisker, peg, turn),
        lambda: heavy.to_wrench(np.zeros(6), turn),
        lambda: estimator([1e-6, 1e-8, 0.1], turn),
        lambda: vb.streaming.Poses(turn),
    ):
        with pytest.raises(ValueError, match="rotation is not a rotation"):
            call()


@pytest.mark.parametrize("name", ["stiffness_sigma", "gain_sigma", "mixing_sigma"])
def test_relative_errors_are_no_per_cent(contact_map, name):
    signals, noise = {"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}, {"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}
    with pytest.raises(ValueError, match=f"{name} is a relative standard deviation"):
        contact_map.estimate(signals, noise=noise, **{name: 5.0})
    with pytest.raises(ValueError, match="it is a share: 5 % is"):
        vb.sensors.Sensor(gain_error=5.0)


@pytest.mark.parametrize("unit", ["mN", "µN", "millinewton", "kilonewton * meter", "deg", "1/mm"])
def test_labelled_arrays_in_other_units_are_refused(bent, unit):
    """Their numbers would be used as if they were in SI units."""
    force = xr.DataArray(bent.force, dims=("sample", "space"), attrs={"units": "N"})
    assert (vb.base_signals(force, bent.moment).FT > 0.0).all()
    with pytest.raises(ValueError, match=f"force is stated in {re.escape(unit)}; SI units"):
        vb.base_signals(force.assign_attrs(units=unit), bent.moment)

    # An array with a unit, as of packages for them
    quantity = bent.moment.view(type("Quantity", (np.ndarray,), {"unit": unit}))
    with pytest.raises(ValueError, match="moment is stated in"):
        vb.base_signals(force, quantity)


def test_a_covariance_that_is_not_symmetric_is_named_so(contact_map):
    noise = np.diag([1e-12] * 3 + [4e-16] * 3)
    noise[0, 1] = 1e-13
    with pytest.raises(ValueError, match=r"a covariance is symmetric; the entries \(0, 1\) and"):
        contact_map.estimate({"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}, noise=noise)


def test_noise_of_unknown_signals_is_refused(contact_map, bent):
    """Such as a component beside signals, whose noise would be ignored."""
    sigma = {"Fx": 1e-6, "FT": 1e-6, "MB": 1e-8, "MD": 0.1}
    assert contact_map.estimate({"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}, noise=sigma).status is not None
    for more in ("Fy", "mb", "fx"):
        with pytest.raises(ValueError, match=f"'{more}' is unknown here; known are Fx, FT, FD, Mx"):
            contact_map.estimate({"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}, noise=sigma | {more: 1e-6})
    components = dict.fromkeys(("Fx", "Fy", "Fz", "Mx", "My", "Mz", "MB"), 1e-6)
    with pytest.raises(ValueError, match="'MB' is unknown here; known are Fx, Fy, Fz, Mx, My, Mz"):
        vb.estimate_from_wrench(bent.whisker, bent.force, bent.moment, noise=components)


def test_options_that_would_be_ignored_are_refused(bent, contact_map):
    signals = {"Fx": 1e-6, "MB": 1e-8, "MD": 0.1}
    with pytest.raises(ValueError, match="base_rotation is given without gravity"):
        contact_map.estimate(signals, base_rotation=np.eye(3))
    with pytest.raises(ValueError, match="centerline_sigma is of a centerline"):
        vb.second_contact(
            bent.whisker, bent.force, bent.moment, noise=1e-12 * np.eye(6), centerline_sigma=1e-5
        )
    with pytest.raises(ValueError, match="phi is an angle in rad"):
        vb.Prior({"phi": (-30.0, 30.0)})


def test_signals_of_an_estimator_may_be_typed_in_small_letters(contact_map):
    values = [1e-6, 1e-8, 0.1]
    found = vb.Estimator(contact_map, "md fx mb")([values[2], *values[:2]])
    np.testing.assert_array_equal(found.point, vb.Estimator(contact_map)(values).point)


def test_results_become_datasets_and_pictures(bent, contact_map):
    data = bent.to_dataset()
    assert data["force"].dims == ("load", "space")
    np.testing.assert_array_equal(data["moment"], bent.moment)
    assert data["arc_length"].attrs["units"] == "m"
    assert contact_map.plot().startswith("<svg")


def test_statuses_have_names_in_any_shape():
    assert vb.status.names([[0, 2], [10, 11]]).tolist() == [
        ["OK", "NO_CONTACT"],
        ["BEYOND_FOLD", "BEYOND_TIP"],
    ]
    with pytest.raises(ValueError, match="not statuses"):
        vb.status.names([0, 77])

"""What users hand over: datasets of files, other units, swapped arguments."""

import numpy as np
import pytest

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


def test_swapped_arguments_get_a_hint(bent):
    with pytest.raises(ValueError, match="whisker comes first"):
        vb.deflect(bent.load, bent.whisker)
    with pytest.raises(ValueError, match="whisker comes first"):
        vb.estimate_from_wrench(bent.force, bent.moment, bent.whisker)
    for force, moment in ((bent.moment, bent.force), (1e-3 * bent.force, 1e6 * bent.moment)):
        with pytest.raises(ValueError, match="force, N, comes before moment"):
            vb.estimate_from_wrench(bent.whisker, force, moment)
    with pytest.raises(ValueError, match=r"ContactMap.simulate\(whisker\)"):
        vb.uniqueness(bent.whisker)
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
